"""Scans matched in submaps, as a constraint builder does it: what table 5 is made of.

This project closes a loop about once in a circle, so its own closures are too few for a table. What
Cartographer scores are matches of scans with all finished submaps in reach, most of them next to
the scan's own. So here: a scan every metre of the way is matched in every submap whose middle
lies within reach by the system's own final poses and which the scan is no part of. Submaps are
stretches of nodes by local SLAM's poses, a new one from the middle of the last, as Cartographer's
are. All of that, the search, the grids and the tests are the same for every system.

Accepted is what reaches the score, observes every direction and fits nowhere else nearly as well. A
scan slides along a bare wall without losing score: where it comes to rest says nothing of where it
was, and its own covariance says so. And where doors are alike the search may take one for the next.
The systems' own loop search refuses such matches too; they are counted apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from backend.loop_search import LoopConfig
from datasets.messages import Array
from datasets.se2 import between, compose, inverse, transform, xyyaw
from datasets.trajectory import Stamps, Trajectory
from frontend.local_map import LocalMap
from frontend.match import UNOBSERVED_SIGMA_M, Match, Rejected
from frontend.matching import match_correlative, match_surface
from frontend.nodes import Node
from fusion.scan import CAMERA_LAYER, LIDAR_LAYER
from slam.evaluation.match_scores import (
    LEAST_PROBABILITY,
    ScoreGrid,
    ScoreGridConfig,
    match_score,
    submap_grid,
)
from slam.lab.drives.constraint_truth import constraint_errors
from slam.lab.drives.mapping import Mapped
from slam.lab.drives.rows import ConstraintRow

SUBMAP_NODES = 40
GRIDS = ScoreGridConfig(scans_per_submap=SUBMAP_NODES)
MIN_SCORE = 0.55
"""Cartographer's, as are the odds and the cells of ``GRIDS``: its submaps hold 90 scans."""
QUERY_EVERY_M = 1.0
REACH_M = 15.0
"""Cartographer's ``max_constraint_distance``."""
WINDOW_M, WINDOW_RAD = 2.0, 0.35
AMBIGUOUS_RATIO = LoopConfig().ambiguous_ratio

PROTOCOL = (
    f"{GRIDS}, accepted from {MIN_SCORE:g} on, where every direction is observed to "
    f"{UNOBSERVED_SIGMA_M:g} m and no other place has {AMBIGUOUS_RATIO:g} of the search's score; a "
    f"scan every {QUERY_EVERY_M:g} m in all submaps "
    f"within {REACH_M:g} m, searched {WINDOW_M:g} m and {np.degrees(WINDOW_RAD):.0f} deg around "
    "the system's final pose"
)


@dataclass(frozen=True, slots=True)
class LidarScans:
    """The scans of the lidar alone: moments_ns (N,), points_base : (n, 2) each, de-skewed."""

    moments_ns: Stamps
    points_base: tuple[Array, ...]
    truth: Trajectory

    @classmethod
    def of(cls, lidar: Mapped, truth: Trajectory) -> LidarScans:
        """From a system that uses nothing else."""
        records = lidar.slam.records
        return cls(
            np.array([record.moment_ns for record in records], dtype=np.int64),
            tuple(record.points_base.astype(np.float64) for record in records),
            truth,
        )

    def at(self, moment_ns: int) -> Array:
        """The points of the scan nearest in time, as seen from the base at a moment.

        Between the two moments the base is moved as it truly did: a camera's images are no more
        than half a turn of the lidar away from one.
        """
        k = int(np.argmin(np.abs(self.moments_ns - moment_ns)))
        ends = self.truth.at(np.array([moment_ns, self.moments_ns[k]], dtype=np.int64))
        step = between(ends[:1], ends[1:])
        points = self.points_base[k]
        placed: Array = compose(
            np.repeat(step, len(points), axis=0), np.column_stack([points, np.zeros(len(points))])
        )[:, :2]
        return placed


@dataclass(frozen=True, slots=True)
class _Grids:
    """Of one submap: by layer of the system, and of the lidar's beams alone."""

    layers: dict[int, ScoreGrid]
    lidar: ScoreGrid | None


@dataclass(frozen=True, slots=True)
class _Found:
    """A scan in a submap: how it was matched, if it was, and the scores of that pose.

    ambiguous : another place fits nearly as well.
    """

    anchor: Node
    query: Node
    submap: int
    match: Match | None
    ambiguous: bool
    score: float | None
    lidar_score: float | None


def constraint_rows(
    seed: int, mapped: Mapped, lidar: LidarScans | None, truth: Trajectory
) -> list[ConstraintRow]:
    """Every scan that was tried in a submap, submap after submap.

    lidar : None leaves out the scores of the lidar's beams.
    """
    found = list(_matches(mapped, lidar))
    stamps_ns = np.array(
        [(each.anchor.scan.moment_ns, each.query.scan.moment_ns) for each in found], dtype=np.int64
    ).reshape(-1, 2)
    poses = [np.eye(3) if f.match is None else f.match.T_frame_base for f in found]
    measured = np.array([xyyaw(T) for T in poses]).reshape(-1, 3)
    errors = constraint_errors(stamps_ns[:, 0], stamps_ns[:, 1], measured, truth)
    rows = []
    for k, each in enumerate(found):
        match = each.match
        known = match is not None and bool(np.isfinite(errors.translation_m[k]))
        scored = each.score is not None and each.score >= MIN_SCORE
        observed = match is not None and match.weak_sigma_m <= UNOBSERVED_SIGMA_M
        rows.append(
            ConstraintRow(
                seed,
                mapped.system.name,
                (each.query.scan.moment_ns - int(truth.stamps_ns[0])) * 1e-9,
                each.submap,
                abs(each.query.way_m - each.anchor.way_m),
                each.score,
                each.lidar_score,
                scored,
                scored and observed and not each.ambiguous,
                float(errors.translation_m[k]) if known else None,
                float(errors.rotation_deg[k]) if known else None,
                scored and known and bool(errors.false[k]),
            )
        )
    return rows


def _matches(mapped: Mapped, lidar: LidarScans | None) -> Iterator[_Found]:
    nodes, T_map = mapped.slam.nodes, mapped.poses.T_map_nodes
    queries = _queries(nodes)
    for number, first in enumerate(range(0, len(nodes) - SUBMAP_NODES + 1, SUBMAP_NODES // 2)):
        members = nodes[first : first + SUBMAP_NODES]
        anchor = members[SUBMAP_NODES // 2]
        place = T_map[anchor.index, :2, 2]
        asked = [
            node
            for node in queries
            if not first <= node.index < first + SUBMAP_NODES
            and np.hypot(*(T_map[node.index, :2, 2] - place)) <= REACH_M
        ]
        if not asked:
            continue
        in_anchor = [inverse(anchor.T_odom_base) @ node.T_odom_base for node in members]
        scans = [node.scan for node in members]
        local_map = LocalMap.around(list(zip(scans, in_anchor, strict=True)))
        grids = _grids(members, in_anchor, lidar)
        for query in asked:
            guess = inverse(T_map[anchor.index]) @ T_map[query.index]
            match, ambiguous = _match(query, local_map, guess)
            if match is None:
                yield _Found(anchor, query, number, None, ambiguous, None, None)
                continue
            T, lidar_score = match.T_frame_base, None
            if lidar is not None and grids.lidar is not None:
                beams = transform(T, lidar.at(query.scan.moment_ns))
                lidar_score = match_score(grids.lidar, beams)
            score = _score(query, grids, T)
            yield _Found(anchor, query, number, match, ambiguous, score, lidar_score)


def _queries(nodes: list[Node]) -> list[Node]:
    """A node every ``QUERY_EVERY_M``."""
    chosen: list[Node] = []
    for node in nodes:
        if not chosen or node.way_m - chosen[-1].way_m >= QUERY_EVERY_M:
            chosen.append(node)
    return chosen


def _grids(members: list[Node], in_anchor: list[Array], lidar: LidarScans | None) -> _Grids:
    origins = [
        transform(T, node.scan.origin_base[None])[0]
        for node, T in zip(members, in_anchor, strict=True)
    ]
    layers = {}
    for layer in (LIDAR_LAYER, CAMERA_LAYER):
        points = [
            transform(T, node.scan.points_base[node.scan.part(layer)])
            for node, T in zip(members, in_anchor, strict=True)
        ]
        if any(len(each) for each in points):
            layers[layer] = submap_grid(origins, points, GRIDS)
    if lidar is None:
        return _Grids(layers, None)
    beams = [
        transform(T, lidar.at(node.scan.moment_ns))
        for node, T in zip(members, in_anchor, strict=True)
    ]
    return _Grids(layers, submap_grid([T[:2, 2] for T in in_anchor], beams, GRIDS))


def _match(query: Node, local_map: LocalMap, T_guess: Array) -> tuple[Match | None, bool]:
    """Correlative search over the window, then the surface; None if there is no pose.

    Also returns whether another place in the window fits nearly as well.
    """
    where = (query.scan, local_map, T_guess, WINDOW_M, WINDOW_RAD, (0.0, 0.0))
    found = match_correlative(*where)
    if isinstance(found, Rejected):
        return None, False
    T_start, score = found
    match = match_surface(query.scan, local_map, T_start, T_start, (1.0, 1.0))
    if isinstance(match, Rejected):
        return None, False
    second = match_correlative(*where, AMBIGUOUS_RATIO * score, avoid=T_start)
    return match, not isinstance(second, Rejected)


def _score(query: Node, grids: _Grids, T: Array) -> float:
    """The mean over all points, each in the grid of its layer."""
    total, count = 0.0, 0
    for layer in (LIDAR_LAYER, CAMERA_LAYER):
        points = query.scan.points_base[query.scan.part(layer)]
        if not len(points):
            continue
        grid = grids.layers.get(layer)
        mean = LEAST_PROBABILITY if grid is None else match_score(grid, transform(T, points))
        total, count = total + mean * len(points), count + len(points)
    return total / count
