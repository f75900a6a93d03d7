"""The likelihood pyramid against its definition, and branch and bound against trying every pose."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import se2, transform
from tests.frontend.pyramids import CELL_M, HALF_BLOB, LEVELS, MARGIN, Pyramid, blob, maxima

ROWS, COLS = 64, 80
ORIGIN = (-1.3, 0.7)
SEEDS = st.integers(0, 2**32 - 1)
Pose = tuple[float, float, float]


def random_pyramid(random: np.random.Generator) -> Pyramid:
    """Any field at all, from nearly empty to dense, but for the free margin."""
    level0 = np.zeros((ROWS, COLS), dtype=np.uint8)
    inner = level0[MARGIN:-MARGIN, MARGIN:-MARGIN]
    filled = random.random(inner.shape) < random.choice([0.01, 0.05, 0.4])
    inner[:] = random.integers(0, 256, inner.shape) * filled
    return Pyramid.over(level0, ORIGIN)


def random_points(random: np.random.Generator, count: int, reach_m: float) -> Array:
    return random.uniform(-reach_m, reach_m, (count, 2))


def middle_pose(random: np.random.Generator) -> Pose:
    x = ORIGIN[0] + 0.5 * COLS * CELL_M + random.uniform(-0.2, 0.2)
    y = ORIGIN[1] + 0.5 * ROWS * CELL_M + random.uniform(-0.2, 0.2)
    return float(x), float(y), float(random.uniform(-3.0, 3.0))


def cells_of(points: Array, pose: Pose) -> Array:
    """(N, 2) row, col."""
    at = np.floor((transform(se2(*pose), points) - ORIGIN) / CELL_M).astype(np.int64)
    return at[:, ::-1]


@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, count=st.integers(0, 40), reach_m=st.floats(0.1, 3.0))
def test_stamped_levels_hold_what_they_promise(seed: int, count: int, reach_m: float) -> None:
    random = np.random.default_rng(seed)
    pyramid = Pyramid.empty(ROWS, COLS, ORIGIN)
    level0 = np.zeros((ROWS, COLS), dtype=np.uint8)
    for _ in range(2):
        points, pose = random_points(random, count, reach_m), middle_pose(random)
        pyramid.stamp(points, pose)
        for row, col in cells_of(points, pose):
            if MARGIN <= row < ROWS - MARGIN and MARGIN <= col < COLS - MARGIN:
                around = level0[
                    row - HALF_BLOB : row + HALF_BLOB + 1, col - HALF_BLOB : col + HALF_BLOB + 1
                ]
                np.maximum(around, blob(), out=around)
    assert (pyramid.level(0) == level0).all()
    for level in range(1, LEVELS):
        assert (pyramid.level(level) == maxima(level0, level)).all(), "neither less nor more"


def test_one_point_gives_one_blob_at_its_place() -> None:
    pyramid = Pyramid.empty(ROWS, COLS, ORIGIN)
    row, col = 30, 41
    point = np.array([[ORIGIN[0] + (col + 0.5) * CELL_M, ORIGIN[1] + (row + 0.5) * CELL_M]])
    pyramid.stamp(point, (0.0, 0.0, 0.0))
    level0 = pyramid.level(0).copy()
    assert (level0[row - 2 : row + 3, col - 2 : col + 3] == blob()).all()
    level0[row - 2 : row + 3, col - 2 : col + 3] = 0
    assert not level0.any()


@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, count=st.integers(1, 30), reach_m=st.floats(0.1, 30.0))
def test_score_is_the_mean_under_the_points(seed: int, count: int, reach_m: float) -> None:
    random = np.random.default_rng(seed)
    pyramid, pose = random_pyramid(random), middle_pose(random)
    points = random_points(random, count, reach_m)
    cells = cells_of(points, pose)
    inside = ((cells >= 0) & (cells < [ROWS, COLS])).all(axis=1)
    total = pyramid.level(0)[cells[inside, 0], cells[inside, 1]].astype(float).sum()
    assert pyramid.score(points, pose) == pytest.approx(total / 255.0 / count)


def test_no_points_score_nothing() -> None:
    pyramid = random_pyramid(np.random.default_rng(0))
    nothing = np.empty((0, 2))
    pyramid.stamp(nothing, (0.0, 0.0, 0.0))
    assert pyramid.score(nothing, (0.0, 0.0, 0.0)) == 0.0
    found, *pose, score, _ = pyramid.search(nothing, (0.1, 0.2, 0.3), 4, 2, 0.02)
    assert (found, pose, score) == (False, [0.1, 0.2, 0.3], 0.0)


# ---- branch and bound ------------------------------------------------------------------------


def every_pose(
    pyramid: Pyramid,
    points: Array,
    guess: Pose,
    half_cells: int,
    half_steps: int,
    yaw_step: float,
    penalty: tuple[float, float],
) -> tuple[Array, Array]:
    """(M, 3) all poses of the window, and their penalised scores (M,)."""
    offsets = np.arange(-half_cells, half_cells + 1)
    field = np.pad(pyramid.level(0), half_cells)
    poses, scores = [], []
    for step in range(-half_steps, half_steps + 1):
        turn = step * yaw_step
        cells = cells_of(points, (guess[0], guess[1], guess[2] + turn)) + half_cells
        for d_row in offsets:
            for d_col in offsets:
                at = cells + np.array([d_row, d_col])
                inside = ((at >= 0) & (at < field.shape)).all(axis=1)
                total = int(field[at[inside, 0], at[inside, 1]].astype(np.int64).sum())
                away2 = (d_row**2 + d_col**2) * CELL_M**2
                loss = penalty[0] * away2 + penalty[1] * turn**2
                scores.append(total / (255.0 * len(points)) - loss)
                poses.append(
                    (guess[0] + d_col * CELL_M, guess[1] + d_row * CELL_M, guess[2] + turn)
                )
    return np.array(poses), np.array(scores)


WINDOWS = {"half_cells": st.integers(0, 9), "half_steps": st.integers(0, 2)}
PENALTIES = st.tuples(st.sampled_from([0.0, 0.1, 3.0]), st.sampled_from([0.0, 0.5, 30.0]))


@settings(deadline=None, max_examples=60)
@given(seed=SEEDS, penalty=PENALTIES, reach_m=st.floats(0.2, 3.0), **WINDOWS)
def test_finds_what_trying_every_pose_finds(
    seed: int,
    penalty: tuple[float, float],
    reach_m: float,
    half_cells: int,
    half_steps: int,
) -> None:
    random = np.random.default_rng(seed)
    pyramid, guess = random_pyramid(random), middle_pose(random)
    points = random_points(random, 15, reach_m)
    poses, scores = every_pose(pyramid, points, guess, half_cells, half_steps, 0.07, penalty)
    found, *pose, score, scored = pyramid.search(
        points, guess, half_cells, half_steps, 0.07, penalty=penalty
    )
    assert found == (scores.max() > 0.0)
    assert scored >= 1
    if found:
        assert score == pytest.approx(scores.max(), abs=1e-12)
        there = np.abs(poses - pose).max(axis=1).argmin()
        assert poses[there] == pytest.approx(pose, abs=1e-12)
        assert scores[there] == pytest.approx(score, abs=1e-12)
        # no bound may be below what it bounds, or this would cut the best pose off
        found, *_, again, _ = pyramid.search(
            points,
            guess,
            half_cells,
            half_steps,
            0.07,
            penalty=penalty,
            min_score=score - 1e-9,
        )
        assert found
        assert again == score


@settings(deadline=None, max_examples=30)
@given(seed=SEEDS, half_cells=st.integers(3, 9))
def test_finds_the_second_peak_outside_the_zone_of_the_first(seed: int, half_cells: int) -> None:
    random = np.random.default_rng(seed)
    pyramid, guess = random_pyramid(random), middle_pose(random)
    points = random_points(random, 15, 1.0)
    window = (half_cells, 2, 0.07)
    poses, scores = every_pose(pyramid, points, guess, *window, (0.0, 0.0))
    first = poses[scores.argmax()]
    zone = (0.17, 0.1)
    near = np.hypot(*(poses[:, :2] - first[:2]).T) < zone[0]
    near &= np.abs(poses[:, 2] - first[2]) < zone[1]
    found, *pose, score, _ = pyramid.search(points, guess, *window, avoid=(*first, *zone))
    assume(scores[~near].max() > 0.0)
    assert found
    assert score == pytest.approx(scores[~near].max(), abs=1e-12)
    x, y, yaw = first
    for other_branch in (yaw + math.tau, yaw - math.tau):
        again = pyramid.search(points, guess, *window, avoid=(x, y, other_branch, *zone))
        assert again[:5] == (found, *pose, score)
    assert math.hypot(*(np.array(pose[:2]) - first[:2])) >= zone[0] or (
        abs(pose[2] - first[2]) >= zone[1]
    )


def test_only_what_beats_the_least_score_is_found() -> None:
    random = np.random.default_rng(11)
    pyramid, guess = random_pyramid(random), middle_pose(random)
    points = random_points(random, 15, 1.0)
    _, *_, best, needed = pyramid.search(points, guess, 6, 2, 0.07)
    assert not pyramid.search(points, guess, 6, 2, 0.07, min_score=best)[0]
    found, *_, again, fewer = pyramid.search(points, guess, 6, 2, 0.07, min_score=best - 1e-9)
    assert found
    assert again == best
    assert fewer <= needed


@settings(deadline=None, max_examples=25)
@given(seed=SEEDS, budget=st.integers(0, 400))
def test_a_search_ends_with_its_budget(seed: int, budget: int) -> None:
    random = np.random.default_rng(seed)
    pyramid, guess = random_pyramid(random), middle_pose(random)
    points = random_points(random, 15, 1.0)
    _, *_, best, needed = pyramid.search(points, guess, 9, 6, 0.03)
    found, *pose, score, scored = pyramid.search(points, guess, 9, 6, 0.03, budget=budget)
    roots = 3 * 3  # boxes of 8 x 8 cells, the coarsest, over 19 x 19
    assert scored <= budget + roots + 4
    assert score <= best
    if scored == needed:
        assert score == best
    if found:
        assert pyramid.score(points, tuple(pose)) == pytest.approx(score, abs=0.02)


def test_points_that_leave_the_window_of_the_field_count_nothing() -> None:
    """At each border: a scan half inside, half far outside."""
    pyramid = Pyramid.empty(ROWS, COLS, ORIGIN)
    spot = np.array([[ORIGIN[0] + 40.5 * CELL_M, ORIGIN[1] + 32.5 * CELL_M]])
    pyramid.stamp(spot, (0.0, 0.0, 0.0))
    for away in ([0.0, 50.0], [0.0, -50.0], [50.0, 0.0], [-50.0, 0.0], [-2.1, 0.0], [0.0, -1.7]):
        points = np.vstack([spot, spot + away])
        found, x, y, _, score, _ = pyramid.search(points, (0.15, -0.1, 0.0), 5, 0, 0.1)
        assert found
        assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-9)
        assert score == pytest.approx(0.5)
