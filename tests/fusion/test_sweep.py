"""All beams of a turn: codes for what did not return, and the middle of the turn."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datasets.messages import LaserScan
from datasets.recording import LidarCalibration
from fusion.lidar_only import BeamLimits, LidarProjection
from tests.fusion.views import sweep_of


def tilted(pitch_rad: float) -> LidarCalibration:
    T = np.eye(4)
    c, s = math.cos(pitch_rad), math.sin(pitch_rad)
    T[:3, :3], T[:3, 3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]], (0.3, -0.1, 0.9)
    return LidarCalibration(T)


def test_what_does_not_return_says_why() -> None:
    ranges = np.array([2.0, np.inf, -np.inf, np.nan, 0.2, 25.0, 3.0])
    bearings = np.linspace(0.6, -0.6, 7)
    limits = BeamLimits(min_range_m=0.3, max_range_m=20.0)
    sweep = sweep_of(ranges, bearings, np.arange(7.0) / 100.0, limits=limits)
    assert sweep.bearings_rad == pytest.approx(bearings[::-1])
    wanted = [3.0, np.inf, -np.inf, np.nan, -np.inf, np.inf, 2.0]
    assert sweep.ranges_m == pytest.approx(np.array(wanted), nan_ok=True)
    lost = ~np.isfinite(sweep.ranges_m)
    assert np.isnan(sweep.points_base[lost]).all()
    assert np.isnan(sweep.variance_m2[lost]).all()
    assert sweep.offsets_s == pytest.approx(np.arange(7.0)[::-1] / 100.0)
    assert sweep.middle_s == pytest.approx(0.03)
    assert sweep.moment_ns == 1_030_000_000
    returned = sweep.returns()
    assert returned.points_base == pytest.approx(sweep.points_base[~lost])
    assert returned.offsets_s == pytest.approx([0.06, 0.0])


def test_a_tilted_lidars_ranges_are_horizontal() -> None:
    scan = LaserScan(0, "lidar", np.full(3, 2.0), np.array([-0.5, 0.0, 0.5]), np.empty(0), 0.1, 9.0)
    sweep = LidarProjection(tilted(math.radians(60.0)), BeamLimits()).sweep(scan)
    lengths = np.hypot(*(sweep.points_base - sweep.origin_base).T)
    assert sweep.ranges_m == pytest.approx(lengths)
    assert sweep.ranges_m[1] == pytest.approx(1.0)
    assert sweep.moment_ns == 0
    assert sweep.bearings_rad[2] == pytest.approx(math.atan2(math.sin(0.5), 0.5 * math.cos(0.5)))
