"""The walls' direction is found to a tenth of a degree, and turning undoes it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datasets.messages import Array
from datasets.se2 import inverse, se2, transform, wrap_rad
from datasets.trajectory import Trajectory
from slam.mapping.scan_store import ScanStore
from slam.mapping.wall_alignment import find_wall_direction, map_points, turned

QUARTER = math.pi / 2


def building(rng: np.random.Generator, noise_m: float) -> Array:
    """Points on the walls of rooms along a corridor, a slanted wall, and furniture."""
    walls = [
        (0, 0, 20, 0), (0, 2.1, 20, 2.1), (0, 0, 0, 2.1), (20, 0, 20, 7), (4, 2.1, 4, 7),
        (11, 2.1, 11, 7), (4, 7, 20, 7), (0, 3, 4, 6),
    ]  # fmt: skip
    along = [
        np.array(w[:2]) + np.linspace(0, 1, int(40 * math.dist(w[:2], w[2:])))[:, None]
        * (np.array(w[2:]) - np.array(w[:2]))
        for w in walls
    ]  # fmt: skip
    furniture = rng.uniform((4, 2.1), (20, 7), (400, 2))
    points: Array = np.vstack([*along, furniture]) + 0.017
    return points + rng.normal(0.0, noise_m, points.shape)


@pytest.mark.parametrize("angle_deg", [0.0, 0.07, 12.34, 44.9, 45.1, 60.0, -33.3, 179.95])
@pytest.mark.parametrize("noise_m", [0.005, 0.03])
def test_direction_is_found_to_a_tenth_of_a_degree(angle_deg: float, noise_m: float) -> None:
    angle = math.radians(angle_deg)
    points = transform(se2(3.0, -8.0, angle), building(np.random.default_rng(5), noise_m))
    found = find_wall_direction(points)
    assert found is not None
    assert -math.pi / 4 < found.yaw_rad <= math.pi / 4
    error = (found.yaw_rad - angle + QUARTER / 2) % QUARTER - QUARTER / 2
    assert abs(math.degrees(error)) < 0.1
    assert found.contrast > 2.0


def test_a_round_room_has_no_contrast() -> None:
    angles = np.linspace(0.0, 2 * math.pi, 2000, endpoint=False)
    found = find_wall_direction(5.0 * np.column_stack([np.cos(angles), np.sin(angles)]))
    assert found is not None
    assert found.contrast < 1.1


def test_too_few_points_have_no_direction() -> None:
    assert find_wall_direction(np.zeros((1, 2))) is None
    assert find_wall_direction(np.zeros((0, 2))) is None
    assert find_wall_direction(np.zeros((5, 2))) is not None, "all in one place is no crash"


def test_turning_moves_poses_as_one_rigid_body() -> None:
    rng = np.random.default_rng(2)
    before = Trajectory(np.arange(20), rng.uniform([-9, -9, -3], [9, 9, 3], (20, 3)))
    after = turned(before, 0.4)
    for T_map_base, T_turned_base in zip(before.matrices(), after.matrices(), strict=True):
        np.testing.assert_allclose(T_turned_base, se2(0, 0, -0.4) @ T_map_base, atol=1e-12)
    back = turned(after, -0.4)
    np.testing.assert_allclose(back.xyyaw, before.xyyaw, atol=1e-12)


def test_map_points_are_the_hits_in_the_map_once_a_place() -> None:
    """The same three marks seen from 30 poses by two lidars; one return is too long."""
    rng = np.random.default_rng(8)
    marks = np.array([[1.02, 2.03], [-3.02, 0.53], [4.02, -1.02]])
    rows = rng.uniform([-2, -2, -3], [2, 2, 3], (30, 3))
    points = [np.vstack([transform(inverse(se2(*row)), marks), [[50.0, 0.0]]]) for row in rows]
    scans = ScanStore.from_scans(
        list(range(30)), ["a", "b"] * 15, points, {"a": (0.2, 0.0), "b": (-0.2, 0.1)}
    )
    found = map_points(scans, Trajectory(np.arange(30), rows), 20.0)
    order = np.lexsort(found.T)
    np.testing.assert_allclose(found[order], marks[np.lexsort(marks.T)], atol=1e-5)


def test_found_direction_lays_walls_on_the_axes() -> None:
    points = transform(se2(0.0, 0.0, 0.3), building(np.random.default_rng(1), 0.01))
    found = find_wall_direction(points)
    assert found is not None
    trajectory = turned(Trajectory(np.array([0]), np.array([[0.0, 0.0, 0.3]])), found.yaw_rad)
    assert abs(math.degrees(wrap_rad(trajectory.xyyaw[0, 2]))) < 0.1
