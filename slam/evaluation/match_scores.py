"""Constraint matching scores (paper, table 5), on grids that are the same for every system.

The score is the one that Cartographer's constraint builder reports in its score histogram: the mean
probability of the submap's grid at the cells that the scan's points fall into.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from datasets.messages import Array
from datasets.section import Section
from datasets.trajectory import Stamps
from slam.evaluation.surfaces import Ints

LEAST_PROBABILITY, MOST_PROBABILITY = 0.1, 0.9
"""Cartographer's bounds; a cell that nothing is known of counts as the lower one."""
BORDER_CELLS = 2
MAX_CELLS = 16_000_000


class ScoreGridConfig(Section):
    """How the grids are built: to be held equal over the rows of a table and printed under it."""

    hit_probability: float = Field(0.55, gt=0.5, lt=MOST_PROBABILITY)
    miss_probability: float = Field(0.49, gt=LEAST_PROBABILITY, lt=0.5)
    resolution_m: float = Field(0.05, ge=0.005, le=1.0)
    scans_per_submap: int = Field(90, ge=1, le=10_000)

    def __str__(self) -> str:
        return (
            f"hit {self.hit_probability:g}, miss {self.miss_probability:g}, cells of "
            f"{self.resolution_m:g} m, at most {self.scans_per_submap} scans a submap"
        )


@dataclass(frozen=True, slots=True)
class ScoreGrid:
    """The probability that a cell is occupied.

    corner_submap_m : (x, y) of the lower left corner of cell [0, 0], submap frame.
    probability     : (H, W) float32, row 0 lowest; NaN where nothing is known.
    """

    corner_submap_m: tuple[float, float]
    resolution_m: float
    probability: npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ScoreSummary:
    """Scores of accepted constraints, and how many were tried. None without any."""

    tried: int
    accepted: int
    minimum: float | None
    maximum: float | None
    mean: float | None


def submap_grid(
    origins_submap: Sequence[Array], points_submap: Sequence[Array], config: ScoreGridConfig
) -> ScoreGrid:
    """Build the grid of one submap, or of one of its layers, as Cartographer builds it.

    origins_submap : a sensor's place (2,) m for each scan. points_submap : its hits (N, 2) m.

    Each scan changes a cell once: by the odds of a hit, or of a miss where rays only pass; the
    odds are held between those of 0.1 and 0.9. Of more scans than ``scans_per_submap`` that many
    are taken, evenly over their order. Raises ValueError without any point, for values that are
    not finite, and for a submap of more than 16 million cells.
    """
    from slam.evaluation.match_score_kernels import insert_scan  # noqa: PLC0415

    if len(origins_submap) != len(points_submap):
        raise ValueError(f"{len(origins_submap)} origins for {len(points_submap)} scans")
    taken = evenly_spaced(np.arange(len(points_submap)), config.scans_per_submap).tolist()
    origins = np.array([origins_submap[k] for k in taken], dtype=np.float64).reshape(-1, 2)
    scans = [np.asarray(points_submap[k], dtype=np.float64).reshape(-1, 2) for k in taken]
    every = np.concatenate([origins, *scans])
    if len(every) == len(origins):
        raise ValueError("a submap without a point has no grid")
    if not np.isfinite(every).all():
        raise ValueError("points of a submap must be finite")
    low = np.floor(every.min(axis=0) / config.resolution_m) - BORDER_CELLS
    size = np.floor(every.max(axis=0) / config.resolution_m) - low + 1 + BORDER_CELLS
    if size.prod() > MAX_CELLS:
        raise ValueError(f"a submap of {size[0]:.0f} x {size[1]:.0f} cells is too large")
    log_odds = np.zeros((int(size[1]), int(size[0])), dtype=np.float32)
    updated = np.zeros(log_odds.shape, dtype=np.int32)
    bounds = (_log_odds(LEAST_PROBABILITY), _log_odds(MOST_PROBABILITY))
    steps = (_log_odds(config.hit_probability), _log_odds(config.miss_probability))
    for number, (origin, points) in enumerate(zip(origins, scans, strict=True), start=1):
        insert_scan(
            log_odds,
            updated,
            number,
            origin / config.resolution_m - low,
            points / config.resolution_m - low,
            *steps,
            *bounds,
        )
    probability = (1.0 / (1.0 + np.exp(-log_odds))).astype(np.float32)
    probability[updated == 0] = np.nan
    corner = low * config.resolution_m
    return ScoreGrid((float(corner[0]), float(corner[1])), config.resolution_m, probability)


def match_score(grid: ScoreGrid, points_submap: Array) -> float:
    """The mean probability at the cells of a scan's points, in (0, 1).

    points_submap : (N, 2) m, finite, N >= 1: at the pose that the match found.

    The cell that holds a point counts, without interpolation, as in Cartographer's fast correlative
    matcher; what is unknown or beyond the grid counts 0.1. (That matcher rounds probabilities to
    8 bit, 0.3 % of its range: this does not.) Raises ValueError for other points.
    """
    if points_submap.ndim != 2 or points_submap.shape[1] != 2 or not len(points_submap):
        raise ValueError(f"points must be (N, 2) with N >= 1, not {points_submap.shape}")
    if not np.isfinite(points_submap).all():
        raise ValueError("points must be finite")
    height, width = grid.probability.shape
    column, row = np.floor((points_submap - grid.corner_submap_m) / grid.resolution_m).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = np.full(len(points_submap), LEAST_PROBABILITY)
    read = grid.probability[row[inside].astype(np.int64), column[inside].astype(np.int64)]
    found[inside] = np.where(np.isnan(read), LEAST_PROBABILITY, read)
    return float(found.mean())


def summarise(scores: Sequence[float], tried: int) -> ScoreSummary:
    """scores : of the accepted constraints. Raises ValueError if fewer were tried than accepted."""
    if tried < len(scores):
        raise ValueError(f"{len(scores)} accepted of {tried} tried")
    if not len(scores):
        return ScoreSummary(tried, 0, None, None, None)
    values = np.asarray(scores, dtype=np.float64)
    return ScoreSummary(
        tried, values.size, float(values.min()), float(values.max()), float(values.mean())
    )


def evenly_spaced(stamps_ns: Stamps, count: int = 8) -> Ints:
    """Indices, ascending, of ``count`` constraints evenly spaced in time; the paper has 8.

    stamps_ns : (N,) in any order. The nearest to each of ``count`` even times from the first to the
    last, none twice; all of them if there are no more.
    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    if stamps.size <= count:
        return np.arange(stamps.size)
    since = (stamps - stamps.min()).astype(np.float64)
    free = np.ones(stamps.size, dtype=np.bool_)
    for target in np.linspace(0.0, since.max(), count):
        free[np.argmin(np.where(free, np.abs(since - target), np.inf))] = False
    return np.flatnonzero(~free)


def _log_odds(probability: float) -> float:
    return math.log(probability / (1.0 - probability))
