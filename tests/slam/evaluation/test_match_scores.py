"""Probability grids and scores that can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datasets.messages import Array
from slam.evaluation.match_scores import (
    ScoreGrid,
    ScoreGridConfig,
    evenly_spaced,
    match_score,
    submap_grid,
    summarise,
)

CONFIG = ScoreGridConfig()


def probability(odds: float) -> float:
    return odds / (1 + odds)


def value(grid: ScoreGrid, x: float, y: float) -> float:
    column, row = np.floor((np.array([x, y]) - grid.corner_submap_m) / grid.resolution_m)
    return float(grid.probability[int(row), int(column)])


def test_one_beam_in_an_asymmetric_grid() -> None:
    grid = submap_grid([np.array([0.02, 0.03])], [np.array([[0.52, 0.03]])], CONFIG)
    assert value(grid, 0.52, 0.03) == pytest.approx(0.55)
    for x in np.arange(0.02, 0.5, 0.05):
        assert value(grid, x, 0.03) == pytest.approx(0.49)
    assert np.isnan(value(grid, 0.57, 0.03))
    assert np.isnan(value(grid, 0.52, 0.08))
    assert np.isfinite(grid.probability).sum() == 11


def test_a_hit_counts_once_a_scan_and_goes_before_a_miss() -> None:
    """Two beams end in one cell, a third passes through it to another."""
    points = np.array([[0.52, 0.02], [0.53, 0.03], [1.02, 0.02]])
    grid = submap_grid([np.array([0.02, 0.02])], [points], CONFIG)
    assert value(grid, 0.52, 0.02) == pytest.approx(0.55)
    odds = 0.55 / 0.45
    twice = submap_grid([np.array([0.02, 0.02])] * 2, [points] * 2, CONFIG)
    assert value(twice, 0.52, 0.02) == pytest.approx(probability(odds**2))
    assert value(twice, 0.72, 0.02) == pytest.approx(probability((0.49 / 0.51) ** 2))


def test_probabilities_are_bounded() -> None:
    scans = 90
    points = np.array([[0.52, 0.02]])
    grid = submap_grid([np.array([0.02, 0.02])] * scans, [points] * scans, CONFIG)
    assert value(grid, 0.52, 0.02) == pytest.approx(0.9)
    assert value(grid, 0.22, 0.02) == pytest.approx(max(0.1, probability((0.49 / 0.51) ** 90)))


def passed_cells(origin: Array, end: Array) -> set[tuple[int, int]]:
    """Cells whose inside a segment crosses, by clipping it against each (the plain twin)."""
    found = set()
    low = np.floor(np.minimum(origin, end)).astype(int)
    high = np.floor(np.maximum(origin, end)).astype(int)
    for column in range(low[0], high[0] + 1):
        for row in range(low[1], high[1] + 1):
            enter, leave = 0.0, 1.0
            for a, b, cell in zip(origin, end, (column, row), strict=True):
                if a == b:
                    continue
                ends = sorted(((cell - a) / (b - a), (cell + 1 - a) / (b - a)))
                enter, leave = max(enter, ends[0]), min(leave, ends[1])
            if leave - enter > 1e-9:
                found.add((column, row))
    return found


def test_rays_pass_the_cells_that_they_cross() -> None:
    rng = np.random.default_rng(5)
    for _ in range(100):
        ends = rng.uniform(-1.0, 1.0, (2, 2))
        grid = submap_grid([ends[0]], [ends[1:]], CONFIG)
        corner = np.array(grid.corner_submap_m)
        crossed = passed_cells(*((ends - corner) / 0.05))
        rows, columns = np.nonzero(np.isfinite(grid.probability))
        assert set(zip(columns.tolist(), rows.tolist(), strict=True)) == crossed


def test_more_scans_than_a_submap_holds_are_thinned_evenly() -> None:
    config = ScoreGridConfig(scans_per_submap=3)
    points = [np.array([[0.52 + 0.05 * k, 0.02]]) for k in range(9)]
    grid = submap_grid([np.array([0.02, 0.02])] * 9, points, config)
    hit = [k for k in range(9) if value(grid, 0.52 + 0.05 * k, 0.02) > 0.5]
    assert hit == [0, 4, 8]
    assert value(grid, 0.52, 0.02) == pytest.approx(probability(0.55 / 0.45 * (0.49 / 0.51) ** 2))


def test_the_score_is_the_mean_of_the_cells_hit() -> None:
    cells = np.array([[0.2, 0.9], [np.nan, 0.6]], dtype=np.float32)
    grid = ScoreGrid((1.0, 2.0), 0.5, cells)
    points = np.array([[1.1, 2.1], [1.9, 2.4], [1.6, 2.6], [1.2, 2.9], [0.9, 2.1], [9.0, 9.0]])
    expected = (0.2 + 0.9 + 0.6 + 0.1 + 0.1 + 0.1) / 6
    assert match_score(grid, points) == pytest.approx(expected)
    assert match_score(grid, points[1:2]) == pytest.approx(0.9)


def test_a_scan_scores_best_where_it_was_taken() -> None:
    rng = np.random.default_rng(1)
    wall = np.column_stack([np.linspace(-2, 2, 400), np.full(400, 1.5)])
    wall = np.vstack([wall, np.column_stack([np.full(300, 2.0), np.linspace(-1.5, 1.5, 300)])])
    scans = [wall + rng.normal(0.0, 0.01, wall.shape) for _ in range(60)]
    grid = submap_grid([np.array([0.0, 0.0])] * 60, scans, CONFIG)
    here = match_score(grid, wall)
    assert here > 0.75
    assert all(match_score(grid, wall + np.array(d)) < here for d in ([0.1, 0], [0, 0.1], [1, 1]))


def test_summaries_count_what_was_tried() -> None:
    summary = summarise([0.6, 0.8, 0.7], tried=10)
    assert (summary.tried, summary.accepted) == (10, 3)
    assert (summary.minimum, summary.maximum) == (0.6, 0.8)
    assert summary.mean == pytest.approx(0.7)
    assert summarise([], tried=4).mean is None
    with pytest.raises(ValueError, match="tried"):
        summarise([0.5], tried=0)


def test_eight_evenly_spaced_in_time() -> None:
    stamps_ns = np.arange(71, dtype=np.int64) * 1_000_000_000
    assert evenly_spaced(stamps_ns).tolist() == [0, 10, 20, 30, 40, 50, 60, 70]
    assert evenly_spaced(stamps_ns[::-1]).tolist() == [0, 10, 20, 30, 40, 50, 60, 70]
    assert evenly_spaced(stamps_ns[:5]).tolist() == [0, 1, 2, 3, 4]
    assert evenly_spaced(stamps_ns[:0]).size == 0
    crowded = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 1000], dtype=np.int64)
    assert evenly_spaced(crowded).tolist() == [0, 3, 4, 5, 6, 7, 8, 9]


@given(stamps=st.lists(st.integers(0, 10**18), max_size=40), count=st.integers(1, 12))
def test_the_choice_is_of_the_right_size_without_repeats(stamps: list[int], count: int) -> None:
    chosen = evenly_spaced(np.array(stamps, dtype=np.int64), count)
    assert chosen.size == min(count, len(stamps))
    assert len(set(chosen.tolist())) == chosen.size


def test_what_makes_no_grid_is_refused() -> None:
    origin = [np.zeros(2)]
    with pytest.raises(ValueError, match="without a point"):
        submap_grid(origin, [np.empty((0, 2))], CONFIG)
    with pytest.raises(ValueError, match="finite"):
        submap_grid(origin, [np.array([[np.nan, 0.0]])], CONFIG)
    with pytest.raises(ValueError, match="too large"):
        submap_grid(origin, [np.array([[1e4, 1e4]])], CONFIG)
    with pytest.raises(ValueError, match="origins"):
        submap_grid([], [np.zeros((1, 2))], CONFIG)
    grid = submap_grid(origin, [np.array([[1.0, 0.0]])], CONFIG)
    with pytest.raises(ValueError, match="N >= 1"):
        match_score(grid, np.empty((0, 2)))
