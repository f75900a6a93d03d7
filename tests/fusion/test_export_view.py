"""The well-formed laser scan of a fused scan."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from datasets.messages import Array
from datasets.normalise import laser_scan
from fusion.compensation import Compensation, CompensationConfig
from fusion.export_view import laser_view
from fusion.placed_points import PlacedView
from fusion.scan import FusedScan
from tests.fusion.views import WALLS, box, cast, clockwise, pseudo_of, sweep_of

STILL = np.zeros(3)


def points(places: Array, offsets: Array | None = None) -> FusedScan:
    times = np.empty(0) if offsets is None else offsets
    spread = np.full(len(places), 1e-4)
    return FusedScan.of_lidar(9, "lidar", np.array([0.5, 0.0]), places, times, 0.01, spread)


def test_the_reader_takes_it_as_it_is() -> None:
    """Written as the fields of a message and read back, nothing is changed or remarked on."""
    turned = clockwise()
    sweep = sweep_of(cast(WALLS, np.zeros(2), turned), turned)
    ahead = np.linspace(-0.7, 0.7, 280)
    seen = cast([*WALLS, *box(1.5, -0.2, 0.4, 0.4)], np.array([0.15, 0.0]), ahead)
    views = [PlacedView(pseudo_of(ahead, seen, 0.02), np.eye(3))]
    fused = Compensation(CompensationConfig()).fuse(sweep, views, STILL)
    view = laser_view(fused, STILL, range_max_m=8.0)
    notes: Counter[str] = Counter()
    increments = np.diff(view.bearings_rad)
    assert increments == pytest.approx(increments[0])
    back = laser_scan(
        stamp_ns=view.stamp_ns,
        lidar=view.lidar,
        ranges=view.ranges_m.astype(np.float32),
        angle_min_rad=float(view.bearings_rad[0]),
        angle_max_rad=float(view.bearings_rad[-1]),
        angle_increment_rad=float(increments[0]),
        time_increment_s=0.0,
        range_min_m=view.range_min_m,
        range_max_m=view.range_max_m,
        masks_rad=(),
        notes=notes,
    )
    assert back is not None
    assert notes == Counter()
    assert back.ranges_m == pytest.approx(view.ranges_m, abs=1e-6)
    assert back.bearings_rad == pytest.approx(view.bearings_rad)
    # the box before the wall ahead, and nothing beyond 8 m
    assert view.ranges_m[360] == pytest.approx(1.5, abs=0.01)
    assert np.isinf(view.ranges_m[0])
    assert view.ranges_m[180] == pytest.approx(1.2, abs=0.01)


def test_the_count_is_constant_and_the_nearest_of_a_direction_stays() -> None:
    at = np.array([[2.5, 0.0], [1.5, 0.001], [0.5, 3.0], [-60.0, 0.1]])
    for some in (at, at[:3], at[:0]):
        view = laser_view(points(some), STILL, beams=8, range_max_m=50.0)
        assert view.bearings_rad == pytest.approx(np.radians(np.arange(8) * 45.0 - 180.0))
        assert view.ranges_m.shape == (8,)
    assert laser_view(points(at), STILL, beams=8).ranges_m == pytest.approx(
        [np.inf, np.inf, np.inf, np.inf, 1.0, np.inf, 3.0, np.inf], abs=1e-6
    )


def test_backwards_from_either_side_is_one_direction() -> None:
    at = np.array([[-1.5, 1e-9], [-2.5, -1e-9]])
    view = laser_view(points(at), STILL, beams=360)
    assert np.flatnonzero(np.isfinite(view.ranges_m)).tolist() == [0]
    assert view.ranges_m[0] == pytest.approx(2.0)


def test_it_is_seen_from_the_middle_of_the_turn() -> None:
    at = np.array([[2.5, 0.0], [0.5, 2.0]])
    view = laser_view(points(at, np.array([0.0, 0.2])), np.array([1.0, 0.0, 0.0]), beams=4)
    assert view.stamp_ns == 9 + 100_000_000
    assert view.ranges_m[2] == pytest.approx(1.9)
    assert view.ranges_m[3] == pytest.approx(math.hypot(0.1, 2.0))


def test_numbers_that_make_no_scan_are_refused() -> None:
    with pytest.raises(ValueError, match="no scan"):
        laser_view(points(np.ones((1, 2))), STILL, beams=1)
    with pytest.raises(ValueError, match="no scan"):
        laser_view(points(np.ones((1, 2))), STILL, range_max_m=math.inf)
