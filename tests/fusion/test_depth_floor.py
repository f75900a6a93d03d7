"""Floors that the calibration doesn't get quite right, and floors that are none."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.messages import Array
from fusion.depth_floor import Floor, fit_floor


def floor_points(
    rng: np.random.Generator, plane: tuple[float, float, float], count: int = 4000
) -> Array:
    xy = np.column_stack([rng.uniform(0.5, 3.0, count), rng.uniform(-1.5, 1.5, count)])
    z = plane[0] + xy @ plane[1:] + rng.normal(0, 0.004, count)
    return np.column_stack([xy, z])


def fitted(points: Array, tilt_error_rad: float = 0.009) -> Floor:
    count = len(points)
    band = 0.03 + 2 * tilt_error_rad * np.hypot(*points[:, :2].T)
    return fit_floor(points, np.full(count, 0.004), np.full(count, 5.0), tilt_error_rad, band)


@pytest.mark.parametrize("plane", [(0.0, 0.0, 0.0), (0.004, 0.009, -0.005), (-0.003, -0.008, 0.01)])
def test_a_tilted_floor_is_found(plane: tuple[float, float, float]) -> None:
    floor = fitted(floor_points(np.random.default_rng(1), plane))
    assert floor[:3] == pytest.approx(plane, abs=0.001)
    assert floor.doubt_rad < 0.002


def test_low_things_on_it_do_not_lift_it() -> None:
    points = floor_points(np.random.default_rng(2), (0.002, -0.006, 0.004))
    box = (points[:, 0] > 1.5) & (points[:, 0] < 2.1) & (np.abs(points[:, 1]) < 0.9)
    assert 0.1 < box.mean() < 0.2
    points[box, 2] += 0.05
    floor = fitted(points)
    assert floor.height_m + floor.tilt_x * 1.8 == pytest.approx(0.002 - 0.006 * 1.8, abs=0.004)


def test_without_a_floor_the_calibration_holds() -> None:
    nominal = Floor(0.0, 0.0, 0.0, 0.009)
    assert fitted(np.empty((0, 3))) == nominal
    wall = np.column_stack([np.full(500, 2.0), np.linspace(-1, 1, 500), np.linspace(0.2, 1.0, 500)])
    assert fitted(wall) == nominal


def test_a_plane_that_the_calibration_rules_out_is_not_the_floor() -> None:
    rng = np.random.default_rng(3)
    ledge = floor_points(rng, (0.045, 0.0, 0.0))
    assert fitted(ledge)[:3] == (0.0, 0.0, 0.0)


def test_a_mounting_without_error_is_believed() -> None:
    points = floor_points(np.random.default_rng(4), (0.0, 0.005, 0.0))
    assert fitted(points, tilt_error_rad=0.0) == Floor(0.0, 0.0, 0.0, 0.0)


def test_what_was_hardly_seen_is_left_to_the_calibration() -> None:
    """Points in a small patch say the height there, and little about the slope."""
    rng = np.random.default_rng(5)
    points = floor_points(rng, (0.0, 0.0, 0.0), 200)
    points[:, :2] = np.array([1.0, 0.0]) + 0.03 * points[:, :2]
    assert fitted(points).doubt_rad > 0.003
