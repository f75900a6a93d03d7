"""How thick the walls of a map are: a wall that is there twice is a thick one.

Needs no ground truth: it shows whether all passes by a wall laid it on the same place.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from datasets.errors import InputError
from datasets.messages import Array
from datasets.se2 import compose
from datasets.trajectory import Stamps, Trajectory
from slam.evaluation.wall_fit import BAND_M, WallLine, fit_walls
from slam.mapping.scan_store import BEAM, ScanStore

STRETCH_M = 0.5
COLUMNS = 5
LEAST_COLUMNS = 3
GLIMPSE_S = 2.0
LEAST_GLIMPSES = 3
LEAST_POINTS = 5
THIN_M = 0.10
COVERED = 0.95
CELL_M = 0.05

Glimpses = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class WallThickness:
    """The thickness of the fitted walls of a map, stretch by stretch.

    walls       : the fitted walls.
    thickness_m : (K,), one for each stretch of half a metre, wall after wall; K >= 1.
    wall_of     : (K,), which wall a stretch belongs to.
    places_map  : (K, 2), the middle of each stretch on its wall.
    left_out    : stretches that were seen too little, or that are no bare wall.
    """

    walls: tuple[WallLine, ...]
    thickness_m: Array
    wall_of: npt.NDArray[np.int64]
    places_map: Array
    left_out: int

    @property
    def percentile_95_m(self) -> float:
        return float(np.percentile(self.thickness_m, 95.0))

    @property
    def median_m(self) -> float:
        return float(np.median(self.thickness_m))

    def __str__(self) -> str:
        p95_m, median_m = self.percentile_95_m, self.median_m
        return (
            f"wall thickness (central {COVERED:.0%} of the hits): 95th percentile {p95_m:.3f} m = "
            f"{p95_m / CELL_M:.1f} cells of 5 cm, median {median_m:.3f} m = "
            f"{median_m / CELL_M:.1f} cells; n = {self.thickness_m.size} stretches of "
            f"{STRETCH_M} m on {len(self.walls)} walls, {self.left_out} left out"
        )


def wall_thickness(points_map: Array, stamps_ns: Stamps) -> WallThickness:
    """Measure the spread of points across the walls that they form.

    points_map : (N, 2), m, finite: the hits of all scans at their final poses.
    stamps_ns  : (N,) int64, the stamp of the scan each point comes from.

    A wall is cut into stretches of 0.5 m, and these into columns of 0.1 m. A column is as thick
    as the strip between the 2.5 % and 97.5 % quantiles of its points within 0.5 m of the wall; a
    stretch is as thick as the median of its columns. Every glimpse of two seconds weighs the
    same, so that a halt on one pass cannot hide the other passes.

    Poses are right relative to each other within a glimpse: what is thicker than 0.1 m in more
    than a quarter of the single glimpses is thick in the world, such as a shelf, a glazed door
    or the end of another wall, and is left out. What is thin each time and thick in all was
    laid on several places. Nothing is subtracted for the noise of the sensor: 1 cm (one sigma)
    alone shows as 4 cm. A double farther off than 0.5 m is taken as a wall of its own.

    Raises ValueError for other shapes or values that are not finite, InputError if there is no
    straight wall.
    """
    if points_map.ndim != 2 or points_map.shape[1] != 2 or not np.isfinite(points_map).all():
        raise ValueError(f"points {points_map.shape} must be finite and (N, 2)")
    if stamps_ns.shape != points_map.shape[:1]:
        raise ValueError(f"{stamps_ns.shape} stamps for {points_map.shape} points")
    walls = fit_walls(points_map)
    glimpses = stamps_ns // round(GLIMPSE_S * 1e9)
    thickness_m, wall_of, places_map, left_out = [], [], [], 0
    for index, wall in enumerate(walls):
        for place_map, columns_m in _stretches(wall, points_map, glimpses):
            measured_m = columns_m[np.isfinite(columns_m)]
            if measured_m.size < LEAST_COLUMNS:
                left_out += 1
                continue
            thickness_m.append(float(np.median(measured_m)))
            wall_of.append(index)
            places_map.append(place_map)
    if not thickness_m:
        raise InputError(
            f"no bare straight wall of a metre among {len(points_map)} points",
            where="map",
            remedy="Wall thickness means something only where there are straight walls.",
        )
    return WallThickness(
        walls=walls,
        thickness_m=np.array(thickness_m),
        wall_of=np.array(wall_of, dtype=np.int64),
        places_map=np.array(places_map),
        left_out=left_out,
    )


def points_of_run(scans: ScanStore, T_map_base: Trajectory) -> tuple[Array, Stamps]:
    """(points_map, stamps_ns) of all beams of the lidars, as ``wall_thickness`` takes them.

    T_map_base : the pose at every scan's stamp, as in a run folder.
    """
    hit = scans.roles == BEAM
    counts = np.diff(np.concatenate([[0], np.cumsum(hit)])[scans.offsets])
    poses = np.repeat(T_map_base.at(scans.stamps_ns), counts, axis=0)
    hits = np.column_stack([scans.points_base[hit], np.zeros(np.count_nonzero(hit))])
    points_map: Array = compose(poses, hits.astype(np.float64))[:, :2]
    return points_map, np.repeat(scans.stamps_ns, counts)


def _stretches(wall: WallLine, points_map: Array, glimpses: Glimpses) -> list[tuple[Array, Array]]:
    """(middle on the map, thickness of each column in m or NaN) of each stretch."""
    along, across = wall.along_across(points_map)
    near = (np.abs(across) < BAND_M) & (along >= 0.0) & (along < wall.length_m)
    along, across, glimpses = along[near], across[near], glimpses[near]
    count = max(1, round(wall.length_m / STRETCH_M))
    column = (along * (count * COLUMNS / wall.length_m)).astype(np.int64)
    order = np.lexsort((across, glimpses, column))
    across, glimpses = across[order], glimpses[order]
    bounds = np.searchsorted(column[order], np.arange(count * COLUMNS + 1))
    columns_m = np.array(
        [_column_m(across[a:b], glimpses[a:b]) for a, b in pairwise(bounds.tolist())]
    ).reshape(count, COLUMNS)
    step = (wall.end_map - wall.start_map) / count
    return [(wall.start_map + (k + 0.5) * step, row) for k, row in enumerate(columns_m)]


def _column_m(across: Array, glimpses: Glimpses) -> float:
    """The thickness of one column, or NaN if it is no bare wall or was hardly seen.

    across : (N,), m, sorted within each glimpse. glimpses : (N,), sorted. Glimpses of fewer than
    five points are passed over; fewer than three glimpses say nothing of how well they agree, and
    may be of somebody walking by.
    """
    starts = np.flatnonzero(np.diff(glimpses, prepend=glimpses[:1] - 1))
    counts = np.diff(np.append(starts, glimpses.size))
    seen = counts >= LEAST_POINTS
    if seen.sum() < LEAST_GLIMPSES:
        return float("nan")
    tail = (1.0 - COVERED) / 2.0
    cut = (tail * counts).astype(np.int64)
    low, high = starts + cut, starts + counts - 1 - cut
    if np.percentile((across[high] - across[low])[seen], 75.0) > THIN_M:
        return float("nan")
    weights = np.repeat(np.where(seen, 1.0 / counts, 0.0), counts)
    order = np.argsort(across, kind="stable")
    share = np.cumsum(weights[order]) / weights.sum()
    first, last = np.searchsorted(share, [tail, 1.0 - tail])
    return float(across[order[min(last, across.size - 1)]] - across[order[first]])
