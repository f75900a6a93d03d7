"""Predictions from odometry and without, and the turning error that is learned."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array, Odometry
from datasets.se2 import inverse, se2, transform, xyyaw
from frontend.motion import UNSEEN_M, Motion, MotionConfig, MotionModel
from frontend.prepared import prepare
from tests.frontend.rooms import ROOM, distances_to_walls, fused, moved

S = 1_000_000_000
STEP_NS = S // 10


def model(**settings: float) -> MotionModel:
    return MotionModel(MotionConfig(**settings))


def follow(
    motions: MotionModel, T_true: list[Array], T_wheel: list[Array] | None, start: int = 0
) -> list[Motion]:
    """Poses ten times a second, tracked without error. Returns each prediction."""
    predicted = []
    for k, T in enumerate(T_true):
        stamp_ns = (start + k) * STEP_NS
        if T_wheel is not None:
            assert motions.add_odometry(Odometry(stamp_ns, T_wheel[k]))
        predicted.append(motions.predict(stamp_ns, 0.0))
        step = inverse(T_true[k - 1]) @ T if k else np.eye(3)
        motions.tracked(stamp_ns, step, predicted[-1], reliable=k > 0, forward_sigma_m=0.01)
    return predicted


def chain(steps: list[Array]) -> list[Array]:
    poses = [np.eye(3)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return poses


def test_the_first_scan_is_where_it_is() -> None:
    motion = model().predict(5, 0.1)
    assert (motion.T_last_base == np.eye(3)).all()
    assert not motion.odometry
    assert not motion.velocity_base.any()


def test_odometry_predicts_the_step_it_tells() -> None:
    step = se2(0.1, 0.0, 0.05)
    poses = chain([step] * 20)
    for motion in follow(model(), poses, poses)[1:]:
        assert motion.odometry
        assert motion.elapsed_s == pytest.approx(0.1)
        assert motion.T_last_base == pytest.approx(step)
        assert 0.0 < motion.sigma_m < 0.1


def test_the_odometry_frame_does_not_matter() -> None:
    poses = chain([se2(0.1, 0.02, -0.05)] * 10)
    T_wheel_odom = se2(100.0, -40.0, 2.0)
    there = follow(model(), poses, [T_wheel_odom @ T for T in poses])
    assert there[-1].T_last_base == pytest.approx(se2(0.1, 0.02, -0.05))


@pytest.mark.parametrize("bias", [0.08, -0.03])
@pytest.mark.parametrize("speed", [0.25, -0.25, 0.07])
def test_a_steady_turning_error_is_learned(bias: float, speed: float) -> None:
    random = np.random.default_rng(3)
    count = 2500 if abs(speed) < 0.2 else 900
    turns = random.normal(0.0, 0.02, count)
    wheel = chain([se2(speed, 0.0, turn) for turn in turns])
    true = chain([se2(speed, 0.0, turn + bias * speed) for turn in turns])
    motions = model()
    predicted = follow(motions, true, wheel)
    assert motions.errors.turn_rad_per_m == pytest.approx(bias, rel=0.1)
    x, y, yaw = xyyaw(predicted[-1].T_last_base)
    assert (x, y) == pytest.approx((speed, 0.0), abs=0.005)
    assert yaw == pytest.approx(turns[-1] + bias * speed, abs=0.003)


def test_a_true_odometry_teaches_no_bias_and_an_outlier_little() -> None:
    steps = [se2(0.25, 0.0, 0.05)] * 100
    motions = model()
    wheel = chain(steps)
    follow(motions, wheel, wheel)
    assert motions.errors.turn_rad_per_m == pytest.approx(0.0, abs=1e-12)
    steps[60] = se2(0.25, 0.0, 2.5)
    motions = model()
    follow(motions, chain(steps), wheel)
    assert abs(motions.errors.turn_rad_per_m) < 0.01


def test_odometry_faster_than_the_base_is_not_believed() -> None:
    poses = chain([se2(0.1, 0.0, 0.0)] * 20)
    wheel = [se2(40.0, 0.0, 0.0) @ T if k >= 15 else T for k, T in enumerate(poses)]
    motions = model()
    predicted = follow(motions, poses, wheel)
    assert motions.implausible == 1
    assert [motion.odometry for motion in predicted[13:18]] == [True, True, False, True, True]
    x, y, yaw = xyyaw(predicted[15].T_last_base)
    assert math.hypot(x, y) < 1.0, "what stands in is near what went before"
    assert abs(yaw) < 0.1
    assert predicted[16].T_last_base == pytest.approx(poses[1])


def test_without_odometry_a_base_goes_on_as_it_went() -> None:
    step = se2(0.1, 0.01, 0.02)
    motion = follow(model(), chain([step] * 40), None)[-1]
    assert not motion.odometry
    assert motion.T_last_base == pytest.approx(step, abs=0.005)
    assert motion.velocity_base == pytest.approx([1.0, 0.1, 0.2], abs=0.02)


def test_where_odometry_ends_the_velocity_stands_in() -> None:
    poses = chain([se2(0.1, 0.0, 0.0)] * 40)
    motions = model(odometry_reach_s=0.25)
    follow(motions, poses[:20], poses[:20])
    late = [motions.predict((19 + k) * STEP_NS, 0.0) for k in (1, 2, 3, 5)]
    assert [motion.odometry for motion in late] == [True, True, False, False]


@pytest.mark.parametrize("seen_at", [None, 250])
def test_along_a_bare_corridor_a_base_without_odometry_does_not_go_on_for_ever(
    seen_at: int | None,
) -> None:
    """What nothing shows lies where it was predicted, and would teach the same speed again."""
    motions = model()
    follow(motions, chain([se2(0.1, 0.0, 0.0)] * 20), None)
    way_m = 0.0
    for k in range(21, 400):
        motion = motions.predict(k * STEP_NS, 0.0)
        sigma_m = 0.01 if k == seen_at else 1000.0
        motions.tracked(
            k * STEP_NS, motion.T_last_base, motion, reliable=True, forward_sigma_m=sigma_m
        )
        way_m += float(motion.T_last_base[0, 2])
        if k == 120:
            assert way_m == pytest.approx(10.0, abs=0.2), "a bare stretch that buildings have"
    assert UNSEEN_M <= way_m < UNSEEN_M + 0.2


def test_scans_that_were_not_matched_end_the_velocity_and_widen_the_doubt() -> None:
    motions = model()
    follow(motions, chain([se2(0.1, 0.0, 0.0)] * 20), None)
    sure = motions.predict(21 * STEP_NS, 0.0)
    for k in range(21, 26):
        motions.tracked(k * STEP_NS, np.eye(3), motions.predict(k * STEP_NS, 0.0), reliable=False)
    unsure = motions.predict(26 * STEP_NS, 0.0)
    assert not unsure.velocity_base.any()
    assert unsure.sigma_m > sure.sigma_m
    assert unsure.sigma_rad > sure.sigma_rad


@settings(deadline=None, max_examples=30)
@given(gap_s=st.floats(0.0, 1e6), speed=st.floats(-2.0, 2.0), turn=st.floats(-1.0, 1.0))
def test_any_gap_leaves_a_sane_prediction(gap_s: float, speed: float, turn: float) -> None:
    motions = model()
    follow(motions, chain([se2(0.1 * speed, 0.0, 0.1 * turn)] * 5), None)
    motion = motions.predict(5 * STEP_NS + round(gap_s * S), 0.1)
    x, y, yaw = xyyaw(motion.T_last_base)
    assert math.hypot(x, y) < 3.0
    assert abs(yaw) < 1.5
    assert 0.0 < motion.sigma_m < 2.0
    assert 0.0 < motion.sigma_rad < 2.0


def test_doubt_grows_with_the_way_and_the_turn() -> None:
    def sigmas(step: Array) -> tuple[float, float]:
        motion = follow(model(), [np.eye(3), step], [np.eye(3), step])[1]
        return motion.sigma_m, motion.sigma_rad

    still = sigmas(np.eye(3))
    driven, turned = sigmas(se2(0.5, 0.0, 0.0)), sigmas(se2(0.0, 0.0, 0.5))
    assert driven[0] > still[0]
    assert driven[1] > still[1]
    assert turned[0] > still[0]
    assert turned[1] > still[1]


@pytest.mark.parametrize("velocity", [(0.8, 0.0, 0.0), (0.0, 0.0, 1.0), (0.8, 0.0, 1.0)])
def test_odometry_takes_the_skew_out_of_a_scan(velocity: tuple[float, float, float]) -> None:
    """Odometry 50 times a second; the scan is taken in its middle."""
    twist, turn_s = np.array(velocity), 0.14
    T_world_odom = se2(4.5, 3.5, 0.4)
    motions = model()
    for k in range(40):
        motions.add_odometry(Odometry(k * S // 50, moved(twist, k / 50)))
    motions.tracked(S // 10, np.eye(3), motions.predict(S // 10, 0.0), reliable=False)
    begin_s, middle_s = 0.3, 0.3 + turn_s / 2
    motion = motions.predict(round(middle_s * S), turn_s)
    assert motion.odometry
    smeared = fused(
        ROOM,
        T_world_odom @ moved(twist, begin_s),
        velocity_base=twist,
        turn_s=turn_s,
        stamp_ns=round(begin_s * S),
    )
    scan = prepare(smeared, motion.velocity_base)
    T_world_base = T_world_odom @ moved(twist, scan.moment_ns / S)
    off = distances_to_walls(transform(T_world_base, scan.points_base), ROOM)
    assert off.max() < 0.002


def test_between_two_stamps_the_base_moves_as_odometry_says_or_goes_on() -> None:
    step = se2(0.1, 0.0, 0.05)
    poses = chain([step] * 20)
    known, blind = model(), model()
    follow(known, poses, poses)
    follow(blind, poses, None)
    last_ns = 20 * STEP_NS
    T = known.between(last_ns - 3 * STEP_NS, last_ns - STEP_NS)
    assert pytest.approx(step @ step, abs=1e-9) == T
    assert pytest.approx(inverse(step), abs=1e-9) == known.between(last_ns, last_ns - STEP_NS)
    guessed = blind.between(last_ns, last_ns + STEP_NS // 2)
    assert xyyaw(guessed) == pytest.approx((0.05, 0.0, 0.025), abs=2e-3)


def test_the_velocity_around_a_stamp_is_that_of_the_odometry() -> None:
    poses = chain([moved(np.array([1.0, 0.0, 0.5]), 0.1)] * 20)
    known = model()
    follow(known, poses, poses)
    assert known.velocity(15 * STEP_NS, 0.1) == pytest.approx([1.0, 0.0, 0.5], abs=1e-2)
    assert not known.velocity(15 * STEP_NS, 0.0).any()
    assert not model().velocity(0, 0.1).any()
