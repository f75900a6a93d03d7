"""Improved correlative matching: known motions, honest covariance, what a prior may do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import inverse, se2, xyyaw
from frontend.comparison.correlative import FieldAlignment
from frontend.comparison.correlative_config import CorrelativeConfig
from frontend.local_map import LocalMap
from frontend.local_slam import LocalSlam
from frontend.match import UNOBSERVED_SIGMA_M, Match, Rejected
from frontend.matching import INFORMATION_PER_POINT, match_correlative
from frontend.motion import MotionConfig, MotionModel
from frontend.nodes import NodeConfig, NodeKeeper
from frontend.prepared import SIGMA_M
from frontend.tracker import LOST, ScanMatchingTracker, TrackerConfig
from tests.frontend.drives import ROUND_THE_ROOM, drive, errors, poses_of, run
from tests.frontend.rooms import CORRIDOR, OTHER_ROOM, ROOM, Line, off_by, prepared, turned

SEEDS = st.integers(0, 2**32 - 1)
POSE = se2(4.5, 3.0, 0.5)
ALIGN = FieldAlignment(CorrelativeConfig())
LOOSE = (1.0, 1.0)
TIGHT = (0.1, 0.1)
"""Twice the deviation of a prediction over some 0.7 m."""


def map_of(segments: Array, poses: list[Array], random: np.random.Generator) -> LocalMap:
    scans = [prepared(segments, T, noise_m=0.01, random=random, max_range_m=8.0) for T in poses]
    return LocalMap.around(list(zip(scans, poses, strict=True)))


def match_at(
    segments: Array,
    T_true: Array,
    T_expected: Array,
    seed: int,
    sigma: tuple[float, float] = LOOSE,
) -> Match:
    """Search and refine as the tracker does, on a map of six scans before."""
    random = np.random.default_rng(seed)
    local_map = map_of(segments, [T_true @ se2(-0.1 * k, 0.02, 0.02 * k) for k in range(6)], random)
    scan = prepared(segments, T_true, noise_m=0.01, random=random, max_range_m=8.0)
    penalty = (0.05 / sigma[0] ** 2, 0.05 / sigma[1] ** 2)
    found = match_correlative(scan, local_map, T_expected, 0.3, 0.2, penalty)
    assert not isinstance(found, Rejected)
    outcome = ALIGN(scan, local_map, found[0], T_expected, sigma)
    assert isinstance(outcome, Match), outcome
    return outcome


def local_slam() -> LocalSlam:
    return LocalSlam(
        MotionModel(MotionConfig()),
        ScanMatchingTracker(TrackerConfig(), ALIGN, CorrelativeConfig().penalty),
        NodeKeeper(NodeConfig()),
    )


@settings(deadline=None, max_examples=10)
@given(seed=SEEDS)
def test_a_motion_is_recovered_far_within_a_cell(seed: int) -> None:
    random = np.random.default_rng(seed)
    dx, dy, turn = random.uniform(-0.3, 0.3, 3)
    T_true = POSE @ se2(dx, dy, turn)
    dx, dy, turn = random.uniform(-0.15, 0.15, 3)
    T_expected = T_true @ se2(dx, dy, turn)
    match = match_at(ROOM, T_true, T_expected, seed)
    away_m, away_rad = off_by(T_true, match.T_frame_base)
    assert away_m < 0.015
    assert away_rad < 0.005
    assert match.inlier_ratio > 0.8
    assert match.score > 0.8
    assert match.rms_m < 0.03
    assert match.weak_sigma_m < 0.03


@pytest.mark.parametrize("turn_deg", [30.0, 90.0, 163.0])
def test_turning_the_world_changes_nothing_but_the_frame(turn_deg: float) -> None:
    T_new_old = se2(3.0, -7.0, math.radians(turn_deg))
    T_expected = POSE @ se2(0.03, -0.02, 0.02)
    old = match_at(ROOM, POSE, T_expected, 1)
    new = match_at(turned(ROOM, T_new_old), T_new_old @ POSE, T_new_old @ T_expected, 1)
    assert off_by(T_new_old @ old.T_frame_base, new.T_frame_base)[0] < 0.01
    scale = np.sqrt(np.diag(old.information))
    assert (new.information / np.outer(scale, scale)) == pytest.approx(
        old.information / np.outer(scale, scale), abs=0.3
    )


def over_noise(segments: Array, T_true: Array, seeds: int) -> tuple[list[Match], Array]:
    """Matches over noise, the prior weak and right, and how far they are off, (N, 3) base axes."""
    matches = [match_at(segments, T_true, T_true, seed) for seed in range(seeds)]
    off = np.array([xyyaw(inverse(T_true) @ match.T_frame_base) for match in matches])
    return matches, off


def test_the_covariance_of_a_room_follows_its_scatter() -> None:
    """A noise of 1 cm where SIGMA_M is assumed, ten points counted as one: some 9 times as much."""
    matches, off = over_noise(ROOM, POSE, 24)
    said = [np.sqrt(np.diag(np.linalg.inv(match.information))) for match in matches]
    cautious = SIGMA_M / 0.01 / math.sqrt(INFORMATION_PER_POINT)
    ratios = np.median(said, axis=0) / off.std(axis=0)
    assert (ratios > 0.5 * cautious).all(), ratios
    assert (ratios < 2.0 * cautious).all(), ratios


def test_a_bare_corridor_is_known_across_and_not_along() -> None:
    heading = 0.3
    matches, off = over_noise(CORRIDOR, se2(0.0, 0.2, heading), 16)
    along = np.array([math.cos(heading), -math.sin(heading)])
    across = np.array([-along[1], along[0]])
    scatter = [float((off[:, :2] @ axis).std()) for axis in (along, across)]
    assert scatter[0] > 10.0 * scatter[1]
    for match in matches:
        known = [float(axis @ match.information[:2, :2] @ axis) for axis in (along, across)]
        assert known[0] < 0.02 * known[1]
        assert known[0] < scatter[0] ** -2
        assert known[1] < scatter[1] ** -2
        assert match.weak_sigma_m > UNOBSERVED_SIGMA_M
        assert abs(match.weak_base @ along) > math.cos(math.radians(6.0))
    assert np.abs(off[:, :2] @ across).max() < 0.015


def test_the_penalty_pulls_towards_the_prior_in_a_bare_corridor_and_hardly_in_a_room() -> None:
    shift = se2(0.08, 0.0, 0.0)
    for segments, T_true, held in ((CORRIDOR, se2(0.0, 0.2, 0.0), True), (ROOM, POSE, False)):
        along = []
        for seed in range(6):
            found = match_at(segments, T_true, T_true @ shift, seed, TIGHT)
            along.append(xyyaw(inverse(T_true) @ found.T_frame_base)[0])
        if held:
            assert np.median(along) == pytest.approx(0.08, abs=0.02)
        else:
            assert np.abs(along).max() < 0.02


def test_without_a_penalty_the_prior_says_nothing() -> None:
    random = np.random.default_rng(0)
    local_map = map_of(ROOM, [POSE], random)
    scan = prepared(ROOM, POSE, noise_m=0.01, random=random)
    free = FieldAlignment(CorrelativeConfig(penalty=0.0))
    found = [free(scan, local_map, POSE, POSE @ se2(x, 0, 0), TIGHT) for x in (0.0, 0.5)]
    assert isinstance(found[0], Match)
    assert isinstance(found[1], Match)
    assert np.array_equal(found[0].T_frame_base, found[1].T_frame_base)


def test_what_does_not_fit_is_rejected_or_told_by_its_inliers() -> None:
    random = np.random.default_rng(0)
    local_map = map_of(ROOM, [POSE], random)
    stranger = prepared(OTHER_ROOM, se2(4.0, 4.5, 0.5))
    outcome = ALIGN(stranger, local_map, POSE, POSE, LOOSE)
    assert isinstance(outcome, Rejected) or outcome.inlier_ratio < 0.5
    far = POSE @ se2(100.0, 0.0, 0.0)
    assert isinstance(ALIGN(prepared(ROOM, POSE), local_map, far, far, LOOSE), Rejected)
    empty = LocalMap.around([])
    assert isinstance(ALIGN(prepared(ROOM, POSE), empty, POSE, POSE, LOOSE), Rejected)


@pytest.mark.parametrize("odometry", [True, False])
def test_a_drive_round_the_room_is_recovered(odometry: bool) -> None:
    known = drive(ROOM, ROUND_THE_ROOM)
    results = run(local_slam(), known, odometry=odometry)
    assert all(isinstance(r.tracked.outcome, Match) for r in results[1:])
    off = errors(known.T_world_base, poses_of(results))
    assert off[:, 0].max() < 0.08
    assert off[:, 1].max() < 0.03


def test_along_a_bare_corridor_odometry_holds() -> None:
    along: Line = ((0.0, 0.2), (6.0, 0.2))
    known = drive(CORRIDOR, along, bias_rad_per_m=0.0, wheel_scale=1.0)
    slam = local_slam()
    results = run(slam, known)
    off = errors(known.T_world_base, poses_of(results))
    assert off[-1, 0] < 0.2
    assert slam.unobserved_m > 4.0


def test_in_another_place_the_thread_is_lost_and_a_new_map_begun() -> None:
    slam = local_slam()
    known = drive(ROOM, ((1.2, 1.0), (2.2, 1.0)))
    run(slam, known)
    lifted = drive(OTHER_ROOM, ((3.0, 4.0), (4.0, 4.0)), start_ns=2 * 10**9)
    outcomes = [slam.add_scan(scan).tracked.outcome for scan in lifted.scans]
    reasons = [outcome.reason for outcome in outcomes if isinstance(outcome, Rejected)]
    assert reasons[-1] == LOST
    assert isinstance(outcomes[-1], Match)
    assert len(slam.lost_ns) == 1
