"""By how much the clock of a second sensor is off: the map of its own views is sharpest without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from datasets.se2 import placed
from datasets.trajectory import Stamps, Trajectory
from slam.mapping.camera_records import ViewRecord
from slam.mapping.scan_store import BEAM, SURFACE

WINDOW_S = 0.25
STEP_S = 0.025
CELL_M = 0.05
REACH_M = 10.0
MOST_POINTS = 150_000
LEAST_VIEWS = 20
SHARPER = 0.95
"""A clock is off if with the offset the views' points fill so much fewer cells, at the most: noise
alone moves the number of cells by a percent."""


@dataclass(frozen=True, slots=True)
class ViewClock:
    """offset_s : to be added to the sensor's stamps. cells, cells_as_stamped : filled with and
    without it."""

    offset_s: float
    cells: int
    cells_as_stamped: int


def view_clock(views: Sequence[ViewRecord], T_map_base: Trajectory) -> ViewClock | None:
    """The clock offset of one sensor against the trajectory's; None if none can be told.

    Only where the base turned or drove fast enough does an offset blur the map. The smallest
    number of cells that the points fill, over offsets of +- WINDOW_S, is searched on a grid, and
    the offset then interpolated by a parabola.
    """
    placed = [
        view
        for view in views
        if T_map_base.stamps_ns[0] <= view.stamp_ns <= T_map_base.stamps_ns[-1]
    ]
    if len(placed) < LEAST_VIEWS:
        return None
    points, owners = _points(placed)
    if not len(points):
        return None
    stamps = np.array([view.stamp_ns for view in placed], dtype=np.int64)
    offsets = np.arange(-round(WINDOW_S / STEP_S), round(WINDOW_S / STEP_S) + 1) * STEP_S
    filled = np.array([_cells(points, owners, stamps, T_map_base, each) for each in offsets])
    best, zero = int(filled.argmin()), len(offsets) // 2
    if best in (0, len(offsets) - 1) or filled[best] > SHARPER * filled[zero]:
        return None
    before, least, after = filled[best - 1 : best + 2].astype(np.float64)
    bend = before - 2.0 * least + after
    shift = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return ViewClock(float(offsets[best] + shift * STEP_S), int(filled[best]), int(filled[zero]))


def _points(views: Sequence[ViewRecord]) -> tuple[Array, Stamps]:
    """(M, 2) what the views met for sure, in their base frames, and (M,) the view of each."""
    met = []
    for view in views:
        points = view.points_base[np.isin(view.roles, (BEAM, SURFACE))].astype(np.float64)
        met.append(points[np.hypot(*(points - view.origin_base).T) < REACH_M])
    counts = np.array([len(points) for points in met])
    owners = np.repeat(np.arange(len(views)), counts)
    every = max(1, -(-int(counts.sum()) // MOST_POINTS))
    return np.concatenate(met)[::every], owners[::every]


def _cells(
    points: Array,
    owners: Stamps,
    stamps_ns: Stamps,
    T_map_base: Trajectory,
    offset_s: float,
) -> int:
    """How many cells the points fill if the views were taken so much later."""
    first, last = T_map_base.stamps_ns[[0, -1]]
    poses = T_map_base.at(np.clip(stamps_ns + round(offset_s * 1e9), first, last))[owners]
    cells = np.floor(placed(poses, points) / CELL_M).astype(np.int64)
    return int(np.unique(cells[:, 0] * (1 << 32) + cells[:, 1]).size)
