"""What wheels get wrong all the time: learned from exact and from noisy matches, and undone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import inverse, se2, xyyaw
from frontend.odometry_errors import MOST_SCALE, OdometryErrors


def wheel_steps(true_steps: list[Array], scale: float, bias_rad_per_m: float) -> list[Array]:
    """What wheels tell of steps: each true metre is 1 + scale of theirs, and turns more."""
    steps = []
    for T in true_steps:
        x, y, yaw = xyyaw(T)
        forward_m = x / (1.0 + scale)
        steps.append(se2(forward_m, y / (1.0 + scale), yaw - bias_rad_per_m * forward_m))
    return steps


def straight(step_m: float, way_m: float) -> list[Array]:
    return [se2(step_m, 0.0, 0.0)] * round(way_m / abs(step_m))


def test_nothing_learned_corrects_nothing() -> None:
    step = se2(0.2, -0.01, 0.3)
    errors = OdometryErrors()
    assert errors.corrected(step) == pytest.approx(step, abs=1e-15)
    assert (errors.scale_error, errors.turn_rad_per_m) == (0.0, 0.0)


@settings(deadline=None, max_examples=60)
@given(
    scale=st.floats(-0.04, 0.04),
    bias=st.floats(-0.08, 0.08),
    step_m=st.sampled_from([0.04, 0.1, 0.5, -0.1]),
    first_yaw=st.floats(-0.3, 0.3),
)
def test_both_errors_are_learned_and_undone(
    scale: float, bias: float, step_m: float, first_yaw: float
) -> None:
    errors = OdometryErrors()
    true = [se2(step_m, 0.0, first_yaw if k == 0 else 0.0) for k in range(round(200 / abs(step_m)))]
    for wheel, step in zip(wheel_steps(true, scale, bias), true, strict=True):
        errors.learn(wheel, step, forward_seen=True)
    assert errors.scale_error == pytest.approx(scale, abs=0.002)
    # the turn's own memory is shorter, and small steps weigh little beside its first doubt
    tolerance = 0.002 + 0.02 * abs(bias)
    assert errors.turn_rad_per_m == pytest.approx(bias, abs=tolerance)
    corrected = errors.corrected(wheel_steps([se2(1.0, 0.0, 0.0)], scale, bias)[0])
    assert xyyaw(corrected)[0] == pytest.approx(1.0, abs=0.004)


@pytest.mark.parametrize("step_m", [0.05, 0.25, -0.25])
def test_the_scale_of_noisy_wheels_is_found_to_a_few_thousandths(step_m: float) -> None:
    """Wheels err by 1 cm after a metre, as the simulated ones; the matches by 3 mm, each time."""
    random = np.random.default_rng(4)
    found = []
    for _ in range(20):
        errors, places_m = OdometryErrors(), np.arange(0.0, 40.0, abs(step_m))
        seen_m = places_m + 0.003 * random.standard_normal(len(places_m))
        for matched_m in np.diff(seen_m) * math.copysign(1.0, step_m):
            noise_m = 0.01 * math.sqrt(abs(step_m)) * random.standard_normal()
            errors.learn(
                se2(step_m / 1.015 + noise_m, 0.0, 0.0), se2(matched_m, 0.0, 0.0), forward_seen=True
            )
        found.append(errors.scale_error)
    assert np.mean(found) == pytest.approx(0.015, abs=0.003)
    assert np.std(found) < 0.003


def test_a_way_that_was_not_seen_teaches_no_scale() -> None:
    errors = OdometryErrors()
    for step in straight(0.1, 20.0):
        errors.learn(step, se2(0.11, 0.0, 0.0), forward_seen=False)
    assert errors.scale_error == 0.0


def test_a_jump_stretches_little_and_nothing_stretches_without_end() -> None:
    errors = OdometryErrors()
    for step in straight(0.1, 10.0):
        errors.learn(step, step, forward_seen=True)
    errors.learn(se2(0.1, 0.0, 0.0), se2(3.0, 0.0, 0.0), forward_seen=True)
    for step in straight(0.1, 1.0):
        errors.learn(step, step, forward_seen=True)
    assert 0.0 < errors.scale_error < 0.005
    for step in straight(0.1, 500.0):
        errors.learn(step, se2(3.0, 0.0, 0.0), forward_seen=True)
    assert MOST_SCALE - 1e-5 < errors.scale_error <= MOST_SCALE


def test_a_changed_scale_is_followed() -> None:
    errors = OdometryErrors()
    for scale in (0.02, -0.01):
        true = straight(0.1, 200.0)
        for wheel, step in zip(wheel_steps(true, scale, 0.0), true, strict=True):
            errors.learn(wheel, step, forward_seen=True)
        assert errors.scale_error == pytest.approx(scale, abs=0.001)


@pytest.mark.parametrize("jitter_m", [0.0, 1e-5, 1e-3])
def test_a_base_that_stands_or_turns_on_the_spot_teaches_nothing(jitter_m: float) -> None:
    for seed in range(10):
        random = np.random.default_rng(seed)
        errors = OdometryErrors()
        for _ in range(2000):
            turn = float(random.uniform(-0.2, 0.2))
            matched = se2(*(0.003 * random.standard_normal(2)), turn)
            wheel = se2(*(jitter_m * random.standard_normal(2)), turn)
            errors.learn(wheel, matched, forward_seen=True)
        assert abs(errors.scale_error) < 0.002
        assert abs(errors.turn_rad_per_m) < 0.002
    there, back = se2(0.3, 0.0, 0.1), inverse(se2(0.3, 0.0, 0.1))
    assert errors.corrected(there) @ errors.corrected(back) == pytest.approx(np.eye(3), abs=0.01)


@pytest.mark.parametrize("offset_m", [0.013, 0.03, -0.03])
def test_two_lidars_that_do_not_agree_where_they_stand_teach_no_scale(offset_m: float) -> None:
    """Scans of the second come 10 ms after those of the first, and are laid offset_m farther."""
    errors = OdometryErrors()
    for _ in range(400):
        errors.learn(se2(0.005, 0.0, 0.0), se2(0.005 + offset_m, 0.0, 0.0), forward_seen=True)
        errors.learn(se2(0.045, 0.0, 0.0), se2(0.045 - offset_m, 0.0, 0.0), forward_seen=True)
    assert abs(errors.scale_error) < 0.002


def test_slip_at_the_start_is_not_taken_for_the_size_of_the_wheels() -> None:
    errors = OdometryErrors()
    for way_m, share in ((3.0, 0.8), (10.0, 1.0)):
        for step in straight(0.1, way_m):
            errors.learn(step, se2(0.1 * share, 0.0, 0.0), forward_seen=True)
    assert -0.012 < errors.scale_error < 0.0
