"""Known motions between known rooms are found again; what was not observed is said not to be."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import inverse, se2, xyyaw
from frontend.local_map import LocalMap
from frontend.match import Match, Rejected
from frontend.matching import (
    APART_M,
    NORMAL_SIGMA_RAD,
    SIGMA_M,
    match_correlative,
    match_surface,
    observed,
    thinned,
    to_base_axes,
    weakest_direction,
    yaw_step_rad,
)
from tests.frontend.rooms import (
    CABINETS,
    CORRIDOR,
    MARKED_CABINETS,
    OTHER_ROOM,
    ROOM,
    off_by,
    prepared,
    turned,
)

SEEDS = st.integers(0, 2**32 - 1)
POSE = se2(4.5, 3.0, 0.5)
LOOSE = (1.0, 1.0)


def map_of(segments: Array, poses: list[Array], noise_m: float = 0.0, seed: int = 0) -> LocalMap:
    random = np.random.default_rng(seed)
    return LocalMap.around(
        [(prepared(segments, T, noise_m=noise_m, random=random), T) for T in poses]
    )


def matched(outcome: Match | Rejected) -> Match:
    assert isinstance(outcome, Match), outcome
    return outcome


# ---- the search ------------------------------------------------------------------------------


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS)
def test_search_finds_a_motion_to_within_a_cell_and_a_step(seed: int) -> None:
    random = np.random.default_rng(seed)
    local_map = map_of(ROOM, [POSE, POSE @ se2(0.3, 0.1, 0.2)], 0.01, seed)
    T_true = POSE @ se2(*random.uniform(-0.3, 0.3, 2), random.uniform(-0.3, 0.3))
    scan = prepared(ROOM, T_true, noise_m=0.01, random=random)
    T_guess = T_true @ se2(*random.uniform(-0.25, 0.25, 2), random.uniform(-0.3, 0.3))
    found = match_correlative(scan, local_map, T_guess, 0.4, 0.35, (0.0, 0.0))
    assert not isinstance(found, Rejected)
    away_m, away_rad = off_by(T_true, found[0])
    assert away_m < 0.09
    assert away_rad < 0.03
    assert found[1] > 0.6


def test_a_penalty_keeps_the_search_at_its_guess() -> None:
    local_map = map_of(ROOM, [POSE])
    scan = prepared(ROOM, POSE)
    T_guess = POSE @ se2(0.2, -0.1, 0.05)
    free = match_correlative(scan, local_map, T_guess, 0.4, 0.2, (0.0, 0.0))
    held = match_correlative(scan, local_map, T_guess, 0.4, 0.2, (1e4, 1e4))
    assert not isinstance(free, Rejected)
    assert not isinstance(held, Rejected)
    assert off_by(POSE, free[0])[0] < 0.06
    assert off_by(T_guess, held[0]) == pytest.approx((0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("yaw", [0.0, math.pi - 0.01, -math.pi + 0.01])
def test_where_doors_are_alike_the_search_finds_the_other_one_too(yaw: float) -> None:
    """Cabinets every 1.2 m; with one that is like no other the place is sure."""
    for segments, marked, ambiguous in (
        (CABINETS, False, True),
        (MARKED_CABINETS, True, False),
    ):
        local_map = map_of(segments, [se2(x, 0.0, 0.0) for x in np.arange(-2.0, 2.1, 0.25)])
        scan = prepared(segments, se2(0.1, 0.0, yaw + 0.03), max_range_m=5.0)
        where = (scan, local_map, se2(0.0, 0.0, yaw), 1.6, 0.2, (0.0, 0.0))
        found = match_correlative(*where)
        assert not isinstance(found, Rejected)
        T_found, score = found
        second = match_correlative(*where, 0.92 * score, avoid=T_found)
        assert isinstance(second, Rejected) != ambiguous
        if not isinstance(second, Rejected):
            away_m = abs(second[0][0, 2] - T_found[0, 2])
            assert away_m >= APART_M
            assert min(abs(away_m - 1.2), abs(away_m - 2.4)) < 0.15
        if marked:
            assert off_by(T_found, se2(0.1, 0.0, yaw + 0.03))[0] < 0.06


def test_search_far_from_everything_is_rejected() -> None:
    local_map = map_of(ROOM, [POSE])
    outcome = match_correlative(
        prepared(ROOM, POSE), local_map, se2(500.0, 0.0, 0.0), 0.5, 0.2, (0.0, 0.0)
    )
    assert isinstance(outcome, Rejected)


def test_the_yaw_step_moves_far_points_by_a_cell() -> None:
    ring = 4.0 * np.column_stack([np.cos(np.arange(0, 6, 0.1)), np.sin(np.arange(0, 6, 0.1))])
    assert yaw_step_rad(ring) == pytest.approx(0.05 / 4.0)
    assert yaw_step_rad(100.0 * ring) == pytest.approx(0.005)
    assert yaw_step_rad(0.01 * ring) == yaw_step_rad(np.empty((0, 2))) == pytest.approx(0.02)


@given(count=st.integers(0, 1000), most=st.integers(1, 300))
def test_thinning_leaves_at_most_what_was_asked(count: int, most: int) -> None:
    rows = np.arange(2.0 * count).reshape(count, 2)
    left = thinned(rows, most)
    assert len(left) <= most
    assert len(left) >= min(count, (most + 1) // 2)
    assert left.flags.c_contiguous


# ---- the surface -----------------------------------------------------------------------------


@settings(deadline=None, max_examples=30)
@given(seed=SEEDS)
def test_alignment_recovers_a_motion_from_a_wrong_start_over_noise(seed: int) -> None:
    random = np.random.default_rng(seed)
    local_map = map_of(ROOM, [POSE, POSE @ se2(0.3, 0.1, 0.2)], 0.01, seed)
    T_true = POSE @ se2(*random.uniform(-0.3, 0.3, 2), random.uniform(-0.3, 0.3))
    scan = prepared(ROOM, T_true, noise_m=0.01, random=random)
    T_start = T_true @ se2(*random.uniform(-0.1, 0.1, 2), random.uniform(-0.09, 0.09))
    match = matched(match_surface(scan, local_map, T_start, T_start, LOOSE))
    away_m, away_rad = off_by(T_true, match.T_frame_base)
    assert away_m < 0.015
    assert away_rad < math.radians(0.4)
    assert match.inlier_ratio > 0.8
    assert match.score > 0.6
    assert match.rms_m < 0.02
    assert match.weak_sigma_m < 0.03


def test_a_motion_and_its_inverse_undo_each_other() -> None:
    T_a, T_b = POSE, POSE @ se2(0.4, -0.2, 0.35)
    T_a_b = inverse(T_a) @ T_b
    scan_a, scan_b = prepared(ROOM, T_a, beams=720), prepared(ROOM, T_b, beams=720)
    start = se2(0.06, -0.05, 0.04)
    there = matched(
        match_surface(
            scan_b, LocalMap.around([(scan_a, np.eye(3))]), T_a_b @ start, T_a_b @ start, LOOSE
        )
    )
    T_b_a = inverse(T_a_b)
    back = matched(
        match_surface(
            scan_a, LocalMap.around([(scan_b, np.eye(3))]), T_b_a @ start, T_b_a @ start, LOOSE
        )
    )
    assert max(off_by(T_a_b, there.T_frame_base)) < 0.005
    assert max(off_by(np.eye(3), there.T_frame_base @ back.T_frame_base)) < 0.008


@pytest.mark.parametrize("turn_deg", [30.0, 90.0, 163.0, 270.0])
def test_turning_the_world_changes_nothing_but_the_frame(turn_deg: float) -> None:
    """Poses turn along; information in base axes stays the same."""
    T_new_old = se2(3.0, -7.0, math.radians(turn_deg))
    T_true = POSE @ se2(0.2, 0.1, 0.1)
    T_start = T_true @ se2(0.05, -0.04, 0.03)
    found = []
    for T in (np.eye(3), T_new_old):
        segments = turned(ROOM, T)
        local_map = map_of(segments, [T @ POSE])
        scan = prepared(segments, T @ T_true)
        found.append(matched(match_surface(scan, local_map, T @ T_start, T @ T_start, LOOSE)))
    old, new = found
    assert max(off_by(T_new_old @ old.T_frame_base, new.T_frame_base)) < 0.002
    scale = np.abs(old.information).max()
    assert pytest.approx(old.information, rel=0.05, abs=0.02 * scale) == new.information
    assert new.weak_sigma_m == pytest.approx(old.weak_sigma_m, rel=0.1)
    assert new.inlier_ratio == pytest.approx(old.inlier_ratio, abs=0.02)


def test_the_prior_may_stand_on_the_other_branch_of_the_angle() -> None:
    T_true = se2(4.5, 3.0, math.pi - 0.005)
    local_map = map_of(ROOM, [T_true])
    scan = prepared(ROOM, T_true)
    T_start = T_true @ se2(0.02, 0.0, -0.01)
    T_expected = T_true @ se2(0.0, 0.0, 0.02)  # beyond pi
    match = matched(match_surface(scan, local_map, T_start, T_expected, (0.1, 0.05)))
    assert max(off_by(T_true, match.T_frame_base)) < 0.01


def test_a_strong_prior_holds_and_stays_out_of_the_information() -> None:
    local_map = map_of(ROOM, [POSE])
    scan = prepared(ROOM, POSE)
    T_expected = POSE @ se2(0.05, 0.02, 0.01)
    held = matched(match_surface(scan, local_map, POSE, T_expected, (1e-5, 1e-5)))
    free = matched(match_surface(scan, local_map, POSE, POSE, LOOSE))
    assert max(off_by(T_expected, held.T_frame_base)) < 1e-3
    assert max(off_by(POSE, free.T_frame_base)) < 2e-3
    assert held.information.max() < 1.2 * free.information.max()


def test_too_little_to_match_is_rejected() -> None:
    local_map = map_of(ROOM, [POSE])
    few = prepared(ROOM, POSE, beams=8)
    assert isinstance(match_surface(few, local_map, POSE, POSE, LOOSE), Rejected)
    far = POSE @ se2(100.0, 0.0, 0.0)
    assert isinstance(match_surface(prepared(ROOM, POSE), local_map, far, far, LOOSE), Rejected)
    empty = LocalMap.around([])
    assert isinstance(match_surface(prepared(ROOM, POSE), empty, POSE, POSE, LOOSE), Rejected)


def test_another_room_fits_badly() -> None:
    local_map = map_of(ROOM, [POSE])
    stranger = prepared(OTHER_ROOM, se2(4.0, 4.5, 0.5))
    outcome = match_surface(stranger, local_map, POSE, POSE, LOOSE)
    own = matched(match_surface(prepared(ROOM, POSE), local_map, POSE, POSE, LOOSE))
    assert isinstance(outcome, Rejected) or outcome.inlier_ratio < 0.55 < own.inlier_ratio


def test_every_second_point_tells_the_same() -> None:
    """Above ALIGN_POINTS the scan is thinned; what it tells must not halve by that."""
    local_map = map_of(ROOM, [POSE])
    coarse = matched(match_surface(prepared(ROOM, POSE, beams=400), local_map, POSE, POSE, LOOSE))
    fine = matched(match_surface(prepared(ROOM, POSE, beams=1600), local_map, POSE, POSE, LOOSE))
    ratio = np.diag(fine.information) / np.diag(coarse.information)
    assert ratio == pytest.approx(np.full(3, 4.0), rel=0.3)


# ---- the bare corridor -----------------------------------------------------------------------


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS, angle=st.floats(-3.1, 3.1), heading=st.floats(-3.1, 3.1))
def test_a_bare_corridor_is_not_observed_along_and_the_prior_holds_there(
    seed: int, angle: float, heading: float
) -> None:
    random = np.random.default_rng(seed)
    T_world = se2(2.0, 1.0, angle)
    segments = turned(CORRIDOR, T_world)
    before = [T_world @ se2(x, 0.2, heading) for x in (0.0, 0.3)]
    local_map = map_of(segments, before, 0.01, seed)
    T_true = T_world @ se2(0.6, 0.1, heading)
    scan = prepared(segments, T_true, noise_m=0.01, random=random, max_range_m=6.0)
    T_expected = T_true @ se2(*random.uniform(-0.1, 0.1, 2), random.uniform(-0.03, 0.03))
    match = matched(match_surface(scan, local_map, T_expected, T_expected, (0.05, 0.05)))
    in_corridor = inverse(T_world) @ match.T_frame_base
    assert in_corridor[1, 2] == pytest.approx(0.1, abs=0.015)
    expected_along = (inverse(T_world) @ T_expected)[0, 2]
    assert in_corridor[0, 2] == pytest.approx(expected_along, abs=0.004), "odometry holds it"
    along_base = np.array([math.cos(heading), -math.sin(heading)])
    assert abs(match.weak_base @ along_base) > math.cos(math.radians(3.0))
    across_base = np.array([-along_base[1], along_base[0]])
    along = along_base @ match.information[:2, :2] @ along_base
    across = across_base @ match.information[:2, :2] @ across_base
    assert along < 0.02 * across
    assert match.weak_sigma_m > 0.05


def test_weakest_direction_of_known_information() -> None:
    sigma, direction = weakest_direction(np.diag([100.0, 4.0, 50.0]))
    assert sigma == pytest.approx(0.5)
    assert np.abs(direction) == pytest.approx([0.0, 1.0])
    # a position known only together with the yaw: marginalised, nothing is left of it
    J = np.array([0.0, 1.0, 2.0])
    sigma, direction = weakest_direction(100.0 * np.outer(J, J) + np.diag([9.0, 0.0, 0.0]))
    assert np.abs(direction) == pytest.approx([0.0, 1.0])
    assert sigma > 100.0
    assert math.isfinite(weakest_direction(np.zeros((3, 3)))[0])


@settings(deadline=None)
@given(seed=SEEDS)
def test_weakest_direction_is_that_of_the_covariance(seed: int) -> None:
    root = np.random.default_rng(seed).normal(size=(3, 3))
    information = root @ root.T + 0.1 * np.eye(3)
    sigma, direction = weakest_direction(information)
    covariance = np.linalg.inv(information)[:2, :2]
    assert sigma**2 == pytest.approx(np.linalg.eigvalsh(covariance)[1])
    assert direction @ covariance @ direction == pytest.approx(sigma**2)


@settings(deadline=None)
@given(seed=SEEDS, yaw=st.floats(-3.1, 3.1))
def test_information_turns_into_base_axes_as_a_covariance_does(seed: int, yaw: float) -> None:
    root = np.random.default_rng(seed).normal(size=(3, 3))
    in_frame = root @ root.T + 0.1 * np.eye(3)
    in_base = to_base_axes(in_frame, yaw)
    R = np.eye(3)
    R[:2, :2] = se2(0.0, 0.0, yaw)[:2, :2]
    assert pytest.approx(R @ np.linalg.inv(in_base) @ R.T) == np.linalg.inv(in_frame)
    assert xyyaw(se2(0.0, 0.0, yaw))[2] == pytest.approx(yaw)


def test_the_noise_of_normals_is_no_information_along_a_bare_wall() -> None:
    """What a wall tells along itself by noisy normals is taken off, what it tells across stays."""
    weight = 100.0
    across, along = weight / SIGMA_M**2, weight * NORMAL_SIGMA_RAD**2 / SIGMA_M**2
    information = np.diag([0.8 * along, across, 50.0])
    left = observed(information, weight)
    assert left[0, 0] == pytest.approx(0.0, abs=1e-9)
    assert left[1, 1] == pytest.approx(across, rel=0.01)
    assert left[2, 2] == pytest.approx(50.0)
    assert np.linalg.eigvalsh(left)[0] > -1e-9
    both = observed(np.stack([information, 2.0 * information]), np.array([weight, weight]))
    np.testing.assert_allclose(both[0], left, atol=1e-9)
    assert both[1, 0, 0] == pytest.approx(0.6 * along)


def test_noisier_normals_tell_less_along_a_wall() -> None:
    weight = 100.0
    along = weight * NORMAL_SIGMA_RAD**2 / SIGMA_M**2
    information = np.diag([10.0 * along, 1e6, 50.0])
    assert observed(information, weight, 2.0)[0, 0] == pytest.approx(6.0 * along)
    assert observed(information, weight, 4.0)[0, 0] == pytest.approx(0.0, abs=1e-6)
