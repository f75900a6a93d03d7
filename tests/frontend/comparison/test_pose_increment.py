"""Pose fusion by increments: the gain, what is applied again after it, and whole drives."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from datasets.messages import Array, Odometry
from datasets.se2 import interpolate, inverse, se2, xyyaw
from frontend.comparison.pose_increment import PoseIncrementConfig, PoseIncrementTracker
from frontend.local_slam import LocalSlam
from frontend.match import Match, Rejected
from frontend.motion import Motion, MotionConfig, MotionModel
from frontend.nodes import NodeConfig, NodeKeeper
from frontend.tracker import LOST, ScanMatchingTracker, TrackerConfig
from tests.frontend.drives import ROUND_THE_ROOM, drive, errors, poses_of, run
from tests.frontend.rooms import CORRIDOR, OTHER_ROOM, ROOM, Line, fused, off_by, prepared

START = se2(4.5, 3.0, 0.0)


def tracker(gain: float = 0.5) -> PoseIncrementTracker:
    return PoseIncrementTracker(PoseIncrementConfig(gain=gain), TrackerConfig())


def local_slam(gain: float = 0.5) -> LocalSlam:
    return LocalSlam(MotionModel(MotionConfig()), tracker(gain), NodeKeeper(NodeConfig()))


def motion_of(T_last_base: Array) -> Motion:
    return Motion(T_last_base, 0.05, 0.05, np.zeros(3), 0.2, True)


def fused_poses(gain: float, error: Array, count: int) -> list[Array]:
    """The fused pose after each scan of a base that stands while its odometry says it moves."""
    standing = tracker(gain)
    scan = prepared(ROOM, START, beams=720)
    poses = []
    for k in range(count):
        standing.track(scan, motion_of(error if k else np.eye(3)))
        poses.append(standing._T_odom_fused)
    return poses


@pytest.mark.parametrize("gain", [0.25, 0.5, 1.0])
def test_a_share_of_each_correction_is_applied(gain: float) -> None:
    """Odometry d off a scan: e -> (1 - gain) (e + d), which tends to d (1 - gain) / gain."""
    d = 0.02
    off_m, wanted = [], 0.0
    for T in fused_poses(gain, se2(d, 0.0, 0.0), 20)[1:]:
        wanted = (1.0 - gain) * (wanted + d)
        off_m.append(float(T[0, 2]) - wanted)
    assert np.abs(off_m).max() < 0.002
    assert wanted == pytest.approx(d * (1.0 - gain) / gain, abs=0.001)


def test_a_correction_turns_the_increments_that_come_after_it() -> None:
    """The increments newer than t_s are applied again, onto the pose that was corrected there."""
    slam = local_slam(0.5)
    slam.add_odometry(Odometry(0, np.eye(3)))
    slam.add_scan(fused(ROOM, START, beams=720))
    # the base stands; its odometry says otherwise, and is two messages ahead of the scan
    slip, newer, newest = se2(0.06, 0.0, 0.08), se2(0.1, 0.0, -0.05), se2(0.1, 0.02, 0.0)
    T_wheel = np.eye(3)
    for k, step in enumerate((slip, newer, newest), start=1):
        T_wheel = T_wheel @ step
        assert slam.add_odometry(Odometry(k * 10**8, T_wheel))
    second = slam.add_scan(fused(ROOM, START, beams=720, stamp_ns=10**8)).tracked
    assert isinstance(second.outcome, Match)
    assert max(off_by(np.eye(3), second.T_odom_base)) < 0.003
    T_corrected = interpolate(slip, second.T_odom_base, 0.5)

    few = fused(ROOM, START, beams=8, stamp_ns=3 * 10**8)  # blind: what is said is the prediction
    third = slam.add_scan(few).tracked
    assert isinstance(third.outcome, Rejected)
    increments = slam.motion.errors.corrected(newer @ newest)  # as far as wheels are known by now
    assert np.allclose(third.T_odom_base, T_corrected @ increments, atol=1e-9)
    assert max(off_by(increments, newer @ newest)) < 0.002


def test_a_scan_is_matched_from_the_fused_pose_at_its_own_stamp() -> None:
    """Between two messages the increment is divided at the moment of the scan."""
    slam = local_slam()
    for k in range(4):
        slam.add_odometry(Odometry(k * 10**8, se2(0.1 * k, 0.0, 0.0)))
    slam.add_scan(fused(ROOM, START, beams=720, stamp_ns=0))
    blind = slam.add_scan(fused(ROOM, START, beams=8, stamp_ns=13 * 10**7)).tracked
    assert xyyaw(blind.T_odom_base) == pytest.approx((0.13, 0.0, 0.0), abs=1e-9)


def test_with_the_whole_gain_it_tracks_as_scan_matching_does() -> None:
    known = drive(ROOM, ROUND_THE_ROOM[:3])
    plain = LocalSlam(
        MotionModel(MotionConfig()), ScanMatchingTracker(TrackerConfig()), NodeKeeper(NodeConfig())
    )
    both = [poses_of(run(slam, known)) for slam in (local_slam(1.0), plain)]
    np.testing.assert_allclose(both[0], both[1], atol=1e-6)


@pytest.mark.parametrize("odometry", [True, False])
def test_a_drive_round_the_room_is_recovered(odometry: bool) -> None:
    known = drive(ROOM, ROUND_THE_ROOM)
    results = run(local_slam(), known, odometry=odometry)
    assert all(isinstance(r.tracked.outcome, Match) for r in results[1:])
    off = errors(known.T_world_base, poses_of(results))
    assert off[:, 0].max() < 0.05
    assert off[:, 1].max() < 0.02


def test_along_a_bare_corridor_the_increments_hold() -> None:
    along: Line = ((0.0, 0.2), (6.0, 0.2))
    known = drive(CORRIDOR, along, bias_rad_per_m=0.0, wheel_scale=1.0)
    slam = local_slam()
    results = run(slam, known)
    assert errors(known.T_world_base, poses_of(results))[-1, 0] < 0.1
    assert slam.unobserved_m > 5.0


def test_in_another_place_the_thread_is_lost_and_a_new_map_begun() -> None:
    slam = local_slam()
    run(slam, drive(ROOM, ((1.2, 1.0), (2.2, 1.0))))
    lifted = drive(OTHER_ROOM, ((3.0, 4.0), (4.0, 4.0)), start_ns=2 * 10**9)
    outcomes = [slam.add_scan(scan).tracked.outcome for scan in lifted.scans]
    reasons = [outcome.reason for outcome in outcomes if isinstance(outcome, Rejected)]
    assert reasons[-1] == LOST
    assert isinstance(outcomes[-1], Match)


@pytest.mark.parametrize("gain", [0.0, 1.5, math.nan])
def test_a_gain_out_of_range_is_an_error(gain: float) -> None:
    with pytest.raises(ValidationError):
        PoseIncrementConfig(gain=gain)


def test_a_rejected_scan_leaves_the_fused_pose_where_it_was_predicted() -> None:
    standing = tracker()
    standing.track(prepared(ROOM, START), motion_of(np.eye(3)))
    step = se2(0.2, 0.0, 0.1)
    blind = standing.track(prepared(ROOM, START, beams=8), motion_of(step))
    assert np.array_equal(blind.T_odom_base, step)
    again = standing.track(prepared(ROOM, START, beams=8), motion_of(inverse(step)))
    assert np.allclose(again.T_odom_base, np.eye(3))
