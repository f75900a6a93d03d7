"""Each kernel of the depth projection against a plain twin."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from datasets.messages import Float32s
from fusion.depth_kernels import Gate, find_surfaces, is_flying, tally
from fusion.depth_labels import _flying

Ints = npt.NDArray[np.int32]
GATE = Gate(0.3, 0.35, 0.002, -0.03, 0.03, 0.5, 0.01, 3.5)
FOCAL_BASELINE, STEEPEST, PER_M = 5.0, 0.3, 50.0


def rough_image(rng: np.random.Generator, shape: tuple[int, int]) -> Float32s:
    """Slopes with steps and holes in them."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    depth = (
        1.0
        + 0.02 * u
        + 0.6 * (v > shape[0] // 2) * (u > 4)
        + 0.5 * (u % 9 > 5)
        + rng.normal(0, 0.01, shape)
    )
    depth[rng.random(shape) < 0.1] = np.nan
    return depth.astype(np.float32)


@pytest.mark.parametrize("step", [1, 2, 3])
@pytest.mark.parametrize("shape", [(23, 31), (1, 9), (8, 1)])
def test_pixels_are_counted_as_plain_numpy_counts_them(step: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(step)
    depth = rough_image(rng, shape)
    small = depth[::step, ::step]
    planars = rng.uniform(0.9, 1.2, small.shape).astype(np.float32)
    margins = rng.uniform(0.0, 0.05, small.shape).astype(np.float32)
    bins = rng.integers(-1, 5, small.shape).astype(np.int16)
    exits = rng.integers(-1, 4, small.shape).astype(np.int16)
    count, total = np.zeros((5, 150), np.int32), np.zeros((5, 150), np.float32)
    free = np.zeros((5, 4), np.int32)
    rows = (0, small.shape[0])
    maps = (margins, planars, bins, exits)
    limits = (FOCAL_BASELINE, STEEPEST, PER_M)
    tally(depth, step, rows, GATE, *maps, *limits, count, total, free)

    column, row = np.meshgrid(np.arange(small.shape[1]), np.arange(small.shape[0]))
    z = np.where(small > 0, small, 1.0).astype(np.float64)
    rise = GATE.rise + column * GATE.per_column + row * GATE.per_row
    high, range_m = GATE.height + rise * z, z * planars
    edge = np.maximum(GATE.lower, GATE.tilt * range_m + GATE.height * z * margins)
    considered = (small > 0) & (bins >= 0) & (high <= GATE.upper)
    inside = considered & (high > edge) & (range_m <= GATE.reach)
    bare = considered & ~inside & (exits >= 0) & (high > -edge)
    inside &= ~_flying(depth, FOCAL_BASELINE, STEEPEST)[::step, ::step]
    cells = (range_m[inside] * PER_M).astype(int)
    kept = cells < 150
    expected, sums, seen = np.zeros((5, 150)), np.zeros((5, 150)), np.zeros((5, 4))
    np.add.at(expected, (bins[inside][kept], cells[kept]), 1)
    np.add.at(sums, (bins[inside][kept], cells[kept]), range_m[inside][kept])
    np.add.at(seen, (bins[bare], exits[bare]), 1)
    assert count.sum() == expected.sum()
    # A range on the border of two cells may round either way.
    assert np.abs(count - expected).sum() <= 2
    assert total.sum(axis=1) == pytest.approx(sums.sum(axis=1), rel=1e-4)
    assert (free == seen).all()


def test_zero_and_inf_are_nothing() -> None:
    """Readers give NaN for holes; what else comes through must not fall anywhere."""
    depth = np.tile(np.array([0.0, np.inf, -1.0], np.float32), (4, 5))
    ones, nowhere = np.ones(depth.shape, np.float32), np.zeros(depth.shape, np.int16)
    count, total = np.zeros((1, 150), np.int32), np.zeros((1, 150), np.float32)
    free = np.zeros((1, 1), np.int32)
    maps = (0.1 * ones, ones, nowhere, nowhere)
    limits = (FOCAL_BASELINE, STEEPEST, PER_M)
    tally(depth, 1, (0, 4), GATE, *maps, *limits, count, total, free)
    assert count.sum() == 0
    assert free.sum() == 0


def test_flying_pixels_are_those_of_the_twin() -> None:
    depth = rough_image(np.random.default_rng(3), (40, 50))
    expected = _flying(depth, FOCAL_BASELINE, STEEPEST)
    found = np.array(
        [[is_flying(depth, v, u, FOCAL_BASELINE, STEEPEST) for u in range(50)] for v in range(40)]
    )
    valid = depth > 0
    assert 0.05 < expected[valid].mean() < 0.95
    assert (found == expected)[valid].all()


def test_a_slanted_plane_has_no_flying_pixels_and_a_step_has() -> None:
    v, u = np.mgrid[0:20, 0:30]
    disparity = 8.0 + 0.15 * u - 0.1 * v
    assert not _flying((5.0 / disparity).astype(np.float32), 5.0, 0.2).any()
    disparity[:, 15:] += 1.0
    flying = _flying((5.0 / disparity).astype(np.float32), 5.0, 0.2)
    assert flying[:, 14:16].all()
    assert flying.sum() == 40


def surfaces_of(
    count: Ints, total: Float32s, halves: Ints, needs: Float32s, max_range_m: float
) -> tuple[npt.NDArray[np.float64], Ints, npt.NDArray[np.float64], Float32s]:
    bins = len(count)
    ranges, suspects = np.empty(bins), np.empty(bins)
    members, out = np.empty(bins, np.int32), np.empty((count.size, 2), np.float32)
    found = find_surfaces(
        count, total, halves, needs, max_range_m, 0.02, 0.25, ranges, members, suspects, out
    )
    return ranges, members, suspects, out[:found]


def plain_clusters(
    count: Ints, total: Float32s, halves: Ints, needs: Float32s, max_range_m: float
) -> list[tuple[float, int]]:
    """One bin's clusters, as the docstring of ``find_surfaces`` tells it."""
    clusters: list[tuple[float, int]] = []
    cell = taken = last = 0

    def window(middle: int) -> slice:
        return slice(max(middle - halves[middle], taken), middle + halves[middle] + 1)

    while cell < len(count):
        need = float(needs[cell])
        if last and cell <= taken + halves[cell]:
            need = max(need, 0.25 * last)
        if count[window(cell)].sum() < need:
            cell += 1
            continue
        best, limit, middle = cell, cell + 5 * int(halves[cell]) // 2, cell
        while middle < min(limit, len(count) - 1):
            middle += 1
            if count[window(middle)].sum() > count[window(best)].sum():
                best, limit = middle, max(limit, cell + 5 * int(halves[middle]) // 2)
        chosen = window(best)
        last = int(count[chosen].sum())
        range_m = float(total[chosen].sum() / last)
        taken = cell = min(chosen.stop, len(count))
        if range_m > max_range_m:
            break
        clusters.append((range_m, last))
    return clusters


def test_clusters_are_those_of_the_plain_twin() -> None:
    rng = np.random.default_rng(5)
    count = (rng.poisson(0.6, (40, 120)) * (rng.random((40, 120)) < 0.5)).astype(np.int32)
    count[:, 50:54] += rng.poisson(5, (40, 4)).astype(np.int32)
    total = (count * (np.arange(120) + 0.5) * 0.02).astype(np.float32)
    halves = np.linspace(1, 5, 120).astype(np.int32)
    needs = np.linspace(12, 4, 120).astype(np.float32)
    ranges, members, suspects, out = surfaces_of(count, total, halves, needs, 2.2)
    for bearing in range(40):
        expected = plain_clusters(count[bearing], total[bearing], halves, needs, 2.2)
        mine = out[out[:, 0] == bearing, 1]
        assert mine == pytest.approx([range_m for range_m, _ in expected], rel=1e-5)
        if expected:
            assert ranges[bearing] == pytest.approx(expected[0][0], rel=1e-5)
            assert members[bearing] == expected[0][1]
            assert suspects[bearing] <= ranges[bearing] + 0.2
        else:
            assert math.isinf(ranges[bearing])


def test_the_mean_of_a_noisy_surface_is_found_not_its_nearest_pixel() -> None:
    rng = np.random.default_rng(0)
    ranges = rng.normal(3.0, 0.04, (200, 100))
    count, total = np.zeros((200, 200), np.int32), np.zeros((200, 200), np.float32)
    bins = np.repeat(np.arange(200), 100)
    cells = (ranges.ravel() * 50).astype(int)
    np.add.at(count, (bins, cells), 1)
    np.add.at(total, (bins, cells), ranges.ravel().astype(np.float32))
    halves, needs = np.full(200, 5, np.int32), np.full(200, 5.0, np.float32)
    found, members, _, out = surfaces_of(count, total, halves, needs, 4.0)
    assert found.mean() == pytest.approx(3.0, abs=0.001)
    assert ranges.min(axis=1).mean() < 2.91  # what the paper's minimum makes of it
    assert members.mean() > 95
    assert len(out) == 200
