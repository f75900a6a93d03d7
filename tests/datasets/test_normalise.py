"""Scans as drivers write them: what each value and each angle becomes."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datasets import normalise
from datasets.messages import LaserScan
from datasets.normalise import beam_bearings, laser_scan, mask_beams, normalise_ranges

INF, NAN = math.inf, math.nan
DEG = math.pi / 180.0


def read(ranges: list[float], notes: Counter[str], **fields: object) -> LaserScan | None:
    given_fields = {
        "stamp_ns": 1,
        "lidar": "/scan",
        "ranges": ranges,
        "angle_min_rad": 0.0,
        "angle_max_rad": 0.1 * (len(ranges) - 1),
        "angle_increment_rad": 0.1,
        "time_increment_s": 0.0,
        "range_min_m": 0.1,
        "range_max_m": 16.0,
        "masks_rad": (),
        "notes": notes,
    }
    return laser_scan(**(given_fields | fields))  # type: ignore[arg-type]


def test_every_kind_of_range_becomes_what_rep_117_says() -> None:
    ranges = np.array([0.0, -0.0, -1.0, NAN, INF, -INF, 0.05, 0.1, 15.99, 16.0, 65.535])
    notes: Counter[str] = Counter()
    normalise_ranges(ranges, 0.1, 16.0, notes)
    expected = [INF, INF, NAN, NAN, INF, -INF, -INF, 0.1, 15.99, INF, INF]
    np.testing.assert_array_equal(ranges, expected)
    assert notes == {
        normalise.ZERO: 2,
        normalise.NEGATIVE: 1,
        normalise.INVALID: 1,
        normalise.NEAR: 1,
        normalise.FAR: 2,
    }


@given(
    st.lists(st.floats(width=32), min_size=1, max_size=40),
    st.sampled_from([0.0, 0.05, 0.28]),
    st.sampled_from([0.3, 5.6, 81.8]),
)
def test_normal_ranges_are_within_limits_and_stay(
    values: list[float], range_min_m: float, range_max_m: float
) -> None:
    ranges = np.array(values, dtype=np.float64)
    notes: Counter[str] = Counter()
    normalise_ranges(ranges, range_min_m, range_max_m, notes)
    finite = ranges[np.isfinite(ranges)]
    assert (finite > 0.0).all()
    assert (finite <= range_max_m).all()
    assert (finite >= range_min_m * (1 - 1e-6)).all()
    kept = np.isfinite(ranges)
    np.testing.assert_array_equal(ranges[kept], np.array(values)[kept])
    once = ranges.copy()
    again: Counter[str] = Counter()
    normalise_ranges(once, range_min_m, range_max_m, again)
    np.testing.assert_array_equal(once, ranges)
    assert set(again) <= {normalise.INVALID}
    changed = ~((ranges == np.array(values)) | (np.isnan(ranges) & np.isnan(values)))
    assert sum(notes.values()) - notes[normalise.INVALID] == np.count_nonzero(changed)


def test_a_float32_range_max_is_still_no_return() -> None:
    notes: Counter[str] = Counter()
    scan = read([float(np.float32(5.6)), 5.599], notes, range_max_m=5.6)
    assert scan is not None
    np.testing.assert_array_equal(scan.ranges_m, [INF, 5.599])


def test_clockwise_scans_get_falling_bearings() -> None:
    bearings, note = beam_bearings(math.pi, -math.pi, -math.pi / 4, 9)
    assert note is None
    np.testing.assert_allclose(bearings, np.linspace(math.pi, -math.pi, 9), atol=1e-15)


def test_181_beams_for_180_degrees_lie_on_whole_degrees() -> None:
    bearings, note = beam_bearings(-90 * DEG, 90 * DEG, DEG, 181)
    assert note is None
    np.testing.assert_allclose(bearings / DEG, np.arange(-90, 91), atol=1e-12)
    bearings, note = beam_bearings(-90 * DEG, 89 * DEG, DEG, 181)  # angle_max one beam off
    assert note is None
    assert bearings[-1] / DEG == pytest.approx(90.0)


def test_a_count_that_varies_is_spread_over_the_turn_or_trusts_the_increment() -> None:
    # The increment of 720 beams a turn, but 1286 came: they can only be spread over the turn.
    bearings, note = beam_bearings(-math.pi, math.pi, 2 * math.pi / 720, 1286)
    assert note == normalise.SPREAD
    assert bearings[-1] == pytest.approx(math.pi)
    # Half of the beams came: the first half of the turn.
    bearings, note = beam_bearings(-math.pi, math.pi, 2 * math.pi / 720, 361)
    assert note == normalise.INCREMENT
    assert bearings[-1] == pytest.approx(0.0)
    bearings, note = beam_bearings(-1.0, 1.0, 0.0, 5)
    assert note == normalise.SPREAD
    np.testing.assert_allclose(bearings, [-1.0, -0.5, 0.0, 0.5, 1.0])


@given(
    st.floats(-4, 4),
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(-1, 1),
    st.integers(1, 2000),
)
def test_bearings_are_finite_and_as_many_as_beams(
    start: float, end: float, increment: float, count: int
) -> None:
    bearings, _ = beam_bearings(start, end, increment, count)
    assert bearings.shape == (count,)
    assert np.isfinite(bearings).all()
    assert bearings[0] == start


def test_masks_may_pass_pi_and_include_their_ends() -> None:
    bearings = np.arange(-180, 180, 10) * DEG
    notes: Counter[str] = Counter()
    ranges = np.ones(36)
    mask_beams(ranges, bearings, [(170 * DEG, -160 * DEG), (0.0, 20 * DEG)], notes)
    masked = [round(b / DEG) for b, r in zip(bearings, ranges, strict=True) if np.isnan(r)]
    assert masked == [-180, -170, -160, 0, 10, 20, 170]
    assert notes == {normalise.MASKED: 7}
    turned = np.ones(36)  # the same directions, told as 0..360 degrees
    mask_beams(turned, bearings % (2 * math.pi), [(170 * DEG, 200 * DEG), (0, 20 * DEG)], notes)
    np.testing.assert_array_equal(turned, ranges)


def test_scans_that_are_none_are_counted() -> None:
    notes: Counter[str] = Counter()
    assert read([], notes, angle_max_rad=0.0) is None
    assert read([1.0], notes, angle_min_rad=NAN) is None
    assert read([1.0], notes, angle_increment_rad=INF) is None
    assert notes == {normalise.NO_BEAMS: 1, normalise.NO_ANGLES: 2}


def test_nonsense_limits_are_replaced() -> None:
    notes: Counter[str] = Counter()
    scan = read([1.0, 50.0], notes, range_min_m=NAN, range_max_m=0.0)
    assert scan is not None
    np.testing.assert_array_equal(scan.ranges_m, [1.0, INF])
    assert (scan.range_min_m, scan.range_max_m) == (0.0, normalise.ASSUMED_RANGE_MAX_M)
    assert notes[normalise.NO_LIMITS] == 1


def test_beam_times_are_taken_only_if_they_can_be() -> None:
    notes: Counter[str] = Counter()
    for increment_s, size in ((0.01, 3), (0.0, 0), (-0.01, 0), (NAN, 0), (5.0, 0)):
        scan = read([1.0, 2.0, 3.0], notes, time_increment_s=increment_s)
        assert scan is not None
        assert scan.beam_offsets_s.size == size
    scan = read([1.0, 2.0, 3.0], notes, time_increment_s=0.01)
    assert scan is not None
    np.testing.assert_allclose(scan.beam_offsets_s, [0.0, 0.01, 0.02])


def test_the_drivers_array_is_left_alone() -> None:
    given_ranges = np.array([0.0, 99.0], dtype=np.float32)
    read(given_ranges, Counter())  # type: ignore[arg-type]
    np.testing.assert_array_equal(given_ranges, [0.0, 99.0])
