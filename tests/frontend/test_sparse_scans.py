"""Scans a metre or a quarter turn apart, of half the horizon: held, found again, or told lost."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from datasets.messages import Array, Odometry
from datasets.se2 import inverse, se2, transform, xyyaw
from frontend import residual_kernels
from frontend.local_map import NO_POINTS, LocalMap
from frontend.local_slam import LocalSlam
from frontend.match import Match, Rejected
from frontend.matching import match_surface
from frontend.motion import Motion, MotionConfig, MotionModel
from frontend.nodes import NodeConfig, NodeKeeper, matched_covariance
from frontend.odometry_errors import SPREAD_LEAST, OdometryErrors
from frontend.tracker import LOST, ScanMatchingTracker, Tracked, TrackerConfig
from tests.frontend.drives import errors, poses_of
from tests.frontend.rooms import RING, ROOM, SQUARE, Line, fused, off_by, prepared, way_through

HALF = {"beams": 180, "first_rad": -math.pi / 2, "fov_rad": math.pi}
ROUND_THE_RING: Line = ((1, 1), (11, 1), (11, 8), (1, 8), (1, 1), (6, 1))


def motion_of(T_last_base: Array, seconds: float = 1.0) -> Motion:
    """A prediction by odometry, trusted as the motion model trusts it."""
    x, y, yaw = xyyaw(T_last_base)
    way_m = math.hypot(x, y)
    sigma = 0.01 + 0.06 * way_m + 0.02 * abs(yaw), 0.03 + 0.08 * way_m + 0.1 * abs(yaw)
    return Motion(T_last_base, *sigma, np.zeros(3), seconds, True)


def tracked(
    segments: Array, poses: list[Array], said: list[Array], seed: int = 0, **how: object
) -> list[Tracked]:
    """A base at true poses whose odometry says these steps (3, 3), one less than poses."""
    tracker = ScanMatchingTracker(TrackerConfig())
    random = np.random.default_rng(seed)
    how = {**HALF, "noise_m": 0.01, "random": random, **how}
    return [
        tracker.track(prepared(segments, T, **how), motion_of(step))
        for T, step in zip(poses, [np.eye(3), *said], strict=True)
    ]


def steps(poses: list[Array]) -> list[Array]:
    return [inverse(a) @ b for a, b in pairwise(poses)]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_drive_with_a_scan_a_metre_is_held_round_corners(seed: int) -> None:
    """The odometry errs by 3 cm and 2 deg a metre, and by 10 deg once in ten steps."""
    poses = way_through(ROUND_THE_RING, 1.0)
    random = np.random.default_rng(seed)
    slam = LocalSlam(
        MotionModel(MotionConfig()),
        ScanMatchingTracker(TrackerConfig()),
        NodeKeeper(NodeConfig()),
    )
    T_wheel, results = np.eye(3), []
    for k, T in enumerate(poses):
        if k:
            glitch = 0.17 if k % 10 == 5 else 0.0
            dx, dy, turn = random.normal(0.0, (0.03, 0.03, 0.035))
            T_wheel = T_wheel @ inverse(poses[k - 1]) @ T @ se2(dx, dy, turn + glitch)
        slam.add_odometry(Odometry(k * 10**9, T_wheel))
        scan = fused(RING, T, **HALF, noise_m=0.01, random=random, stamp_ns=k * 10**9)
        results.append(slam.add_scan(scan))
    assert not slam.unmatched[LOST]
    assert sum(isinstance(r.tracked.outcome, Rejected) for r in results[1:]) == 0
    off = errors(poses, poses_of(results))
    assert off[:, 0].max() < 0.12
    assert off[:, 1].max() < math.radians(2.0)


@pytest.mark.parametrize("turn_deg", [80.0, -80.0, 120.0])
def test_a_base_turned_by_hand_is_found_at_the_yaw_that_it_has(turn_deg: float) -> None:
    """All round is seen, and the odometry says that nothing moved."""
    start = se2(4.5, 3.0, 0.3)
    poses = [start @ se2(0.15 * k, 0.0, 0.0) for k in range(4)]
    poses.append(poses[-1] @ se2(0.05, 0.0, math.radians(turn_deg)))
    said = [*steps(poses[:-1]), np.eye(3)]
    last = tracked(ROOM, poses, said, beams=360, first_rad=-math.pi, fov_rad=2 * math.pi)[-1]
    assert isinstance(last.outcome, Match)
    shift_m, turn_rad = off_by(inverse(start) @ poses[-1], last.T_odom_base)
    assert shift_m < 0.03
    assert turn_rad < math.radians(0.5)


def test_turned_by_hand_where_all_sides_are_alike_it_says_that_it_does_not_know() -> None:
    """In a square room a turn by 80 deg is as good as one by -10: no match far away counts."""
    corner = se2(0.0, 0.0, 0.2)
    poses = [corner] * 3 + [corner @ se2(0.0, 0.0, math.radians(140.0))]
    how = {"beams": 360, "first_rad": -math.pi, "fov_rad": 2 * math.pi}
    last = tracked(SQUARE, poses, [np.eye(3)] * 3, **how)[-1]
    if isinstance(last.outcome, Match):  # what is nearest may be believed, but nothing farther
        turn = abs(xyyaw(last.T_odom_base)[2])
        assert turn < math.radians(60.0)


def test_a_base_that_backs_off_while_its_odometry_counts_forwards_is_found() -> None:
    poses = [se2(3.6 + 0.5 * k, 1.0, 0.0) for k in range(4)]
    poses += [poses[-1] @ se2(-0.7, 0.0, 0.0)]
    said = [*steps(poses[:-1]), se2(0.7, 0.0, 0.0)]
    last = tracked(ROOM, poses, said)[-1]
    assert isinstance(last.outcome, Match)
    assert max(off_by(inverse(poses[0]) @ poses[-1], last.T_odom_base)) < 0.05


def test_scans_of_another_place_are_refused_until_it_says_that_it_is_lost() -> None:
    tracker = ScanMatchingTracker(TrackerConfig())
    for _ in range(3):
        tracker.track(prepared(ROOM, se2(4.5, 3.0, 0.3), **HALF), motion_of(np.eye(3)))
    elsewhere = prepared(RING, se2(6.0, 1.0, 0.0), **HALF)
    outcomes = [tracker.track(elsewhere, motion_of(np.eye(3))).outcome for _ in range(6)]
    assert all(isinstance(outcome, Rejected) for outcome in outcomes[:5])
    assert outcomes[4] == Rejected(LOST)
    assert isinstance(outcomes[5], Match), "the new map begins there"


def single_system(
    points: Array, pose: Array, map_points: Array, robust_m: float
) -> tuple[Array, Array]:
    """The twin of ``add_single_points`` for a map of single points alone."""
    placed = transform(se2(*pose), points)
    levers = placed - pose[:2]
    H, g = np.zeros((3, 3)), np.zeros(3)
    for q, lever in zip(placed, levers, strict=True):
        away = q - map_points
        nearest = away[np.argmin((away**2).sum(axis=1))]
        d2 = float(nearest @ nearest)
        if d2 >= 0.04:
            continue
        J = np.array([[1.0, 0.0, -lever[1]], [0.0, 1.0, lever[0]]])
        w = 0.5 * (robust_m**2 / (robust_m**2 + d2)) ** 2
        H, g = H + w * J.T @ J, g + w * J.T @ nearest
    return H, g


def test_single_points_add_what_the_formula_says() -> None:
    random = np.random.default_rng(4)
    map_points = random.uniform(-3.0, 3.0, (60, 2))
    pose = np.array([0.3, -0.2, 0.4])
    points = transform(inverse(se2(*pose)), map_points + random.normal(0.0, 0.05, (60, 2)))
    low, cell = np.array([-4.0, -4.0]), 0.2
    head, following = np.full((40, 40), -1, dtype=np.int32), np.full(60, -1, dtype=np.int32)
    for k, (x, y) in enumerate(map_points):
        row, col = int((y - low[1]) // cell), int((x - low[0]) // cell)
        following[k], head[row, col] = head[row, col], k
    nothing = (NO_POINTS, NO_POINTS, np.empty(0), np.empty(0, np.int32), np.full_like(head, -1))
    single = (map_points, np.zeros((60, 2)), np.ones(60), following, head)
    H, g = np.zeros((3, 3)), np.zeros(3)
    residual_kernels.add_single_points(
        points, pose, nothing, single, low[0], low[1], cell, 0.2, 0.1, 0.5, H, g
    )
    expected_H, expected_g = single_system(points, pose, map_points, 0.1)
    assert np.triu(H) == pytest.approx(np.triu(expected_H))
    assert g == pytest.approx(expected_g)


def test_posts_that_no_line_fits_hold_what_bare_walls_leave_open() -> None:
    """A corridor with thin posts: two points each have no normal, and tell the way along."""
    corridor = np.array([[-30.0, -1.5, 30.0, -1.5], [-30.0, 1.5, 30.0, 1.5]])
    posts = np.array([[x, 0.9, x + 0.01, 0.94] for x in (-4.1, -2.3, 1.2, 2.9, 4.4)])
    segments = np.concatenate([corridor, posts])
    here, there = se2(0.0, 0.0, 0.0), se2(0.12, 0.02, 0.02)
    first, second = prepared(segments, here, beams=300), prepared(segments, there, beams=300)
    off_m = []
    for single in (False, True):
        local_map = LocalMap(np.array([-12.0, -12.0]), np.array([12.0, 12.0]))
        local_map.insert(first, here, single=single)
        assert local_map.has_single == single
        found = match_surface(second, local_map, here, here, (0.3, 0.1))
        assert isinstance(found, Match)
        off_m.append(abs(xyyaw(inverse(there) @ found.T_frame_base)[0]))
    assert off_m[1] < 0.06
    assert off_m[1] < 0.5 * off_m[0]


def test_how_far_predictions_are_usually_off_is_learned_and_outliers_hardly_count() -> None:
    errors_of, random = OdometryErrors(), np.random.default_rng(5)
    assert errors_of.usual_share == (1.0, 1.0)
    for k in range(400):
        x, y = random.normal(0.0, 0.04, 2)
        yaw = 1.0 if k % 50 == 49 else random.normal(0.0, 0.03)
        errors_of.learn_spread(se2(x, y, yaw), 0.08, 0.1)
    usual_m, usual_rad = errors_of.usual_share
    assert usual_m == pytest.approx(0.5, rel=0.25)
    assert usual_rad == pytest.approx(0.33, rel=0.4)
    for _ in range(200):
        errors_of.learn_spread(np.eye(3), 0.08, 0.1)
    assert errors_of.usual_share == SPREAD_LEAST


def test_a_step_is_known_less_well_where_little_of_the_scan_lies_on_the_map() -> None:
    step = se2(1.0, 0.1, 0.3)
    full = matched_covariance(step)
    assert matched_covariance(step, 0.6) == pytest.approx(full)
    assert matched_covariance(step, 0.3) == pytest.approx(16.0 * full)
