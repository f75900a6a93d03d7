"""The points of a local map: each once, in the list of its cell, merged as a plain twin merges."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import se2, transform
from frontend import map_kernels
from tests.frontend.rooms import ROOM, prepared

CELL_M, MERGE_M = 0.2, 0.03
MOST_WEIGHT = 20.0


@dataclass
class Surface:
    """The arrays of a map, over a window of rows x cols list cells from its origin."""

    origin: tuple[float, float]
    rows: int
    cols: int

    def __post_init__(self) -> None:
        self.head = np.full((self.rows, self.cols), -1, dtype=np.int32)
        self.points, self.normals = np.full((4000, 2), np.nan), np.full((4000, 2), np.nan)
        self.weights = np.full(4000, np.nan)
        self.following = np.full(4000, -7, dtype=np.int32)
        self.count = 0

    def insert(self, points: Array, normals: Array, pose: tuple[float, float, float]) -> None:
        self.count = map_kernels.insert_points(
            points,
            normals,
            *pose,
            self.points,
            self.normals,
            self.weights,
            self.following,
            self.count,
            self.head,
            *self.origin,
            CELL_M,
            MERGE_M,
        )

    def lists(self) -> dict[tuple[int, int], list[int]]:
        """By cell, the points in the order in which their list is walked."""
        found: dict[tuple[int, int], list[int]] = {}
        for row, col in np.argwhere(self.head >= 0).tolist():
            chain, at = [], int(self.head[row, col])
            while at >= 0:
                chain.append(at)
                assert len(chain) <= self.count, "a list that never ends"
                at = int(self.following[at])
            found[row, col] = chain
        return found


def twin(
    surface: Surface, scans: list[tuple[Array, Array, tuple[float, float, float]]]
) -> list[tuple[Array, Array, float]]:
    """What the map must hold, by the docstring: (point, normal, weight) in order of arrival."""
    rows: list[tuple[Array, Array, float]] = []
    cells: dict[tuple[int, int], list[int]] = defaultdict(list)
    for points, normals, (x, y, yaw) in scans:
        T = se2(x, y, yaw)
        for p, n in zip(transform(T, points), normals @ T[:2, :2].T, strict=True):
            cell = (
                math.floor((p[1] - surface.origin[1]) / CELL_M),
                math.floor((p[0] - surface.origin[0]) / CELL_M),
            )
            inside = 0 < cell[0] < surface.rows - 1 and 0 < cell[1] < surface.cols - 1
            if not n.any() or not inside:
                continue
            near = [k for k in cells[cell] if n @ rows[k][1] > 0.95]
            near.sort(key=lambda k: (float(np.linalg.norm(p - rows[k][0])), -k))
            if near and np.linalg.norm(p - rows[near[0]][0]) < MERGE_M:
                point, normal, weight = rows[near[0]]
                merged = normal + (n - normal) / (weight + 1.0)
                rows[near[0]] = (
                    point + (p - point) / (weight + 1.0),
                    merged / np.linalg.norm(merged),
                    min(weight + 1.0, MOST_WEIGHT),
                )
            else:
                cells[cell].append(len(rows))
                rows.append((p, n, 1.0))
    return rows


def scan_of_room(seed: int) -> tuple[Array, Array, tuple[float, float, float]]:
    random = np.random.default_rng(seed)
    pose = (random.uniform(3.5, 6.0), random.uniform(0.5, 4.0), random.uniform(-3.0, 3.0))
    scan = prepared(ROOM, se2(*pose), beams=180, noise_m=0.01, random=random)
    return scan.points_base, scan.normals_base, pose


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_agrees_with_the_plain_twin_and_loses_no_point(seed: int) -> None:
    scans = [scan_of_room(seed + k) for k in range(3)]
    surface = Surface((0.03, -1.0), 45, 48)
    for scan in scans:
        surface.insert(*scan)
    wanted = twin(surface, scans)
    assert surface.count == len(wanted)
    assert surface.points[: surface.count] == pytest.approx(np.array([w[0] for w in wanted]))
    assert surface.normals[: surface.count] == pytest.approx(np.array([w[1] for w in wanted]))
    assert surface.weights[: surface.count].tolist() == [w[2] for w in wanted]
    chains = surface.lists()
    reached = sorted(k for chain in chains.values() for k in chain)
    assert reached == list(range(surface.count))
    for (row, col), chain in chains.items():
        cells = np.floor((surface.points[chain] - surface.origin) / CELL_M)
        assert (cells == [col, row]).all(), "a merged point has left its cell"


def test_a_wall_seen_again_is_merged_and_its_weight_is_bounded() -> None:
    points, normals, pose = scan_of_room(5)
    surface = Surface((-2.0, -3.0), 60, 70)
    surface.insert(points, normals, pose)
    once = surface.count
    before = surface.points[:once].copy()
    for _ in range(30):
        surface.insert(points, normals, pose)
    assert surface.count == once
    assert np.abs(surface.points[:once] - before).max() < MERGE_M
    assert surface.weights[:once].max() == MOST_WEIGHT
    assert np.linalg.norm(surface.normals[:once], axis=1) == pytest.approx(np.ones(once))


def test_density_is_bounded_however_often_a_noisy_wall_is_seen() -> None:
    random = np.random.default_rng(2)
    surface = Surface((-1.0, -1.0), 20, 30)
    normals = np.tile([0.0, -1.0], (200, 1))
    for _ in range(20):
        wall = np.column_stack([random.uniform(0.0, 4.0, 200), 2.0 + random.normal(0, 0.01, 200)])
        surface.insert(wall, normals, (0.0, 0.0, 0.0))
    assert surface.count < 4.0 / MERGE_M * 4.0


def test_both_sides_of_a_thin_wall_stay_apart() -> None:
    surface = Surface((-1.0, -1.0), 20, 20)
    points = np.array([[0.5, 0.5], [0.5, 0.501]])
    surface.insert(points, np.array([[0.0, 1.0], [0.0, -1.0]]), (0.0, 0.0, 0.0))
    assert surface.count == 2


def test_what_has_no_normal_or_lies_outside_is_left_out() -> None:
    surface = Surface((0.0, 0.0), 10, 10)  # 2 m x 2 m, its border cells kept free
    up = [0.0, 1.0]
    places = [[1.0, 1.0], [1.0, 1.0], [0.1, 1.0], [1.9, 1.0], [1.0, 0.1], [1.0, 1.9], [-5.0, 1.0]]
    places += [[1e6, 1.0], [1.0, -1e6], [0.21, 1.79]]
    normals = [[0.0, 0.0], *([up] * 9)]
    surface.insert(np.array(places), np.array(normals), (0.0, 0.0, 0.0))
    assert surface.points[: surface.count].tolist() == [[1.0, 1.0], [0.21, 1.79]]
