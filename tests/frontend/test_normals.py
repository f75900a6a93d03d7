"""Normals of a scan: what is known of walls, corners and strays, and a plain twin."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import se2, transform
from frontend import map_kernels
from tests.frontend.rooms import ROOM, fused, walls

GAP_M, GAP_RATIO, RADIUS_M, MOST = 0.05, 0.05, 0.15, 12


def estimate(
    points: Array,
    origin: tuple[float, float] = (0.0, 0.0),
    *,
    gap_m: float = GAP_M,
    gap_ratio: float = GAP_RATIO,
    radius_m: float = RADIUS_M,
    most: int = MOST,
) -> Array:
    normals = np.full(points.shape, np.nan)
    map_kernels.estimate_normals(
        np.ascontiguousarray(points, dtype=np.float64),
        float(origin[0]),
        float(origin[1]),
        gap_m,
        gap_ratio,
        radius_m,
        most,
        normals,
    )
    return normals


def twin(
    points: Array, origin: Array, gap_m: float, gap_ratio: float, radius_m: float, most: int
) -> Array:
    """The same by the definition: a principal component analysis of each point's neighbours."""
    normals = np.zeros(points.shape)
    for i, point in enumerate(points):
        to_sensor = origin - point
        reach = np.linalg.norm(to_sensor)
        chosen = [i]
        for side in (range(i + 1, len(points)), range(i - 1, -1, -1)):
            before = i
            for taken, k in enumerate(side):
                gap = np.linalg.norm(points[k] - points[before])
                away = np.linalg.norm(points[k] - point)
                too_far = taken >= 2 and away > radius_m
                if taken >= most or gap > gap_m + gap_ratio * reach or too_far:
                    break
                chosen.append(k)
                before = k
        if len(chosen) < 3:
            continue
        values, vectors = np.linalg.eigh(np.cov(points[chosen].T, bias=True))
        normal = vectors[:, 0] * np.sign(vectors[:, 0] @ to_sensor)
        if (
            values[1] >= 1e-8
            and values[0] <= 0.09 * values[1]
            and normal @ to_sensor >= 0.14 * reach
        ):
            normals[i] = normal
    return normals


@pytest.mark.parametrize("angle_deg", [0, 37, 90, 180, 251])
@pytest.mark.parametrize("y", [2.0, -2.0])
def test_a_wall_has_its_normal_towards_the_sensor(angle_deg: int, y: float) -> None:
    wall = np.column_stack([np.linspace(-2.0, 3.0, 101), np.full(101, y)])
    T = se2(0.0, 0.0, math.radians(angle_deg))
    normals = estimate(transform(T, wall))
    expected = T[:2, :2] @ np.array([0.0, -np.sign(y)])
    assert normals == pytest.approx(np.tile(expected, (101, 1)), abs=1e-9)


def test_the_sensor_need_not_stand_at_the_origin() -> None:
    wall = np.column_stack([np.linspace(-1.0, 1.0, 41), np.full(41, 2.0)])
    assert estimate(wall, (0.5, 4.0))[:, 1] == pytest.approx(np.ones(41))


def test_walls_that_meet_keep_their_normals_up_to_the_corner() -> None:
    along = np.arange(0.0, 2.0, 0.04)[::-1]
    points = np.vstack(
        [
            np.column_stack([np.full(50, 2.0), 2.0 - along]),
            np.column_stack([2.0 - along[::-1], np.full(50, 2.0)])[1:],
        ]
    )
    normals = estimate(points)
    away = np.linalg.norm(points - [2.0, 2.0], axis=1) > RADIUS_M + 0.01
    one, other = away & (points[:, 1] < 1.99), away & (points[:, 0] < 1.99)
    assert normals[one] == pytest.approx(np.tile([-1.0, 0.0], (one.sum(), 1)), abs=1e-9)
    assert normals[other] == pytest.approx(np.tile([0.0, -1.0], (other.sum(), 1)), abs=1e-9)
    assert not normals[np.argmin(np.linalg.norm(points - [2.0, 2.0], axis=1))].any()


def test_points_that_stand_alone_have_no_normal() -> None:
    points = np.array([[2.0, 0.0], [2.0, 1.0], [2.0, 1.02], [0.0, 3.0], [-2.0, -2.0]])
    assert not estimate(points).any()
    assert not estimate(points[:1]).any()
    assert estimate(np.empty((0, 2))).shape == (0, 2)


def test_what_is_as_thick_as_long_has_no_normal() -> None:
    points = np.array([2.0, 0.0]) + 0.03 * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0.5]])
    assert not estimate(points).any()
    assert not estimate(np.tile([2.0, 1.0], (6, 1))).any()


def test_a_surface_seen_from_its_edge_has_no_normal() -> None:
    along = np.arange(1.0, 8.0, 0.05)
    normals = estimate(np.column_stack([along, np.full(along.size, 0.5)]), gap_ratio=0.2)
    squareness = 0.5 / np.hypot(along, 0.5)
    assert not normals[squareness < 0.139].any()
    seen = normals[squareness > 0.141]
    assert seen == pytest.approx(np.tile([0.0, -1.0], (len(seen), 1)))


def test_two_neighbours_count_at_any_distance() -> None:
    bend = np.array([[2.0, 3.0], [1.0, 2.0], [0.0, 2.0], [-1.0, 2.0], [-2.0, 3.0]])
    assert estimate(bend, gap_m=2.0, most=1)[2] == pytest.approx([0.0, -1.0])
    assert not estimate(bend, gap_m=2.0, most=2)[2].any(), "over the bend no line fits"
    assert not estimate(bend, gap_m=2.0, radius_m=0.1)[2].any()


def test_a_third_neighbour_counts_within_the_radius_only() -> None:
    hook = np.array([[3.0, 9.0], [2.0, 2.0], [1.0, 2.0], [0.0, 2.0], [-1.0, 2.0], [-2.0, 2.0]])
    assert estimate(hook, gap_m=20.0, radius_m=0.1)[3] == pytest.approx([0.0, -1.0])
    assert not estimate(hook, gap_m=20.0, radius_m=20.0)[3].any()


def test_a_step_in_depth_ends_the_neighbourhood() -> None:
    near = np.column_stack([np.linspace(-0.5, 0.0, 20), np.full(20, 2.0)])
    far = np.column_stack([np.linspace(0.0, 0.5, 20), np.full(20, 2.4)])
    normals = estimate(np.vstack([far[::-1], near[::-1]]))
    assert normals == pytest.approx(np.tile([0.0, -1.0], (40, 1)), abs=1e-9)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    most=st.integers(1, 20),
    radius_m=st.floats(0.0, 0.5),
    gap_ratio=st.floats(0.0, 0.2),
)
def test_agrees_with_the_plain_twin(
    seed: int, most: int, radius_m: float, gap_ratio: float
) -> None:
    random = np.random.default_rng(seed)
    pose = se2(random.uniform(3.5, 6.0), random.uniform(0.5, 4.0), random.uniform(-3.0, 3.0))
    scan = fused(ROOM, pose, beams=120, noise_m=0.01, random=random, origin_base=(0.2, -0.1))
    found = estimate(
        scan.points_base,
        tuple(scan.origin_base),
        gap_ratio=gap_ratio,
        radius_m=radius_m,
        most=most,
    )
    wanted = twin(scan.points_base, scan.origin_base, GAP_M, gap_ratio, radius_m, most)
    assert found == pytest.approx(wanted, abs=1e-6)


def test_normals_of_a_noisy_room_are_those_of_its_walls() -> None:
    random = np.random.default_rng(4)
    upright = walls(((-3, -2), (3, -2), (3, 2), (-3, 2), (-3, -2)))
    scan = fused(upright, se2(0.4, 0.2, 0.0), beams=720, noise_m=0.01, random=random)
    normals = estimate(scan.points_base)
    known = normals.any(axis=1)
    assert known.mean() > 0.9
    assert np.linalg.norm(normals[known], axis=1) == pytest.approx(np.ones(known.sum()))
    turn = np.arccos(np.abs(normals[known]).max(axis=1))
    assert np.degrees(np.median(turn)) < 4.0
    assert (np.einsum("ij,ij->i", normals[known], -scan.points_base[known]) > 0.0).all()
