"""Straight walls in a map that is made of points, found without a random choice.

Source: the Hough transform after Duda and Hart, CACM 15(1), 1972, one wall after the other, each
fitted by total least squares to what lies near its line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.messages import Array

CELL_M = 0.05
ANGLES = 360
NEAR_M = (0.15, 0.10, 0.08)
GAP_M = 0.3
LEAST_LENGTH_M = 1.0
LEAST_FILLED = 0.8
LEAST_HITS = 0.1
BAND_M = 0.5
MOST_WALLS = 200


@dataclass(frozen=True, slots=True)
class WallLine:
    """A straight piece of wall. start_map, end_map : (2,), m, its ends on the fitted line."""

    start_map: Array
    end_map: Array

    @property
    def length_m(self) -> float:
        return float(np.hypot(*(self.end_map - self.start_map)))

    def along_across(self, points_map: Array) -> tuple[Array, Array]:
        """Where points (N, 2) lie along the wall from its start and across it, m, (N,) each."""
        direction = (self.end_map - self.start_map) / self.length_m
        from_start = points_map - self.start_map
        across = from_start @ np.array([-direction[1], direction[0]])
        return from_start @ direction, across


def fit_walls(points_map: Array) -> tuple[WallLine, ...]:
    """Find the straight walls of at least a metre, the best filled first.

    points_map : (N, 2), m, finite. A place counts once, however often it was seen, and not at
    all if it was hit far less often than is usual in this map, as where somebody walked.
    What lies within half a metre of a wall belongs to it and makes no wall of its own, so a wall
    that is there twice, a hand's breadth apart, is fitted once.
    """
    cells = _often_hit(points_map)
    walls: list[WallLine] = []
    for _ in range(MOST_WALLS):
        if len(cells) * CELL_M < LEAST_LENGTH_M:
            break
        centre, direction, votes = _strongest_line(cells)
        if votes * CELL_M < LEAST_LENGTH_M * LEAST_FILLED:
            break
        centre, direction = _refined(cells, centre, direction)
        pieces, used = _pieces(cells, centre, direction)
        walls.extend(pieces)
        for wall in pieces:
            along, across = wall.along_across(cells)
            inside = (along > -CELL_M) & (along < wall.length_m + CELL_M)
            used |= inside & (np.abs(across) < BAND_M)
        if not used.any():
            break
        cells = cells[~used]
    return tuple(walls)


def _often_hit(points_map: Array) -> Array:
    """The mean of the points in each cell that has enough of them, (M, 2), in a fixed order.

    Enough is a tenth of what is usual: half of all points lie in cells of at least that many.
    """
    indices = np.floor(points_map / CELL_M).astype(np.int64)
    _, cell_of, counts = np.unique(indices, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(cell_of.reshape(-1), points_map[:, k], counts.size) for k in (0, 1)]
    means: Array = np.column_stack(sums) / counts[:, None]
    most = np.sort(counts)[::-1]
    usual = most[np.searchsorted(np.cumsum(most), len(points_map) / 2)] if most.size else 0
    return means[counts >= LEAST_HITS * usual]


def _strongest_line(cells: Array) -> tuple[Array, Array, int]:
    """(a point on it, its direction, votes) of the line with most cells within a bin's width.

    Bins of half a degree and of one cell across, neighbours summed in pairs.
    """
    middle = cells.mean(axis=0)
    centred = cells - middle
    reach_bins = int(np.ceil(np.hypot(*centred.T).max() / CELL_M)) + 2
    best = (-1, 0, 0)
    for index in range(ANGLES):
        angle = np.pi * index / ANGLES
        across = -np.sin(angle) * centred[:, 0] + np.cos(angle) * centred[:, 1]
        bins = np.floor(across / CELL_M).astype(np.int64) + reach_bins
        votes = np.bincount(bins, minlength=2 * reach_bins)
        pairs = votes[:-1] + votes[1:]
        peak = int(np.argmax(pairs))
        if pairs[peak] > best[0]:
            best = (int(pairs[peak]), index, peak)
    angle = np.pi * best[1] / ANGLES
    across_m = (best[2] + 1 - reach_bins) * CELL_M
    direction = np.array([np.cos(angle), np.sin(angle)])
    return middle + across_m * np.array([-direction[1], direction[0]]), direction, best[0]


def _refined(cells: Array, centre: Array, direction: Array) -> tuple[Array, Array]:
    """Total least squares over the cells nearer and nearer to the line."""
    for near_m in NEAR_M:
        offset = cells - centre
        near = np.abs(offset[:, 1] * direction[0] - offset[:, 0] * direction[1]) < near_m
        if near.sum() < 3:
            break
        centre = cells[near].mean(axis=0)
        _, vectors = np.linalg.eigh(np.cov((cells[near] - centre).T))
        direction = vectors[:, 1] if vectors[:, 1] @ direction > 0 else -vectors[:, 1]
    return centre, direction


def _pieces(
    cells: Array, centre: Array, direction: Array
) -> tuple[list[WallLine], npt.NDArray[np.bool_]]:
    """The well filled pieces of a line between its gaps, and which cells lie on the line."""
    offset = cells - centre
    along = offset @ direction
    on_line = np.abs(offset[:, 1] * direction[0] - offset[:, 0] * direction[1]) < NEAR_M[-1]
    places = np.sort(along[on_line])
    ends = np.flatnonzero(np.diff(places) > GAP_M)
    pieces = []
    for run in np.split(places, ends + 1):
        if run.size == 0 or run[-1] - run[0] < LEAST_LENGTH_M:
            continue
        filled = np.unique(np.floor(run / CELL_M)).size * CELL_M
        if filled > LEAST_FILLED * (run[-1] - run[0]):
            pieces.append(WallLine(centre + run[0] * direction, centre + run[-1] * direction))
    return pieces, on_line
