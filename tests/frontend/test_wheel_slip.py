"""Wheels that slip: the turn that odometry makes up is measured, and scans are not skewed by it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array, Odometry
from datasets.se2 import se2, transform
from frontend.local_slam import LocalResult, LocalSlam
from frontend.match import Match
from frontend.motion import Motion, MotionConfig, MotionModel
from frontend.nodes import NodeConfig, NodeKeeper
from frontend.prepared import PreparedScan, prepare
from frontend.tracker import Anew, Tracked, as_it_is
from frontend.wheel_slip import MOST_RAD_S, SKEW_RAD, Steps, WheelSlip
from fusion.scan import CAMERA, CAMERA_LAYER, LIDAR, LIDAR_LAYER
from tests.frontend.drives import local_slam
from tests.frontend.rooms import ROOM, box, distances_to_walls, fused, moved, walls

TURN_S = 0.1
TURN_NS = 100_000_000
WHEEL_NS = 10_000_000
SPEED_M_S = 0.5
LONG_HALL = np.concatenate(
    [
        walls(box(-3.0, -1.2, 24.0, 2.4)),
        walls(*[box(0.5 + 2.3 * k, 0.7 if k % 2 else -1.2, 0.9, 0.5) for k in range(8)]),
    ]
)


def step_of(T: Array | None) -> Steps:
    return lambda _from_ns, _to_ns: T


@settings(deadline=None, max_examples=80)
@given(
    slip=st.floats(-MOST_RAD_S, MOST_RAD_S), turn=st.floats(-1.0, 1.0), speed=st.floats(-1.0, 1.0)
)
def test_what_the_matches_turn_beyond_the_expected_is_measured(
    slip: float, turn: float, speed: float
) -> None:
    expected = step_of(moved(np.array([speed, 0.0, turn]), 0.14))
    wheel = WheelSlip()
    first = se2(3.0, -1.0, 2.9)
    second = first @ moved(np.array([speed, 0.0, turn + 0.999 * slip]), 0.14)
    wheel.remember("scan", 0, first)
    found = wheel.measured("scan", 140_000_000, 0.14, second, expected)
    wanted = 0.999 * slip
    if abs(abs(wanted) * 0.14 - SKEW_RAD) > 1e-9:
        assert found == pytest.approx(wanted if abs(wanted) * 0.14 > SKEW_RAD else 0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("sensor", "elapsed_s", "turn_s", "turned_rad", "known"),
    [
        ("front", 0.1, 0.1, 0.05, True),
        ("rear", 0.1, 0.1, 0.05, False),  # its mounting may be off by as much
        ("front", 0.04, 0.1, 0.05, False),  # too near: the noise of the matches
        ("front", 0.5, 0.1, 0.05, False),  # long ago
        ("front", -0.1, 0.1, 0.05, False),
        ("front", 0.1, 0.0, 0.05, False),  # beams without times
    ],
)
def test_where_nothing_can_be_told_nothing_is(
    sensor: str, elapsed_s: float, turn_s: float, turned_rad: float, known: bool
) -> None:
    wheel = WheelSlip()
    wheel.remember("front", 0, np.eye(3))
    asked = (sensor, round(elapsed_s * 1e9), turn_s, se2(0.0, 0.0, turned_rad))
    found = wheel.measured(*asked, step_of(np.eye(3)))
    assert found == (pytest.approx(turned_rad / elapsed_s) if known else None)
    assert wheel.measured(*asked, step_of(None)) is None


def test_a_scan_without_a_match_is_no_measure_for_the_next_of_its_sensor() -> None:
    wheel = WheelSlip()
    for sensor in ("front", "rear"):
        wheel.remember(sensor, 0, np.eye(3))
    wheel.remember("rear", TURN_NS, None)
    T, expected = se2(0.0, 0.0, 0.05), step_of(np.eye(3))
    assert wheel.measured("rear", TURN_NS, TURN_S, T, expected) is None
    assert wheel.measured("front", TURN_NS, TURN_S, T, expected) == pytest.approx(0.5)


def test_slip_holds_for_some_turns_and_no_longer() -> None:
    wheel = WheelSlip()
    assert wheel.turn_rad_s(0) == 0.0
    wheel.learn(0.5, 10 * TURN_NS, TURN_S)
    assert wheel.turn_rad_s(11 * TURN_NS) == 0.5
    assert wheel.turn_rad_s(14 * TURN_NS) == 0.0
    assert wheel.scans == 1
    wheel.learn(0.0, 11 * TURN_NS, TURN_S)
    assert (wheel.turn_rad_s(11 * TURN_NS), wheel.scans) == (0.0, 1)


def test_what_is_too_fast_for_slip_is_not_carried_on() -> None:
    wheel = WheelSlip()
    wheel.learn(MOST_RAD_S + 0.1, 0, TURN_S)
    assert (wheel.turn_rad_s(TURN_NS), wheel.scans) == (0.0, 0)


@pytest.mark.parametrize("leap_rad", [0.3, 2.0])
def test_odometry_that_is_set_back_is_no_slip(leap_rad: float) -> None:
    """A driver that starts again: its heading leaps while the base drives on."""
    truth = np.array([SPEED_M_S, 0.0, 0.0])
    slam, random, start = local_slam(), np.random.default_rng(3), se2(1.2, 1.0, 0.1)
    believed, results = [], []
    for k in range(20):
        T_wheel = se2(-0.5, 0.0, 0.0) @ moved(truth, k * TURN_S)
        if k >= 10:
            T_wheel = se2(0.0, 0.0, leap_rad) @ T_wheel
        slam.add_odometry(Odometry(k * TURN_NS, T_wheel))
        T = start @ moved(truth, k * TURN_S)
        how = {"noise_m": 0.01, "random": random, "velocity_base": truth, "turn_s": TURN_S}
        results.append(slam.add_scan(fused(ROOM, T, stamp_ns=k * TURN_NS, **how)))  # type: ignore[arg-type]
        believed.append(results[-1].tracked.motion.odometry)
        assert abs(slam.motion.slip.turn_rad_s(k * TURN_NS)) == 0.0
    assert all(believed[1:]), "or nothing is tested"
    assert slam.motion.slip.scans == 0
    off = skewed_m(results, ROOM, start)
    assert np.delete(off, [0, 9, 10]).max() < 0.02, "at most the scans around it are skewed"


def test_what_the_map_speaks_against_is_not_learned() -> None:
    class Stubborn:
        """Matches a scan 0.05 rad off, and keeps it though it was made anew."""

        def __init__(self) -> None:
            self.T_odom_base, self.offered = np.eye(3), 0

        def track(self, scan: PreparedScan, motion: Motion, anew: Anew = as_it_is) -> Tracked:
            self.T_odom_base = self.T_odom_base @ motion.T_last_base @ se2(0.0, 0.0, 0.05)
            match = Match(self.T_odom_base, 1e4 * np.eye(3), 0.9, 0.9, 0.01, 0.01, np.eye(2)[0])
            self.offered += anew(match) is not None
            return Tracked(scan, self.T_odom_base, match, motion)

    tracker = Stubborn()
    slam = LocalSlam(MotionModel(MotionConfig()), tracker, NodeKeeper(NodeConfig()))
    slipping_drive(slam, ROOM, se2(1.2, 1.0, 0.1), 5)
    assert tracker.offered >= 3
    assert slam.motion.slip.scans == 0


def test_points_of_views_are_brought_back_as_they_were_brought_there() -> None:
    """De-skewed anew, the beams move by what the match says, the points of views as predicted."""
    truth, predicted = np.array([0.5, 0.0, 0.0]), np.array([0.5, 0.0, 0.6])
    beams = fused(ROOM, se2(1.2, 1.0, 0.1), velocity_base=truth, turn_s=0.14)
    low = np.arange(len(beams.source)) >= 200
    source = np.where(low, CAMERA, LIDAR).astype(np.uint8)
    layer = np.where(low, CAMERA_LAYER, LIDAR_LAYER).astype(np.uint8)
    scan = replace(beams, source=source, layer=layer)
    again, by_match = prepare(scan, truth, predicted), prepare(scan, truth)
    as_predicted = prepare(scan, predicted)
    for part, like in ((LIDAR_LAYER, by_match), (CAMERA_LAYER, as_predicted)):
        points = again.points_base[again.part(part)]
        assert points == pytest.approx(like.points_base[like.part(part)], abs=1e-12)
    assert np.abs(by_match.points_base - as_predicted.points_base).max() > 0.05


def slipping_drive(slam: LocalSlam, segments: Array, start: Array, scans: int) -> list[LocalResult]:
    """Straight on at half a metre a second; the wheels claim a turn in scans 15 to 24, 35 to 44."""
    truth = np.array([SPEED_M_S, 0.0, 0.0])
    T_wheel, results, random = se2(1.0, 2.0, -0.5), [], np.random.default_rng(3)
    slam.add_odometry(Odometry(0, T_wheel))
    for k in range(scans):
        claimed = {1: 0.8, 3: -0.6}.get((k + 5) // 10 - 1, 0.0)
        for step in range(1, 11):
            T_wheel = T_wheel @ moved(truth + np.array([0.0, 0.0, claimed]), 0.01)
            slam.add_odometry(Odometry(k * TURN_NS + step * WHEEL_NS, T_wheel))
        scan = fused(
            segments,
            start @ moved(truth, k * TURN_S),
            noise_m=0.01,
            random=random,
            velocity_base=truth,
            turn_s=TURN_S,
            stamp_ns=k * TURN_NS,
        )
        results.append(slam.add_scan(scan))
    return results


def off_walls_m(scan: PreparedScan, segments: Array, T_world_base: Array) -> float:
    """By how much a scan, laid by its true pose, stands off the walls: its worst tenth."""
    away = distances_to_walls(transform(T_world_base, scan.points_base), segments)
    return float(np.percentile(away, 90))


def skewed_m(results: list[LocalResult], segments: Array, start: Array) -> Array:
    """The same of each scan of a drive straight on."""
    off = []
    for result in results:
        scan = result.tracked.scan
        T = start @ moved(np.array([SPEED_M_S, 0.0, 0.0]), scan.moment_ns * 1e-9)
        off.append(off_walls_m(scan, segments, T))
    return np.array(off)


@pytest.mark.parametrize(
    ("segments", "start", "scans"),
    [(LONG_HALL, se2(-2.0, 0.0, 0.0), 60), (ROOM, se2(1.2, 1.0, 0.1), 50)],
    ids=["hall", "room"],
)
def test_a_slipping_wheel_skews_no_scan(
    monkeypatch: pytest.MonkeyPatch, segments: Array, start: Array, scans: int
) -> None:
    mended = skewed_m(slipping_drive(local_slam(), segments, start, scans), segments, start)
    with monkeypatch.context() as without:
        without.setattr(MotionModel, "matched", lambda *_, **__: None)
        plain = skewed_m(slipping_drive(local_slam(), segments, start, scans), segments, start)
    slipping = np.concatenate([np.arange(15, 25), np.arange(35, 45)])
    assert np.median(plain[slipping]) > 0.03, "or nothing is tested"
    # 1 cm of noise is 0.013 here
    assert np.median(mended[slipping]) < 0.016
    # where slip begins and ends, the step since the last scan tells half of it
    assert np.count_nonzero(mended[1:] > 0.018) <= 4
    assert mended.max() < 0.03


def test_a_slipping_wheel_leaves_no_error_behind() -> None:
    start = se2(-2.0, 0.0, 0.0)
    slam = local_slam()
    results = slipping_drive(slam, LONG_HALL, start, 60)
    assert all(isinstance(result.tracked.outcome, Match) for result in results[1:])
    assert 18 <= slam.motion.slip.scans <= 22, "twice ten"
    first, last = results[0].tracked, results[-1].tracked
    step = np.linalg.inv(first.T_odom_base) @ last.T_odom_base
    true_m = SPEED_M_S * (last.scan.moment_ns - first.scan.moment_ns) * 1e-9
    assert step[:2, 2] == pytest.approx([true_m, 0.0], abs=0.02)
    assert math.atan2(step[1, 0], step[0, 0]) == pytest.approx(0.0, abs=0.003)


def test_without_odometry_a_bend_that_begins_skews_no_scan() -> None:
    """A base that drove straight on turns at a radian a second from one scan to the next."""
    start, random, slam = se2(1.5, 1.0, 0.2), np.random.default_rng(5), local_slam()
    T, off = start, []
    for k in range(20):
        twist = np.array([0.4, 0.0, 1.0 if k >= 10 else 0.0])
        scan = fused(
            ROOM,
            T,
            noise_m=0.01,
            random=random,
            velocity_base=twist,
            turn_s=TURN_S,
            stamp_ns=k * TURN_NS,
        )
        seen = slam.add_scan(scan).tracked.scan
        T_moment = T @ moved(twist, (seen.moment_ns - k * TURN_NS) * 1e-9)
        off.append(off_walls_m(seen, ROOM, T_moment))
        T = T @ moved(twist, TURN_S)
    # 0.05 for some scans if it is taken to go on as it went; the one in which it begins can't be
    # de-skewed: half of its interval was straight
    assert max(off[11:]) < 0.02
