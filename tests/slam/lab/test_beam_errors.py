"""Beams of scans whose ranges are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datasets.messages import Array
from fusion.scan import CAMERA, LIDAR, FusedScan
from slam.lab.drives.beam_errors import (
    BEAMS_DEG,
    beam_errors,
    bearings_of,
    ranges_at,
)

BEAMS = np.array(BEAMS_DEG, dtype=np.float64)


def scan(bearings_rad: Array, ranges_m: Array, low: Array | None = None) -> FusedScan:
    """A scan from (0.1, -0.2) in the base; low : (K, 2) bearing and range of the camera layer."""
    origin = np.array([0.1, -0.2])
    low = np.empty((0, 2)) if low is None else low
    bearing, range_m = np.append(bearings_rad, low[:, 0]), np.append(ranges_m, low[:, 1])
    layer = np.repeat(np.array([0, 1], dtype=np.uint8), [bearings_rad.size, len(low)])
    points = origin + range_m[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    return FusedScan(
        stamp_ns=0,
        sensor="scan",
        origin_base=origin,
        points_base=points,
        offsets_s=np.empty(0),
        source=np.where(layer == 1, CAMERA, LIDAR).astype(np.uint8),
        beam_spacing_rad=0.005,
        layer=layer,
        variance_m2=np.full(range_m.size, 1e-4),
        lidar_range_m=np.where(layer == 0, range_m, np.nan),
        camera_range_m=np.where(layer == 1, range_m, np.nan),
    )


def test_beams_count_from_backwards_counter_clockwise() -> None:
    np.testing.assert_allclose(np.degrees(bearings_of(BEAMS))[[0, 5]], [-180.0, 0.0])
    assert np.degrees(bearings_of(BEAMS))[6] == pytest.approx(36.0)  # 216 deg: forward, to the left


def test_ranges_are_taken_by_bearing_from_the_sensor() -> None:
    bearings = np.radians(np.arange(-180.0, 180.0, 0.28))
    ranges = 2.0 + 0.5 * np.cos(bearings - 1.0)
    found = ranges_at(scan(bearings, ranges), bearings_of(BEAMS), np.radians(0.5))
    np.testing.assert_allclose(found, 2.0 + 0.5 * np.cos(bearings_of(BEAMS) - 1.0), atol=3e-3)


def test_a_stray_point_does_not_matter_and_backwards_is_one_direction() -> None:
    bearings = np.radians([179.7, 179.9, -179.9, -179.7, -179.6])
    found = ranges_at(
        scan(bearings, np.array([0.7, 0.71, 0.72, 0.73, 9.0])), np.array([-np.pi]), np.radians(0.5)
    )
    assert found.tolist() == pytest.approx([0.72])


def test_the_nearer_layer_counts_and_nothing_is_nothing() -> None:
    bearings = np.radians(np.arange(-20.0, 20.0, 0.25))
    low = np.column_stack([np.radians([-0.2, 0.0, 0.2]), [1.0, 1.013, 1.02]])
    both = scan(bearings, np.full(bearings.size, 2.06), low)
    found = ranges_at(both, bearings_of(BEAMS), np.radians(0.5))
    assert found[5] == pytest.approx(1.013)
    assert np.isnan(np.delete(found, 5)).all()
    farther = scan(bearings, np.full(bearings.size, 0.9), low)
    assert ranges_at(farther, bearings_of(BEAMS), np.radians(0.5))[5] == pytest.approx(0.9)


def test_errors_of_many_scans() -> None:
    """Beam k reads k mm too long or too short by turns; one beam is missing once."""
    actual = np.linspace(0.5, 2.3, 10)
    off = np.arange(10) * 1e-3
    ranges = np.array([actual + off, actual - off, actual + off, actual - off])
    ranges[3, 7] = np.inf
    errors = beam_errors(ranges, actual, BEAMS)
    np.testing.assert_allclose(errors.mean_m[:7], actual[:7])
    np.testing.assert_allclose(errors.std_m[:7], off[:7], atol=1e-12)
    assert errors.mean_m[7] == pytest.approx(actual[7] + 0.007 / 3)
    assert errors.counts.tolist() == [4] * 7 + [3] + [4] * 2
    assert errors.mae_m[0] == pytest.approx(0.0045)
    assert errors.rmse_m[0] == pytest.approx(np.sqrt(28.5e-6))
    assert errors.mae_m[3] == pytest.approx((0.045 - 0.007) / 9)
    assert errors.missing == 1
    assert "n = 4 scans of 10 beams, 1 readings missing" in str(errors)


def test_scans_without_any_beam_are_no_zero() -> None:
    errors = beam_errors(np.empty((0, 10)), np.ones(10), BEAMS)
    assert np.isnan(errors.mean_m).all()
    assert "no beam" in str(errors)
    empty = beam_errors(np.full((2, 10), np.nan), np.ones(10), BEAMS)
    assert np.isnan(empty.mae_m).all()
    assert empty.missing == 20


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="beams"):
        beam_errors(np.ones((2, 9)), np.ones(10), BEAMS)
    with pytest.raises(ValueError, match="finite"):
        beam_errors(np.ones((2, 10)), np.zeros(10), BEAMS)


@given(errors=st.lists(st.floats(-1, 1), min_size=1, max_size=12), scale=st.floats(0.1, 10.0))
def test_rmse_is_at_least_mae_and_both_scale(errors: list[float], scale: float) -> None:
    actual, beams = np.full(len(errors), 20.0), np.arange(len(errors), dtype=np.float64)
    one = beam_errors(actual + np.array([errors]), actual, beams)
    many = beam_errors(actual + scale * np.array([errors]), actual, beams)
    assert one.rmse_m[0] >= one.mae_m[0] - 1e-12
    assert many.mae_m[0] == pytest.approx(scale * one.mae_m[0], abs=1e-9)
