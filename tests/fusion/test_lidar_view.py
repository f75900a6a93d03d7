"""A second lidar as a view, and as what it is fused with."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datasets.messages import Array, LaserScan
from datasets.recording import LidarCalibration
from datasets.se2 import se2
from fusion.compensation import Compensation, CompensationConfig
from fusion.lidar_only import BeamLimits
from fusion.lidar_view import SYSTEMATIC_SHARE, LidarView
from fusion.placed_points import PlacedView
from fusion.scan import BOTH, CAMERA
from tests.fusion.views import WALLS, box, cast, clockwise, sweep_of

STILL = np.zeros(3)


def mounted(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> LidarCalibration:
    T = np.eye(4)
    T[np.ix_([0, 1, 3], [0, 1, 3])] = se2(x, y, yaw)
    return LidarCalibration(T)


def laser(ranges: Array, bearings: Array, offsets: Array | None = None) -> LaserScan:
    times = np.empty(0) if offsets is None else offsets
    return LaserScan(1_000, "low", ranges, bearings, times, 0.1, 30.0)


def test_returns_are_surfaces_and_free_up_to_there_the_rest_is_unknown() -> None:
    view = LidarView(mounted(0.3, -0.1, math.pi / 2), BeamLimits(min_range_m=0.2))
    ranges = np.array([2.0, np.inf, 0.15, np.nan, 3.0, -np.inf])
    found = view(laser(ranges, np.radians([-20.0, -10.0, 0.0, 10.0, 20.0, 30.0])), STILL)
    assert np.degrees(found.bearings_rad) == pytest.approx([70.0, 80.0, 90.0, 100.0, 110.0, 120.0])
    nothing = [False, True, True, True, False, True]
    assert np.isnan(found.ranges_m).tolist() == nothing
    assert np.isnan(found.sigma_m).tolist() == nothing
    assert found.ranges_m[[0, 4]] == pytest.approx([2.0, 3.0])
    assert found.free_to_m == pytest.approx([2.0, 0.0, 0.0, 0.0, 3.0, 0.0])
    assert found.free_from_m == pytest.approx(0.2)
    assert found.sigma_m[0] == pytest.approx(0.016)
    assert found.surfaces_base == pytest.approx(found.points_base, abs=1e-6)
    assert (found.stamp_ns, found.sensor) == (1_000, "low")


def test_a_turn_on_the_move_is_seen_as_of_its_middle() -> None:
    twist = np.array([0.7, 0.0, 0.9])
    bearings, offsets = clockwise(360), np.arange(360) * 4e-4
    middle = 0.5 * offsets[-1]
    ranges = np.empty(360)
    for i, dt in enumerate(offsets - middle):
        steps = 300
        T = np.eye(3)
        for _ in range(steps):
            T = T @ se2(*(twist * dt / steps))
        T = T @ se2(0.2, 0.0, 0.0)
        yaw = math.atan2(T[1, 0], T[0, 0])
        ranges[i] = cast(WALLS, T[:2, 2], np.array([bearings[i] + yaw]))[0]
    found = LidarView(mounted(0.2), BeamLimits())(laser(ranges, bearings, offsets), twist)
    x, y = np.abs(found.points_base.T)
    assert np.minimum(np.abs(x - 10.0), np.abs(y - 1.2)).max() < 0.002
    assert found.stamp_ns == 1_000 + round(middle * 1e9)
    assert (np.diff(found.bearings_rad) >= 0.0).all()


def test_a_lidars_ranges_are_trusted_to_tell_a_low_thing_before_a_wall() -> None:
    """25 cm before the wall ahead, 10 m off: less than a camera's ranges tell."""
    turned = clockwise(1440)
    high = sweep_of(cast(WALLS, np.zeros(2), turned), turned)
    ahead = np.linspace(-0.1, 0.1, 60)
    seen = cast([*WALLS, *box(9.75, -0.5, 0.2, 1.0)], np.array([0.4, 0.0]), ahead)
    limits = BeamLimits(noise_m=0.005, noise_per_m=0.001)
    pseudo = LidarView(mounted(0.4), limits)(laser(seen, ahead), STILL)
    compensation = Compensation(CompensationConfig())
    added = []
    for share in (None, SYSTEMATIC_SHARE):
        view = PlacedView(pseudo, np.eye(3), share)
        added.append(np.count_nonzero(compensation.fuse(high, [view], STILL).source == CAMERA))
    assert added[0] == 0
    assert added[1] > 20


def test_a_low_lidar_puts_a_box_into_the_scan_of_a_high_one() -> None:
    low = box(1.5, -0.2, 0.4, 0.4)
    turned = clockwise(1440)
    high = sweep_of(cast(WALLS, np.zeros(2), turned), turned)
    ahead = np.linspace(-1.6, 1.6, 761)
    seen = cast(WALLS + low, np.array([0.4, 0.0]), ahead)
    pseudo = LidarView(mounted(0.4), BeamLimits())(laser(seen, ahead), STILL)
    scan = Compensation(CompensationConfig()).fuse(high, [PlacedView(pseudo, np.eye(3))], STILL)
    found = scan.points_base[scan.source == CAMERA]
    assert len(found) > 80
    assert found[:, 0] == pytest.approx(1.5, abs=1e-6)
    assert found[:, 1].min() < -0.19
    assert found[:, 1].max() > 0.19
    assert np.count_nonzero(scan.source == BOTH) > 400
    walls = scan.points_base[scan.source == BOTH]
    assert np.minimum(np.abs(np.abs(walls[:, 1]) - 1.2), np.abs(walls[:, 0] - 10.0)).max() < 1e-6
