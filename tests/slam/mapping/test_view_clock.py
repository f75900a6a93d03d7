"""The clock of a second sensor, found by the sharpness of its own map."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.se2 import inverse, se2, transform
from datasets.trajectory import Trajectory
from slam.mapping.camera_records import ViewRecord
from slam.mapping.scan_store import BEAM, CLEAR
from slam.mapping.view_clock import view_clock

RATE_HZ = 10.0
SECONDS = 30.0
START_NS = 1_000_000_000_000


def truth(turn_rad_s: float, speed_m_s: float) -> Trajectory:
    """To and fro and turning, 50 poses a second."""
    times = np.arange(0.0, SECONDS, 0.02)
    x = speed_m_s * 2.0 * np.sin(times / 2.0)
    yaw = turn_rad_s * 3.0 * np.sin(times / 3.0)
    poses = [se2(float(a), 0.0, float(b)) for a, b in zip(x, yaw, strict=True)]
    return Trajectory.from_matrices((START_NS + np.round(times * 1e9)).astype(int).tolist(), poses)


def walls(random: np.random.Generator) -> np.ndarray:
    """Points on three walls of a room that has no symmetry, (400, 2), map frame."""
    along = random.random(400)
    sides = random.integers(0, 3, 400)
    ends = np.array(
        [[[4.0, -3.0], [4.0, 2.5]], [[-3.0, 2.5], [4.0, 2.5]], [[-3.5, -3.0], [4.0, -3.0]]]
    )
    return ends[sides, 0] + along[:, None] * (ends[sides, 1] - ends[sides, 0])


def views(trajectory: Trajectory, late_s: float, noise_m: float = 0.01) -> list[ViewRecord]:
    """What a lidar saw of the walls, each view stamped so much later than it was taken."""
    random = np.random.default_rng(4)
    records = []
    for time_s in np.arange(1.0, SECONDS - 1.0, 1.0 / RATE_HZ):
        stamp_ns = START_NS + round(float(time_s) * 1e9)
        T_map_base = se2(*trajectory.at(np.array([stamp_ns]))[0])
        points = transform(inverse(T_map_base), walls(random))
        points += noise_m * random.standard_normal(points.shape)
        free = np.full((5, 2), 30.0)  # rays that met nothing say nothing
        records.append(
            ViewRecord(
                stamp_ns + round(late_s * 1e9),
                "/low",
                np.concatenate([points, free]).astype(np.float32),
                np.array([BEAM] * len(points) + [CLEAR] * 5, dtype=np.uint8),
                np.zeros(2),
                0.0,
            )
        )
    return records


@pytest.mark.parametrize("late_s", [0.1, -0.06, 0.18])
def test_a_clock_that_is_off_is_found(late_s: float) -> None:
    trajectory = truth(0.5, 0.4)
    found = view_clock(views(trajectory, late_s), trajectory)
    assert found is not None
    assert found.offset_s == pytest.approx(-late_s, abs=0.01)
    assert found.cells < found.cells_as_stamped


def test_a_clock_that_is_right_is_left_alone() -> None:
    trajectory = truth(0.5, 0.4)
    assert view_clock(views(trajectory, 0.0), trajectory) is None


def test_a_base_that_stands_tells_nothing() -> None:
    trajectory = truth(0.0, 0.0)
    assert view_clock(views(trajectory, 0.1), trajectory) is None


def test_more_than_the_window_is_not_guessed_at() -> None:
    trajectory = truth(0.5, 0.4)
    assert view_clock(views(trajectory, 0.6), trajectory) is None


def test_few_or_empty_views_tell_nothing() -> None:
    trajectory = truth(0.5, 0.4)
    some = views(trajectory, 0.1)
    assert view_clock(some[:10], trajectory) is None
    blind = [
        ViewRecord(
            v.stamp_ns, v.sensor, v.points_base[:0], v.roles[:0], v.origin_base, v.clear_from_m
        )
        for v in some
    ]
    assert view_clock(blind, trajectory) is None
