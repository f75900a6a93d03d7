"""What scans can tell of each other: walls where there are walls, none in what was free."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import se2
from frontend.agreement import GAP_RAD, MARGIN_M, MARGIN_RATIO, agreement
from frontend.prepared import PreparedScan
from frontend.view_kernels import AGREES, CONTRADICTS, HIDDEN, compare_with_view
from tests.frontend.rooms import CORRIDOR, ROOM, SQUARE, prepared

HALF = {"beams": 180, "first_rad": -math.pi / 2, "fov_rad": math.pi}
HERE = se2(4.5, 3.0, 0.3)


def verdicts(points: Array, view: PreparedScan, before: int = HIDDEN) -> list[int]:
    told = np.full(len(points), before, dtype=np.uint8)
    origin = view.origin_base
    compare_with_view(
        points,
        view.points_base,
        view.bearings_rad,
        float(origin[0]),
        float(origin[1]),
        MARGIN_M,
        MARGIN_RATIO,
        GAP_RAD,
        told,
    )
    return told.tolist()


def twin(points: Array, view: PreparedScan) -> list[int]:
    """The same by NumPy, one point after the other."""
    rays = view.points_base - view.origin_base
    ranges = np.hypot(*rays.T)
    told = []
    for ray in points - view.origin_base:
        bearing, range_m = math.atan2(ray[1], ray[0]), math.hypot(*ray)
        after = int(np.searchsorted(view.bearings_rad, bearing, side="right"))
        verdict = HIDDEN
        if 0 < after < len(ranges):
            pair = ranges[after - 1 : after + 1]
            margin = MARGIN_M + MARGIN_RATIO * range_m
            if np.diff(view.bearings_rad[after - 1 : after + 1])[0] <= GAP_RAD:
                if range_m < pair.min() - margin:
                    verdict = CONTRADICTS
                elif range_m < pair.max() + margin:
                    verdict = AGREES
        told.append(verdict)
    return told


def test_a_point_agrees_on_a_wall_contradicts_before_it_and_is_hidden_behind_it() -> None:
    view = prepared(SQUARE, np.eye(3), **HALF)  # looks along x at a wall 3 m away
    points = np.array([[3.0, 0.0], [2.9, 0.4], [2.0, 0.0], [1.0, -0.5], [4.0, 0.0], [-2.0, 0.1]])
    assert verdicts(points, view) == [AGREES, AGREES, CONTRADICTS, CONTRADICTS, HIDDEN, HIDDEN]


def test_what_agreed_with_one_view_is_not_contradicted_by_the_next() -> None:
    view = prepared(SQUARE, np.eye(3), **HALF)
    points = np.array([[2.0, 0.0], [4.0, 0.0]])
    assert verdicts(points, view, AGREES) == [AGREES, AGREES]
    assert verdicts(points, view, CONTRADICTS) == [CONTRADICTS, CONTRADICTS]


def test_nothing_is_known_between_beams_that_are_far_apart() -> None:
    view = prepared(SQUARE, np.eye(3), beams=60)  # 0.105 rad apart
    assert verdicts(np.array([[2.0, 0.0], [3.0, 0.5]]), view) == [HIDDEN, HIDDEN]


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_kernel_tells_what_its_twin_tells(seed: int) -> None:
    random = np.random.default_rng(seed)
    view = prepared(ROOM, HERE, beams=200, origin_base=(0.2, -0.1), noise_m=0.02, random=random)
    points = random.uniform(-6.0, 6.0, (80, 2))
    assert verdicts(points, view) == twin(points, view)


def others(*poses: Array) -> list[tuple[PreparedScan, Array]]:
    return [(prepared(ROOM, T, **HALF), T) for T in poses]


BEFORE = others(HERE @ se2(-2.0, 0.1, -0.5), HERE @ se2(-1.0, 0.0, -0.3))


def test_a_scan_agrees_where_it_was_taken_and_nowhere_else() -> None:
    scan = prepared(ROOM, HERE, **HALF)
    here = agreement(scan, HERE, BEFORE)
    assert here.share > 0.97
    assert here.agreeing + here.contradicting < here.total, "some of it is out of sight"
    for off in (se2(0.6, 0, 0), se2(0, -0.6, 0), se2(0, 0, 0.35), se2(0, 0, -0.35)):
        assert agreement(scan, HERE @ off, BEFORE).share < 0.8


def test_the_frame_and_the_order_of_the_scans_are_nothing_to_it() -> None:
    scan = prepared(ROOM, HERE, **HALF)
    T = se2(-30.0, 12.0, 2.0)
    moved = [(other, T @ pose) for other, pose in reversed(BEFORE)]
    assert agreement(scan, T @ HERE, moved) == agreement(scan, HERE, BEFORE)


def test_without_another_scan_nothing_agrees() -> None:
    nothing = agreement(prepared(ROOM, HERE), HERE, [])
    assert (nothing.agreeing, nothing.contradicting, nothing.share) == (0, 0, 0.0)


def test_scans_that_look_away_from_each_other_tell_nothing() -> None:
    ahead, back = se2(0.0, 0.0, 0.0), se2(-0.5, 0.0, math.pi)
    seen = agreement(
        prepared(CORRIDOR, ahead, **HALF), ahead, [(prepared(CORRIDOR, back, **HALF), back)]
    )
    assert seen.contradicting == 0


def test_what_was_seen_through_contradicts_as_well() -> None:
    """A wall of an earlier scan where the scan at hand looks through: its points are counted."""
    view = prepared(SQUARE, np.eye(3), **HALF)
    scan = prepared(SQUARE * 2.0, np.eye(3), **HALF)  # all it sees is 6 m away
    seen = agreement(scan, np.eye(3), [(view, np.eye(3))])
    assert seen.agreeing == 0
    assert seen.contradicting > 150, "the earlier scan's points"
    assert seen.share == pytest.approx(0.0)
