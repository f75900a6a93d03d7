"""Constraint matching scores of a run, on grids that are built equally for every run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from datasets.messages import Array
from datasets.se2 import between, compose
from datasets.trajectory import Stamps, Trajectory
from slam.evaluation.match_scores import (
    ScoreGrid,
    ScoreGridConfig,
    ScoreSummary,
    match_score,
    submap_grid,
    summarise,
)
from slam.mapping.scan_store import CLEAR, ScanStore
from slam.runs.run_folder import Table
from slam.runs.structures import measured_layer


@dataclass(frozen=True, slots=True)
class RunScores:
    """steps : between a submap and the next one's first scan. loops : closures, accepted ones."""

    steps: ScoreSummary
    loops: ScoreSummary


def run_scores(
    constraints: Table,
    scans: ScanStore,
    T_map_base: Trajectory,
    config: ScoreGridConfig | None = None,
) -> RunScores:
    """Score the accepted constraints of a run folder: how well their scans lie on their submaps.

    A submap holds the scans of the highest lidar's layer (of a run without a lidar: the cameras')
    from its anchor up to the next one's, at their final poses. The scan that a constraint joins to
    it lies where the constraint measured it. A constraint without points at either end is left out
    of the accepted ones.
    """
    layer = _Layer(measured_layer(scans), T_map_base, config or ScoreGridConfig())
    rows = [dict(zip(constraints.columns, row, strict=True)) for row in constraints.rows]
    chain = [row for row in rows if row["kind"] == "odometry"]
    anchors = sorted({_ns(row[key]) for row in chain for key in ("from_stamp_s", "to_stamp_s")})
    ends = dict(pairwise(anchors))
    last_ns = int(T_map_base.stamps_ns[-1]) + 1
    found: dict[str, list[float]] = {"odometry": [], "loop": []}
    tried = {"odometry": 0, "loop": 0}
    for row in rows:
        kind = str(row["kind"])
        tried[kind] += 1
        if row["result"] != "accepted" or row["kept"] == "no":
            continue
        from_ns = _ns(row["from_stamp_s"])
        measured = [float(str(row[key])) for key in ("x_m", "y_m", "yaw_rad")]
        score = layer.score(
            from_ns, ends.get(from_ns, last_ns), _ns(row["to_stamp_s"]), np.array(measured)
        )
        if score is not None:
            found[kind].append(score)
    return RunScores(*(summarise(found[kind], tried[kind]) for kind in ("odometry", "loop")))


class _Layer:
    """The scans of one layer, and the grids of the submaps that were asked for."""

    def __init__(self, scans: ScanStore, T_map_base: Trajectory, config: ScoreGridConfig) -> None:
        self._scans, self._T_map_base, self._config = scans, T_map_base, config
        self._grids: dict[int, ScoreGrid | None] = {}

    def score(self, from_ns: int, end_ns: int, scan_ns: int, measured: Array) -> float | None:
        """Of the scan at a stamp in the submap from a stamp up to another; None without points."""
        stamps = self._scans.stamps_ns
        if from_ns not in self._grids:
            rows = np.flatnonzero((stamps >= from_ns) & (stamps < end_ns))
            self._grids[from_ns] = self._grid(from_ns, rows.tolist())
        grid = self._grids[from_ns]
        points = [self._points(row) for row in np.flatnonzero(stamps == scan_ns).tolist()]
        joined = np.concatenate([np.empty((0, 2)), *points])
        if grid is None or not len(joined):
            return None
        return match_score(grid, _placed(measured, joined))

    def _grid(self, anchor_ns: int, rows: Sequence[int]) -> ScoreGrid | None:
        scans = self._scans
        T_map_anchor = self._at(np.array([anchor_ns]))
        origins, points = [], []
        for row in rows:
            own = self._points(row)
            T_anchor_base = between(T_map_anchor, self._at(scans.stamps_ns[row : row + 1]))[0]
            origin = scans.origins_base[scans.sensor_index[row]]
            origins.append(_placed(T_anchor_base, origin[None])[0])
            points.append(_placed(T_anchor_base, own))
        if not any(len(each) for each in points):
            return None
        return submap_grid(origins, points, self._config)

    def _points(self, row: int) -> Array:
        part = slice(int(self._scans.offsets[row]), int(self._scans.offsets[row + 1]))
        hit = self._scans.roles[part] != CLEAR
        return self._scans.points_base[part][hit].astype(np.float64)

    def _at(self, stamps_ns: Stamps) -> Array:
        return self._T_map_base.at(stamps_ns)


def _placed(xyyaw: Array, points: Array) -> Array:
    flat = np.column_stack([points, np.zeros(len(points))])
    return compose(np.broadcast_to(xyyaw, (len(points), 3)), flat)[:, :2]


def _ns(stamp_s: object) -> int:
    """A stamp as ``datasets.tum.format_stamp`` writes it: exactly, not by way of a float."""
    whole, _, part = str(stamp_s).partition(".")
    return int(whole) * 1_000_000_000 + int(part.ljust(9, "0")[:9] or 0)
