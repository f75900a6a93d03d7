"""Local SLAM on simulated drives: how far it drifts, when it is lost, what it says of corridors."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from datasets.messages import Array, Odometry
from datasets.se2 import inverse, se2
from frontend.local_slam import LocalResult
from frontend.match import Match, Rejected
from frontend.prepared import PreparedScan
from frontend.tracker import LOST
from fusion.scan import FusedScan
from tests.frontend.drives import (
    ROUND_THE_ROOM,
    STEP_NS,
    Drive,
    drive,
    errors,
    local_slam,
    poses_of,
    run,
)
from tests.frontend.low_things import along_errors
from tests.frontend.rooms import CORRIDOR, OTHER_ROOM, ROOM, box, fused, moved, off_by, walls

DEG = math.radians(1.0)


@pytest.fixture(scope="module")
def round_the_room() -> Drive:
    return drive(ROOM, ROUND_THE_ROOM, seed=1)


def is_matched(result: LocalResult) -> bool:
    return isinstance(result.tracked.outcome, Match)


def without_points(scan: FusedScan) -> FusedScan:
    nothing = np.empty(0)
    return FusedScan.of_lidar(
        scan.stamp_ns,
        scan.sensor,
        scan.origin_base,
        np.empty((0, 2)),
        nothing,
        scan.beam_spacing_rad,
        nothing,
    )


@pytest.mark.parametrize("odometry", [True, False])
def test_a_drive_round_a_room_stays_within_centimetres(
    round_the_room: Drive, odometry: bool
) -> None:
    slam = local_slam()
    results = run(slam, round_the_room, odometry=odometry)
    off = errors(round_the_room.T_world_base, poses_of(results))
    assert off[:, 0].max() < 0.03
    assert off[:, 1].max() < 0.5 * DEG
    assert all(is_matched(result) for result in results[1:])
    assert not slam.unmatched
    assert slam.unobserved_m == 0.0
    way_m = sum(math.dist(a, b) for a, b in pairwise(ROUND_THE_ROOM))
    assert slam.keeper.way_m == pytest.approx(way_m, rel=0.03)


def test_raw_odometry_alone_would_be_far_off(round_the_room: Drive) -> None:
    off = errors(
        round_the_room.T_world_base, [message.T_odom_base for message in round_the_room.odometry]
    )
    assert off[-1, 0] > 0.2
    assert off[-1, 1] > 20.0 * DEG


def test_the_same_drive_gives_the_same_poses(round_the_room: Drive) -> None:
    part = Drive(
        round_the_room.T_world_base[:40], round_the_room.scans[:40], round_the_room.odometry[:40]
    )
    first, second = (np.array(poses_of(run(local_slam(), part))) for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_the_wheels_turning_error_is_learned_on_the_way(round_the_room: Drive) -> None:
    slam = local_slam()
    run(slam, round_the_room)
    assert slam.motion.errors.turn_rad_per_m < -0.004, "on its way to -0.04"
    assert slam.motion.errors.turn_rad_per_m > -0.05


def test_the_length_of_the_wheels_metres_is_learned_where_it_shows_and_holds_where_not() -> None:
    """Past cabinets for 12 m, then 12 m of bare walls: 2 % of them would be 24 cm."""
    cabinets = walls(*[box(1.5 + 2.3 * k, 0.5 if k % 2 else -1.0, 0.9, 0.5) for k in range(5)])
    segments = np.concatenate([CORRIDOR, cabinets])
    past = drive(
        segments, ((0.0, 0.0), (30.0, 0.0)), max_range_m=6.0, wheel_scale=1.02, bias_rad_per_m=0.0
    )
    slam = local_slam()
    results = run(slam, past)
    along = along_errors(past.T_world_base, poses_of(results))
    assert slam.unobserved_m > 8.0
    assert slam.motion.errors.scale_error == pytest.approx(1.0 / 1.02 - 1.0, abs=0.008)
    assert np.abs(along).max() < 0.06


def test_what_a_lidar_gets_wrong_the_same_way_each_turn_does_not_shorten_a_corridor() -> None:
    """Ranges wrong by up to 6 mm/m, beam by beam, make texture that goes with the base."""
    past = drive(
        CORRIDOR, ((0.0, 0.0), (10.0, 0.0)), max_range_m=6.0, wheel_scale=1.0, bias_rad_per_m=0.0
    )
    scans = []
    for scan in past.scans:
        bearings = np.arctan2(*scan.points_base.T[::-1])
        wrong = 1.0 + 0.006 * np.sin(40.0 * bearings)
        scans.append(replace(scan, points_base=scan.points_base * wrong[:, None]))
    slam = local_slam()
    results = run(slam, replace(past, scans=scans))
    wheels = [message.T_odom_base for message in past.odometry]
    along = along_errors(wheels, poses_of(results))
    assert slam.unobserved_m > 9.0
    assert np.abs(along).max() < 0.01


def test_along_bare_walls_no_scale_is_learned() -> None:
    past = drive(CORRIDOR, ((0.0, 0.0), (10.0, 0.0)), max_range_m=6.0, wheel_scale=1.02)
    slam = local_slam()
    run(slam, past)
    assert slam.unobserved_m > 9.0
    assert slam.motion.errors.scale_error == pytest.approx(0.0, abs=0.002)


def test_nodes_carry_the_scans_of_their_poses(round_the_room: Drive) -> None:
    slam = local_slam()
    results = run(slam, round_the_room)
    made = [result.node for result in results if result.node is not None]
    assert made == slam.keeper.nodes
    by_stamp = {result.tracked.scan.stamp_ns: result.tracked for result in results}
    for node in made:
        assert (node.T_odom_base == by_stamp[node.scan.stamp_ns].T_odom_base).all()
    submaps = [result.submap for result in results if result.submap is not None]
    assert submaps == slam.keeper.submaps
    assert len(submaps) >= 3


def test_blind_scans_are_bridged_by_the_prediction(round_the_room: Drive) -> None:
    blind = range(60, 63)
    scans = [
        without_points(scan) if k in blind else scan for k, scan in enumerate(round_the_room.scans)
    ]
    slam = local_slam()
    results = run(slam, replace(round_the_room, scans=scans))
    assert [k for k, result in enumerate(results) if not is_matched(result)] == [0, *blind]
    assert sum(slam.unmatched.values()) == len(blind)
    off = errors(round_the_room.T_world_base, poses_of(results))
    assert off[:, 0].max() < 0.05
    assert not any(node.lost for node in slam.keeper.nodes)


@pytest.mark.parametrize("odometry", [True, False])
def test_carried_into_another_room_it_is_lost_once_and_goes_on(odometry: bool) -> None:
    here = drive(ROOM, ((1.2, 1.0), (5.0, 1.0)), seed=2)
    there = drive(
        OTHER_ROOM, ((1.0, 1.0), (3.5, 5.0), (4.5, 8.0), (8.0, 8.0)), seed=3, start_ns=60 * STEP_NS
    )
    # carried, the wheels don't turn: their odometry goes on from where it was
    T = here.odometry[-1].T_odom_base @ inverse(there.odometry[0].T_odom_base)
    wheels = [Odometry(m.stamp_ns, T @ m.T_odom_base) for m in there.odometry]
    slam = local_slam()
    run(slam, here, odometry=odometry)
    results = run(slam, replace(there, odometry=wheels), odometry=odometry)
    reasons = [
        result.tracked.outcome.reason
        for result in results
        if isinstance(result.tracked.outcome, Rejected)
    ]
    assert reasons.count(LOST) == 1
    assert len(reasons) <= 6
    assert slam.unmatched[LOST] == 1
    after = next(k for k, r in enumerate(results) if not is_matched(r)) + len(reasons)
    assert all(is_matched(result) for result in results[after:])
    off = errors(there.T_world_base[after:], poses_of(results[after:]))
    assert off[:, 0].max() < 0.05
    assert sum(node.lost for node in slam.keeper.nodes) == 1
    slam.keeper.finish()
    lost = next(node for node in slam.keeper.nodes if node.lost)
    assert any(submap.nodes[0] is lost for submap in slam.keeper.submaps), "it begins a submap"


def test_in_a_bare_corridor_the_odometry_holds_the_way_and_it_is_told() -> None:
    way: Array = np.array([0.0, 8.0])
    along = drive(
        CORRIDOR,
        ((float(way[0]), 0.2), (float(way[1]), 0.2)),
        seed=4,
        bias_rad_per_m=0.0,
        max_range_m=5.0,
    )
    slam = local_slam()
    results = run(slam, along)
    assert all(is_matched(result) for result in results[1:])
    T_start = along.T_world_base[0]
    last = T_start @ inverse(results[0].tracked.T_odom_base) @ results[-1].tracked.T_odom_base
    true = along.T_world_base[-1]
    wheels = inverse(along.odometry[0].T_odom_base) @ along.odometry[-1].T_odom_base
    assert last[1, 2] == pytest.approx(true[1, 2], abs=0.02)
    assert abs(math.atan2(last[1, 0], last[0, 0])) < 0.5 * DEG
    assert last[0, 2] - T_start[0, 2] == pytest.approx(wheels[0, 2], rel=0.03)
    assert slam.unobserved_m > 0.9 * 7.9
    for node in slam.keeper.nodes[1:]:
        sigma = np.sqrt(np.diag(node.step_covariance))
        assert sigma[0] > 3.0 * sigma[1], "along is known by the odometry only"


def test_a_second_lidar_is_tracked_in_the_same_frame() -> None:
    front = drive(ROOM, ROUND_THE_ROOM[:4], seed=5)
    random = np.random.default_rng(5)
    slam = local_slam()
    poses = []
    for T, scan, message in zip(front.T_world_base, front.scans, front.odometry, strict=True):
        slam.add_odometry(message)
        poses.append(slam.add_scan(replace(scan, sensor="front")).tracked.T_odom_base)
        rear = fused(
            ROOM,
            T,
            beams=120,
            first_rad=0.5 * math.pi,
            fov_rad=math.pi,
            origin_base=(-0.4, 0.0),
            noise_m=0.01,
            random=random,
            stamp_ns=scan.stamp_ns,
            sensor="rear",
        )
        assert max(off_by(poses[-1], slam.add_scan(rear).tracked.T_odom_base)) < 0.04
    off = errors(front.T_world_base, poses)
    assert off[:, 0].max() < 0.04
    assert {node.scan.sensor for node in slam.keeper.nodes} == {"front", "rear"}


@pytest.mark.parametrize("odometry", [True, False])
def test_a_slow_lidar_on_a_turning_base_is_de_skewed_on_the_way(odometry: bool) -> None:
    """7 turns a second, driving an arc; poses are of each scan's middle."""
    twist = np.array([0.5, 0.0, 0.45])
    T_start, turn_s = se2(5.0, 0.9, 0.0), 1.0 / 7.0
    slam = local_slam()
    scans: list[PreparedScan] = []
    poses: list[Array] = []
    odometry_ns = 0
    for k in range(60):
        begin_s = k * turn_s
        while odometry and odometry_ns < (begin_s + turn_s) * 1e9:
            slam.add_odometry(Odometry(odometry_ns, moved(twist, odometry_ns * 1e-9)))
            odometry_ns += 20_000_000
        scan = fused(
            ROOM,
            T_start @ moved(twist, begin_s),
            beams=360,
            velocity_base=twist,
            turn_s=turn_s,
            stamp_ns=round(begin_s * 1e9),
        )
        result = slam.add_scan(scan)
        scans.append(result.tracked.scan)
        poses.append(result.tracked.T_odom_base)
    true = [T_start @ moved(twist, scan.moment_ns * 1e-9) for scan in scans]
    off = errors(true[5:], poses[5:])
    assert off[:, 0].max() < 0.05
    assert off[:, 1].max() < 1.0 * DEG


@pytest.mark.parametrize("blind", [range(0, 1), range(0, 400, 5), range(10, 18)])
def test_blind_scans_cost_no_more_than_themselves(round_the_room: Drive, blind: range) -> None:
    """The first one, every fifth, and more in a row than would do to be lost."""
    scans = [
        without_points(scan) if k in blind else scan for k, scan in enumerate(round_the_room.scans)
    ]
    slam = local_slam()
    results = run(slam, replace(round_the_room, scans=scans))
    seeing = [result for k, result in enumerate(results) if k not in blind]
    assert all(is_matched(result) for result in seeing[1:])
    assert not slam.lost_ns
    off = errors(round_the_room.T_world_base, poses_of(results))
    assert off[:, 0].max() < 0.08
