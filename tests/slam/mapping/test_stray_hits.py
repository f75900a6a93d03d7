"""Far hits behind a wall that is surer than they are go; everything else stays."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datasets.messages import Array
from datasets.trajectory import Trajectory
from slam.mapping import occupancy_kernels
from slam.mapping.layers import draw_map
from slam.mapping.occupancy import OCCUPIED, MapConfig, OccupancyGrid
from slam.mapping.scan_store import BEAM, CAMERA, CLEAR, LIDAR, SURFACE, ScanStore
from slam.mapping.stray_hits import FAR_M, REACH_M, TIMES

CONFIG = MapConfig()
WALL = np.column_stack([np.full(41, 8.02), np.linspace(-1.0, 1.0, 41)])


def shown(grid: OccupancyGrid, *at: tuple[float, float]) -> list[bool]:
    classes = grid.classes(CONFIG)
    cells = [np.floor((np.array(p) - grid.corner_map_m) / grid.resolution_m) for p in at]
    return [bool(classes[int(row), int(column)] == OCCUPIED) for column, row in cells]


def mapped(
    scans: list[Array], roles: int = BEAM, layer: str = LIDAR, moved_m: float = 0.0
) -> OccupancyGrid:
    stamps = list(range(len(scans)))
    store = ScanStore.from_scans(
        stamps,
        ["s"] * len(scans),
        [scan - [moved_m, 0.0] for scan in scans],
        {"s": (0.0, 0.0)},
        roles=[np.full(len(scan), roles, np.uint8) for scan in scans],
        layers={"s": layer},
    )
    poses = np.tile([moved_m, 0.0, 0.0], (len(scans), 1))
    return draw_map(store, Trajectory(np.array(stamps), poses), CONFIG).layers[layer]


def test_a_far_hit_behind_a_wall_goes() -> None:
    behind = np.array([[8.17, 0.52]])
    grid = mapped([WALL] * 20 + [np.vstack([WALL[:20], behind])])
    assert shown(grid, (8.17, 0.52), (8.02, 0.5)) == [False, True]


def test_what_the_wall_does_not_explain_stays() -> None:
    too_far, beside, before = (8.47, 0.52), (8.17, 1.3), (7.87, -0.5)
    grid = mapped([WALL] * 20 + [np.array([too_far, beside, before])] * 2)
    assert shown(grid, too_far, beside) == [True, True]
    few = mapped([WALL] * 8 + [np.array([[8.17, 0.52]])])
    assert shown(few, (8.17, 0.52)) == [True], "the wall is not ten times as sure"


def test_near_hits_explain_themselves() -> None:
    """The same wall and hit, from 4 m: there the lidar's noise is less than a cell."""
    behind = np.array([[8.17, 0.52]])
    grid = mapped([WALL] * 20 + [behind], moved_m=4.0)
    assert shown(grid, (8.17, 0.52)) == [True]


def test_one_near_hit_keeps_a_cell() -> None:
    scans = [WALL] * 30 + [np.array([[8.17, 0.52]])]
    store = ScanStore.from_scans(
        list(range(32)),
        ["s"] * 32,
        [*scans, np.array([[0.17, 0.52]])],
        {"s": (0.0, 0.0)},
    )
    poses = np.zeros((32, 3))
    poses[31, 0] = 8.0
    grid = draw_map(store, Trajectory(np.arange(32), poses), CONFIG).layers[LIDAR]
    assert shown(grid, (8.17, 0.52)) == [True]


def test_surfaces_of_a_camera_are_left_alone() -> None:
    grid = mapped([WALL] * 9 + [np.array([[8.17, 0.52]])], roles=SURFACE, layer=CAMERA)
    assert shown(grid, (8.17, 0.52)) == [True]


@pytest.mark.parametrize("seed", [1, 2])
def test_marks_agree_with_a_plain_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-9.0, 9.0, (300, 2)).astype(np.float32)
    roles = rng.choice([BEAM, BEAM, BEAM, CLEAR], 300).astype(np.uint8)
    offsets = np.array([0, 120, 120, 300])
    origins, sensor = np.array([[0.1, -0.2]]), np.zeros(3, np.int64)
    xyyaw = np.column_stack([rng.uniform(-1.0, 1.0, (3, 2)), rng.uniform(-3.0, 3.0, 3)])
    hits = rng.choice([0.0, 1.0, 2.0, 30.0], (80, 100)).astype(np.float32)
    corner, resolution = (-10.0, -8.0), 0.2
    stray, sound = np.zeros((80, 100), np.uint8), np.zeros((80, 100), np.uint8)
    occupancy_kernels.mark_strays(
        points, offsets, sensor, origins, xyyaw, roles, *corner, resolution, 11.0,
        FAR_M, REACH_M, TIMES, hits, stray, sound,
    )  # fmt: skip

    def value(x: float, y: float) -> tuple[int, int] | None:
        at = math.floor((y - corner[1]) / resolution), math.floor((x - corner[0]) / resolution)
        return at if 0 <= at[0] < 80 and 0 <= at[1] < 100 else None

    expected = [np.zeros((80, 100), np.uint8), np.zeros((80, 100), np.uint8)]
    for i in range(3):
        x0, y0, yaw = xyyaw[i]
        R = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        eye = R @ origins[0] + [x0, y0]
        for j in range(offsets[i], offsets[i + 1]):
            end = R @ points[j] + [x0, y0]
            range_m = float(np.hypot(*(end - eye)))
            cell = value(*end)
            if roles[j] != BEAM or range_m > 11.0 or cell is None:
                continue
            ray = (end - eye) / range_m
            before = [value(*(end - ray * 0.1 * k)) for k in range(1, 4)]
            surest = max((hits[at] for at in before if at is not None), default=0.0)
            explained = range_m > FAR_M and surest >= TIMES * max(hits[cell], 1.0)
            expected[0 if explained else 1][cell] = 1
    assert stray.sum() > 10
    np.testing.assert_array_equal(stray, expected[0])
    np.testing.assert_array_equal(sound, expected[1])
