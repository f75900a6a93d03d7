"""Scans matched in pairs: known motions and their inverses, information, the wrap of bearings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend import _kernels
from datasets.messages import Array
from datasets.se2 import inverse, se2, transform, xyyaw
from frontend.prepared import PreparedScan
from tests.frontend.rooms import CORRIDOR, OTHER_ROOM, ROOM, off_by, prepared, turned

SEEDS = st.integers(0, 2**32 - 1)
SIGMA_M = 0.03
POSE = se2(4.5, 3.0, 0.5)
FIELD_OF_VIEW = (-0.75 * math.pi, 1.5 * math.pi)
"""First bearing and width of a lidar that has no beams backwards."""


@dataclass(frozen=True)
class Pairs:
    """What comes of matching: see the kernel."""

    T_from_to: list[Array]
    information: Array
    stats: Array

    @property
    def inlier_ratios(self) -> Array:
        ratios: Array = self.stats[:, 2] / np.maximum(self.stats[:, 0], 1.0)
        return ratios


def match(
    scans: list[PreparedScan],
    T_map_nodes: list[Array],
    pairs: list[tuple[int, int]],
    *,
    iterations: int = 8,
    most_points: int = 120,
    damping: float = 1.0,
) -> Pairs:
    counts = [len(scan.points_base) for scan in scans]
    count = len(pairs)
    nodes: npt.NDArray[np.int64] = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    xyyaw_rows, information = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    stats = np.full((count, 4), np.nan)
    _kernels.match_pairs(
        np.ascontiguousarray(nodes[:, 0]),
        np.ascontiguousarray(nodes[:, 1]),
        np.array([xyyaw(T) for T in T_map_nodes]),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.concatenate([scan.points_base for scan in scans]),
        np.concatenate([scan.normals_base for scan in scans]),
        np.concatenate([scan.bearings_rad for scan in scans]),
        np.array([scan.origin_base for scan in scans]),
        most_points,
        0.15,
        0.1,
        0.03,
        SIGMA_M,
        iterations,
        damping,
        xyyaw_rows,
        information,
        stats,
    )
    return Pairs([se2(*row) for row in xyyaw_rows], information, stats)


def wrong_by(random: np.random.Generator, xy_m: float = 0.08, yaw_rad: float = 0.05) -> Array:
    return se2(*random.uniform(-xy_m, xy_m, 2), random.uniform(-yaw_rad, yaw_rad))


@settings(deadline=None, max_examples=30)
@given(seed=SEEDS)
def test_recovers_a_motion_and_its_inverse_from_wrong_starts_over_noise(seed: int) -> None:
    random = np.random.default_rng(seed)
    T_a, T_b = POSE, POSE @ se2(*random.uniform(-0.5, 0.5, 2), random.uniform(-1.0, 1.0))
    scans = [
        prepared(ROOM, T, noise_m=0.01, random=random, origin_base=(0.1, -0.05)) for T in (T_a, T_b)
    ]
    found = match(scans, [T_a, T_b @ wrong_by(random)], [(0, 1), (1, 0)])
    T_a_b = inverse(T_a) @ T_b
    for T_true, T in zip((T_a_b, inverse(T_a_b)), found.T_from_to, strict=True):
        away_m, away_rad = off_by(T_true, T)
        assert away_m < 0.02
        assert away_rad < math.radians(0.5)
    assert (found.stats[:, 1] > 60).all()
    assert (found.inlier_ratios > 0.6).all()
    assert (found.stats[:, 3] < 0.03).all()


def test_a_motion_without_noise_is_exact_to_a_millimetre() -> None:
    T_a, T_b = POSE, POSE @ se2(0.2, 0.1, 0.3)
    scans = [prepared(ROOM, T, beams=1440) for T in (T_a, T_b)]
    found = match(scans, [T_a, T_b @ se2(0.05, -0.04, 0.03)], [(0, 1)], most_points=2000)
    away_m, away_rad = off_by(inverse(T_a) @ T_b, found.T_from_to[0])
    assert away_m < 0.002
    assert away_rad < 0.001


@pytest.mark.parametrize("turn_deg", [45.0, 90.0, 179.0, 250.0])
def test_turning_the_map_changes_nothing(turn_deg: float) -> None:
    """Poses in the map only say where to begin: what is measured is relative."""
    T_new_old = se2(20.0, -3.0, math.radians(turn_deg))
    T_a, T_b = POSE, POSE @ se2(0.3, -0.2, 0.6)
    scans = [prepared(ROOM, T) for T in (T_a, T_b)]
    T_b_wrong = T_b @ se2(0.05, 0.04, -0.03)
    old = match(scans, [T_a, T_b_wrong], [(0, 1)])
    new = match(scans, [T_new_old @ T_a, T_new_old @ T_b_wrong], [(0, 1)])
    assert new.T_from_to[0] == pytest.approx(old.T_from_to[0], abs=1e-9)
    assert new.information == pytest.approx(old.information, rel=1e-6, abs=1e-3)


@pytest.mark.parametrize("turn_deg", [70.0, 180.0, 300.0])
def test_turning_the_room_changes_nothing(turn_deg: float) -> None:
    T_new_old = se2(-4.0, 8.0, math.radians(turn_deg))
    T_a, T_b = POSE, POSE @ se2(0.3, -0.2, 0.6)
    found = []
    for T in (np.eye(3), T_new_old):
        scans = [prepared(turned(ROOM, T), T @ T_node) for T_node in (T_a, T_b)]
        found.append(match(scans, [T @ T_a, T @ T_b], [(0, 1)]))
    assert found[1].T_from_to[0] == pytest.approx(found[0].T_from_to[0], abs=1e-4)
    scale = np.abs(found[0].information).max()
    assert found[1].information == pytest.approx(found[0].information, abs=0.01 * scale)


def test_the_base_may_be_turned_against_its_lidar() -> None:
    """The information is in the axes of ``to``, so it turns with that base alone."""
    T_a, T_b = POSE, POSE @ se2(0.3, -0.2, 0.6)
    turn = se2(0.0, 0.0, 1.1)
    scans = [prepared(ROOM, T, beams=720) for T in (T_a, T_b, T_b @ turn)]
    found = match(scans, [T_a, T_b, T_b @ turn], [(0, 1), (0, 2)], most_points=2000)
    assert max(off_by(found.T_from_to[0] @ turn, found.T_from_to[1])) < 2e-3
    in_base, in_turned = found.information
    scale = np.abs(in_base).max()
    assert pytest.approx(turn.T @ in_base @ turn, abs=0.03 * scale) == in_turned


def test_covariance_is_that_of_many_noisy_scans() -> None:
    """Monte Carlo: noise along the normals of ``to``, errors in the axes of ``to``."""
    sigma_m = 0.01
    random = np.random.default_rng(9)
    T_a, T_b = POSE, POSE @ se2(0.2, 0.1, 0.9)
    scan_a, scan_b = prepared(ROOM, T_a, beams=1440), prepared(ROOM, T_b, beams=160)
    T_a_b = inverse(T_a) @ T_b
    off, information = [], np.zeros((3, 3))
    runs = 300
    for _ in range(runs):
        noise = sigma_m * random.standard_normal((len(scan_b.points_base), 1))
        noisy = PreparedScan(
            **{
                **{name: getattr(scan_b, name) for name in PreparedScan.__slots__},
                "points_base": scan_b.points_base + noise * scan_b.normals_base,
            }
        )
        found = match([scan_a, noisy], [T_a, T_b], [(0, 1)], most_points=1000, damping=1e-3)
        off.append(xyyaw(inverse(T_a_b) @ found.T_from_to[0]))
        information += found.information[0] / runs
    expected = np.linalg.inv(information * (SIGMA_M / sigma_m) ** 2)
    measured = np.cov(np.array(off).T)
    ratios = np.linalg.eigvals(np.linalg.solve(expected, measured)).real
    assert (ratios > 0.5).all()
    assert (ratios < 2.0).all()
    # the axes matter here: in those of ``from`` the same information would be wrong
    assert np.abs(measured[0, 0] / expected[0, 0] - 1.0) < 0.5
    assert np.abs(measured[1, 1] / expected[1, 1] - 1.0) < 0.5


def test_a_bare_corridor_is_not_observed_along() -> None:
    T_a, T_b = se2(0.0, 0.1, 0.8), se2(0.4, -0.1, 2.0)
    scans = [prepared(CORRIDOR, T, max_range_m=6.0) for T in (T_a, T_b)]
    T_b_guess = se2(0.35, -0.05, 2.02)
    found = match(scans, [T_a, T_b_guess], [(0, 1)])
    along_b = np.array([math.cos(2.0), -math.sin(2.0)])
    across_b = np.array([math.sin(2.0), math.cos(2.0)])
    information = found.information[0, :2, :2]
    assert along_b @ information @ along_b < 0.01 * (across_b @ information @ across_b)
    T = T_a @ found.T_from_to[0]
    assert T[1, 2] == pytest.approx(-0.1, abs=0.005)
    assert T[0, 2] == pytest.approx(0.35, abs=0.03), "along, the guess holds"
    assert math.atan2(T[1, 0], T[0, 0]) == pytest.approx(2.0, abs=0.005)


def test_scans_of_other_rooms_do_not_match() -> None:
    random = np.random.default_rng(0)
    ratios = []
    for _ in range(10):
        T_b = se2(*random.uniform(2.5, 5.0, 2), random.uniform(-3.0, 3.0))
        scans = [prepared(ROOM, POSE), prepared(OTHER_ROOM, T_b)]
        ratios.append(match(scans, [POSE, POSE], [(0, 1)]).inlier_ratios[0])
    assert max(ratios) < 0.35


def test_scans_far_apart_match_nothing_and_say_so() -> None:
    scans = [prepared(ROOM, POSE), prepared(ROOM, POSE)]
    found = match(scans, [POSE, POSE @ se2(100.0, 0.0, 0.0)], [(0, 1)])
    tried, matched, weights, rms_m = found.stats[0]
    assert tried > 50
    assert (matched, weights, rms_m) == (0.0, 0.0, 0.0)
    assert not found.information.any()
    assert np.isfinite(found.T_from_to[0]).all()


def test_a_wall_is_not_matched_from_its_back() -> None:
    wall = np.array([[-3.0, 1.0, 3.0, 1.0]])
    front, back = se2(0.0, 0.0, 0.0), se2(0.0, 2.0, math.pi)
    found = match([prepared(wall, front), prepared(wall, back)], [front, back], [(0, 1)])
    assert found.stats[0, 1] == 0


def test_few_points_leave_no_information_behind() -> None:
    """With less than ten partners there is no match: no half-made numbers either."""
    wall = np.array([[1.0, -0.1, 1.0, 0.1]])
    scans = [prepared(wall, np.eye(3), beams=180) for _ in range(2)]
    found = match(scans, [np.eye(3), np.eye(3)], [(0, 1)])
    assert 0 < found.stats[0, 1] < 10
    assert not found.information.any()


def test_scans_without_points_are_borne() -> None:
    empty = prepared(ROOM, POSE, max_range_m=0.01)
    scans = [prepared(ROOM, POSE), empty, prepared(ROOM, POSE), empty]
    pairs = [(0, 1), (1, 0), (0, 2), (2, 3), (1, 3)]
    found = match(scans, [POSE] * 4, pairs)
    assert found.stats[[0, 1, 3, 4], 1].tolist() == [0.0] * 4
    assert found.inlier_ratios[2] > 0.9
    assert match(scans, [POSE] * 4, []).stats.shape == (0, 4)


@settings(deadline=None, max_examples=20)
@given(most=st.integers(10, 400))
def test_no_more_points_are_tried_than_were_asked_for(most: int) -> None:
    scans = [prepared(ROOM, POSE), prepared(ROOM, POSE)]
    found = match(scans, [POSE, POSE], [(0, 1)], most_points=most)
    known = scans[1].surface_count
    assert found.stats[0, 0] <= min(most, known)
    assert found.stats[0, 0] > 0.3 * min(most, known)


def test_pairs_do_not_depend_on_each_other() -> None:
    """Work space is shared inside; results must not be."""
    random = np.random.default_rng(1)
    poses = [POSE @ wrong_by(random, 0.3, 0.5) for _ in range(4)]
    scans = [prepared(ROOM, T, noise_m=0.01, random=random) for T in poses]
    starts = [T @ wrong_by(random) for T in poses]
    pairs = [(0, 1), (2, 1), (3, 0), (1, 3)]
    together = match(scans, starts, pairs)
    for k, pair in enumerate(pairs):
        alone = match(scans, starts, [pair])
        assert (alone.T_from_to[0] == together.T_from_to[k]).all()
        assert (alone.information[0] == together.information[k]).all()
        assert (alone.stats[0] == together.stats[k]).all()


# ---- bearings that wrap ----------------------------------------------------------------------


def test_little_is_lost_where_the_bearings_of_a_full_turn_wrap() -> None:
    """The same lidar with its first beam anywhere: the seam costs no more than a beam or two.

    Points whose neighbours lie across the seam are the ones in question.
    """
    T_a, T_b = POSE, POSE @ se2(0.2, 0.1, 0.3)
    ratios = []
    for turn in np.linspace(0.0, 2.0 * math.pi, 12, endpoint=False):
        spin = se2(0.0, 0.0, float(turn))
        scans = [prepared(ROOM, T @ spin) for T in (T_a, T_b)]
        found = match(scans, [T_a @ spin, T_b @ spin], [(0, 1)], most_points=1000)
        assert max(off_by(inverse(spin) @ inverse(T_a) @ T_b @ spin, found.T_from_to[0])) < 0.004
        ratios.append(found.stats[0, 1] / found.stats[0, 0])
    assert max(ratios) - min(ratios) < 0.03


def test_a_query_across_the_wrap_finds_the_wall_there() -> None:
    """A wall behind the sensor, on both sides of the seam, with no other wall to hold the pose."""
    walls_behind = np.array([[-2.0, -1.0, -2.0, 1.0], [-2.0, 1.0, -1.0, 1.0]])
    T_b = se2(0.0, 0.02, 0.0)
    scans = [prepared(walls_behind, T, beams=720) for T in (np.eye(3), T_b)]
    found = match(scans, [np.eye(3), T_b @ se2(0.03, 0.02, 0.01)], [(0, 1)], most_points=1000)
    assert found.stats[0, 1] > 0.95 * found.stats[0, 0]
    assert max(off_by(T_b, found.T_from_to[0])) < 0.002


def test_a_lidar_without_beams_behind_matches_too() -> None:
    T_a, T_b = POSE, POSE @ se2(0.3, 0.1, 2.9)
    first, width = FIELD_OF_VIEW
    scans = [prepared(ROOM, T, first_rad=first, fov_rad=width) for T in (T_a, T_b)]
    found = match(scans, [T_a, T_b @ se2(0.04, 0.03, 0.02)], [(0, 1)])
    assert max(off_by(inverse(T_a) @ T_b, found.T_from_to[0])) < 0.005
    seen = transform(found.T_from_to[0], scans[1].points_base)
    assert np.isfinite(seen).all()
