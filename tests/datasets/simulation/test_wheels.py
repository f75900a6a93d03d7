"""Wheel odometry and gyro have the errors that their formulas state, and no others."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from datasets.messages import Array
from datasets.simulation.drive import Drive, DriveLimits, plan_drive
from datasets.simulation.wheels import (
    NO_WHEEL_ERRORS,
    GyroErrors,
    WheelErrors,
    gyro,
    wheel_odometry,
)

SEEDS = range(600)
WAY_M = 20.0
STRAIGHT = plan_drive([(1.0, 2.0), (1.0, 2.0 + WAY_M)], DriveLimits())
SPIN = plan_drive([(0, 0), (0.5, 0), (0, 0)], DriveLimits(), start_yaw_rad=math.pi)
WINDING = plan_drive([(3, 1), (6, 0), (6, 6), (2, 2)], DriveLimits(), closed=True)


def only(**errors: object) -> WheelErrors:
    return NO_WHEEL_ERRORS.model_copy(update=errors)


def times_of(drive: Drive, count: int) -> Array:
    return np.linspace(0.0, drive.duration_s, count)


def ends(drive: Drive, errors: WheelErrors, count: int = 12) -> Array:
    """Where the odometry of every seed ends, (S, 3)."""
    times_s = times_of(drive, count)
    return np.array([wheel_odometry(drive, times_s, errors, seed)[-1] for seed in SEEDS])


def assert_sigma(sample: Array, sigma: float) -> None:
    """Mean 0 and variance sigma^2, each within four of its own standard errors."""
    assert abs(sample.mean()) < 4.0 * sigma / math.sqrt(sample.size)
    assert abs(sample.var() / sigma**2 - 1.0) < 4.0 * math.sqrt(2.0 / sample.size)


@settings(max_examples=20, deadline=None)
@given(count=st.integers(2, 2000), late_s=st.floats(0.0, 10.0))
def test_without_errors_the_odometry_is_the_drive(count: int, late_s: float) -> None:
    times_s = np.linspace(late_s, WINDING.duration_s + 1.0, count)
    true = WINDING.pose(times_s)
    x, y = (true[:, :2] - true[0, :2]).T
    c, s = math.cos(true[0, 2]), math.sin(true[0, 2])
    expected = np.column_stack([c * x + s * y, -s * x + c * y, true[:, 2] - true[0, 2]])
    odometry = wheel_odometry(WINDING, times_s, NO_WHEEL_ERRORS, 5)
    np.testing.assert_allclose(odometry, expected, atol=1e-10)


def test_the_scale_error_stretches_the_way_by_its_share() -> None:
    ratios = ends(STRAIGHT, only(scale=(0.01, 0.02)))[:, 0] / WAY_M - 1.0
    sizes = np.abs(ratios)
    assert sizes.min() >= 0.01 - 1e-12
    assert sizes.max() <= 0.02 + 1e-12
    assert_sigma((sizes - 0.015) / 0.01 * math.sqrt(12.0), 1.0)
    assert abs((ratios > 0.0).mean() - 0.5) < 4.0 * 0.5 / math.sqrt(ratios.size)


def test_unequal_wheels_bend_a_straight_line_into_an_arc() -> None:
    bend = 0.02
    odometry = wheel_odometry(
        STRAIGHT, times_of(STRAIGHT, 4000), only(bend_rad_per_m=(bend, bend)), 1
    )
    way_m = STRAIGHT.travelled(times_of(STRAIGHT, 4000))[:, 0]
    side = np.sign(odometry[-1, 2])
    np.testing.assert_allclose(odometry[:, 2], side * bend * way_m, atol=1e-12)
    np.testing.assert_allclose(odometry[:, 0], np.sin(bend * way_m) / bend, atol=1e-6)
    np.testing.assert_allclose(odometry[:, 1], side * (1 - np.cos(bend * way_m)) / bend, atol=1e-6)


def test_errors_of_the_wheels_are_those_of_their_rates_on_any_curve() -> None:
    errors = only(scale=(0.3, 0.3), bend_rad_per_m=(0.02, 0.02))
    coarse = wheel_odometry(WINDING, times_of(WINDING, 200), errors, 2)
    # The formula on rates, integrated by small steps. The signs are those that were drawn.
    step_s = WINDING.duration_s / 100_000
    v, omega = WINDING.velocity((np.arange(100_000) + 0.5) * step_s).T
    ends = []
    for scale, bend in ((0.3, 0.02), (0.3, -0.02), (-0.3, 0.02), (-0.3, -0.02)):
        half = errors.track_m / 2.0
        left = (v - half * omega) * (1.0 + scale - bend * half)
        right = (v + half * omega) * (1.0 + scale + bend * half)
        yaw = np.cumsum((right - left) / errors.track_m) * step_s
        way = (left + right) / 2.0 * step_s
        ends.append([way @ np.cos(yaw), way @ np.sin(yaw), yaw[-1]])
    off = np.abs(np.array(ends) - coarse[-1]).max(axis=1)
    assert off.min() < 2.5e-3
    assert np.sort(off)[1] > 0.1


@pytest.mark.parametrize("count", [3, 40])
def test_noise_of_the_way_grows_with_its_root_however_it_is_sampled(count: int) -> None:
    last = ends(STRAIGHT, only(way_noise_m=0.03), count)
    assert_sigma(last[:, 0] - WAY_M, 0.03 * math.sqrt(WAY_M))
    np.testing.assert_allclose(last[:, 1:], 0.0, atol=1e-12)


@pytest.mark.parametrize("count", [3, 40])
def test_noise_of_the_turn_grows_with_the_way_however_it_is_sampled(count: int) -> None:
    last = ends(STRAIGHT, only(turn_noise_per_way_rad=0.01), count)
    assert_sigma(last[:, 2], 0.01 * math.sqrt(WAY_M))
    # The yaw's walk, integrated twice: lateral variance sigma^2 L^3 / 3, for fine steps.
    if count == 40:
        assert_sigma(last[:, 1], 0.01 * math.sqrt(WAY_M**3 / 3.0))


def test_noise_of_the_turn_grows_with_the_turn() -> None:
    turned = 2.0 * math.pi  # two halves: to the first leg, and back
    assert SPIN.travelled([SPIN.duration_s])[0, 1] == pytest.approx(turned)
    yaws = ends(SPIN, only(turn_noise_rad=0.02))[:, 2] - SPIN.pose([SPIN.duration_s])[0, 2]
    assert_sigma(yaws + math.pi, 0.02 * math.sqrt(turned))


def test_slip_comes_in_bouts_of_the_stated_share() -> None:
    errors = only(slip_bouts_per_m=0.2, slip_bout_m=0.5, slip_share=0.3)
    last = ends(STRAIGHT, errors, 200)
    # Grip and bouts alternate, exponential: P(bout at x) = f (1 - exp(-k x)).
    k = 0.2 + 1.0 / 0.5
    in_bouts_m = 0.2 / k * (WAY_M - (1.0 - math.exp(-k * WAY_M)) / k)
    times_s = times_of(STRAIGHT, 200)
    way_m = np.diff(STRAIGHT.travelled(times_s)[:, 0])
    excess = []
    for seed in SEEDS:
        odometry = wheel_odometry(STRAIGHT, times_s, errors, seed)
        step_m = np.hypot(*np.diff(odometry[:, :2], axis=0).T)
        excess.append(step_m / way_m - 1.0)
    shares = np.array(excess)
    assert shares.min() > -1e-9
    assert shares.max() < 0.3 + 1e-9
    in_vain_m = shares @ way_m
    error_m = in_vain_m.std() / math.sqrt(in_vain_m.size)
    assert abs(in_vain_m.mean() - in_bouts_m * 0.15) < 4.0 * error_m
    # Most of the way has none at all; where there is some, the neighbours have it as well.
    slipping = shares > 1e-9
    assert abs(slipping.mean() - (0.2 / k + 0.2 * 0.1)) < 0.03  # a step of 0.1 m may touch a bout
    assert (slipping[:, 1:] & slipping[:, :-1]).mean() > 0.6 * slipping.mean()
    # Wheels slip by themselves, so that the base seems to turn, to either side.
    assert abs(last[:, 2].mean()) < 4.0 * last[:, 2].std() / math.sqrt(last.shape[0])
    assert last[:, 2].std() > 0.1


def test_a_base_turning_on_the_spot_may_slip() -> None:
    errors = only(slip_bouts_per_m=5.0, slip_bout_m=0.5, slip_share=0.3)
    turning_s = np.linspace(0.0, 5.0, 50)
    assert SPIN.travelled([5.0])[0, 0] == 0.0
    yaws = [wheel_odometry(SPIN, turning_s, errors, seed)[-1, 2] for seed in range(30)]
    true = SPIN.pose([5.0])[0, 2] - SPIN.pose([0.0])[0, 2]
    assert np.mean(yaws) / true > 1.01  # wheels in vain make the turn seem larger


def test_a_base_that_stands_measures_nothing() -> None:
    standing = plan_drive([(1, 1)], DriveLimits(), waits_s={0: 5.0})
    odometry = wheel_odometry(standing, np.linspace(0.0, 5.0, 100), WheelErrors(), 3)
    np.testing.assert_array_equal(odometry, 0.0)


def test_the_defaults_are_a_base_that_needs_slam() -> None:
    ring = plan_drive([(0, 0), (40, 0), (40, 48), (0, 48)], DriveLimits(), closed=True)
    times_s = np.linspace(0.0, ring.duration_s, 3000)
    gaps_m = [
        math.hypot(*wheel_odometry(ring, times_s, WheelErrors(), seed)[-1, :2]) for seed in range(8)
    ]
    assert min(gaps_m) > 3.0
    assert max(gaps_m) < 100.0


def test_a_seed_repeats_bit_by_bit_and_later_times_change_nothing() -> None:
    times_s = times_of(WINDING, 900)
    first = wheel_odometry(WINDING, times_s, WheelErrors(), 11)
    np.testing.assert_array_equal(first, wheel_odometry(WINDING, times_s, WheelErrors(), 11))
    part = wheel_odometry(WINDING, times_s[:400], WheelErrors(), 11)
    np.testing.assert_allclose(first[:400], part, atol=1e-12)
    other = wheel_odometry(WINDING, times_s, WheelErrors(), 12)
    assert np.abs(first - other).max() > 0.01
    readings = gyro(WINDING, times_s, GyroErrors(), 11)
    np.testing.assert_array_equal(readings, gyro(WINDING, times_s, GyroErrors(), 11))
    np.testing.assert_array_equal(readings[:400], gyro(WINDING, times_s[:400], GyroErrors(), 11))


def test_a_gyro_without_errors_is_the_turn_rate() -> None:
    none = GyroErrors(noise_rad_s=0.0, bias_rad_s=0.0, bias_walk_rad_s=0.0)
    times_s = times_of(WINDING, 500)
    np.testing.assert_array_equal(gyro(WINDING, times_s, none, 1), WINDING.velocity(times_s)[:, 1])


def test_the_gyro_is_noisy_biased_and_its_bias_walks() -> None:
    times_s = np.linspace(0.0, STRAIGHT.duration_s, 50)

    def readings(**errors: float) -> Array:
        none = {"noise_rad_s": 0.0, "bias_rad_s": 0.0, "bias_walk_rad_s": 0.0}
        section = GyroErrors(**{**none, **errors})
        return np.array([gyro(STRAIGHT, times_s, section, seed) for seed in SEEDS])

    noise = readings(noise_rad_s=0.004)
    assert_sigma(noise.ravel(), 0.004)
    lagged = (noise[:, 1:] * noise[:, :-1]).mean() / 0.004**2
    assert abs(lagged) < 4.0 / math.sqrt(noise[:, 1:].size)
    bias = readings(bias_rad_s=0.01)
    assert np.ptp(bias, axis=1).max() == 0.0
    assert_sigma(bias[:, 0], 0.01)
    walk = readings(bias_walk_rad_s=0.001)
    np.testing.assert_array_equal(walk[:, 0], 0.0)
    for index in (10, 49):
        assert_sigma(walk[:, index], 0.001 * math.sqrt(times_s[index]))


def test_the_sensors_of_a_drive_share_a_seed_but_no_noise() -> None:
    times_s = times_of(STRAIGHT, 500)
    odometry = wheel_odometry(STRAIGHT, times_s, only(way_noise_m=1.0), 4)
    way_m = np.diff(STRAIGHT.travelled(times_s)[:, 0])
    wheels = (np.diff(odometry[:, 0]) - way_m) / np.sqrt(way_m)
    white = GyroErrors(noise_rad_s=1.0, bias_rad_s=0.0, bias_walk_rad_s=0.0)
    readings = gyro(STRAIGHT, times_s, white, 4)
    plain = np.random.default_rng(4).standard_normal(3000)  # another sensor's, by the same seed
    numbers = [set(np.round(draws, 6).tolist()) for draws in (wheels, readings, plain)]
    for one, other in combinations(numbers, 2):
        assert len(one & other) < 10  # some of a thousand pairs agree to six digits


def test_times_that_do_not_increase_are_refused() -> None:
    for times_s in ([0.0, 1.0, 1.0], [], [[0.0]]):
        with pytest.raises(ValueError, match="increase"):
            wheel_odometry(STRAIGHT, times_s, WheelErrors(), 1)
        with pytest.raises(ValueError, match="increase"):
            gyro(STRAIGHT, times_s, GyroErrors(), 1)


def test_a_span_the_wrong_way_round_is_refused() -> None:
    with pytest.raises(ValidationError, match="the smaller first"):
        WheelErrors(scale=(0.02, 0.01))
