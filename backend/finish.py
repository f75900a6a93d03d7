"""After the last scan: search once more, throw out what does not agree, match again, settle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backend.constraint import Constraint
from backend.global_slam import GlobalSlam
from backend.graph_arrays import ConstraintArrays
from backend.loop_search import ACCEPTED
from backend.refine import RefineConfig, Refined, refine
from backend.robust import robust_optimise
from backend.spread import spread
from datasets.messages import Array
from frontend.nodes import Node, Submap


@dataclass(frozen=True, slots=True)
class Finished:
    """The result of global SLAM.

    T_map_nodes   : (N, 3, 3).
    kept          : closure by closure, whether it stayed in the graph.
    refined       : the final passes.
    """

    T_map_nodes: Array
    kept: tuple[bool, ...]
    refined: Refined


def finish(
    slam: GlobalSlam, nodes: list[Node], submaps: list[Submap], config: RefineConfig
) -> Finished:
    """Bring a graph to its end: see the module."""
    while slam.search.waiting:
        slam.step()
    T_map_anchors, kept = settle(slam)
    slam.move_anchors(T_map_anchors)
    # under better poses more places are within reach, and the windows are small
    for submap in submaps:
        slam.search.enqueue(submap)
    before = len(slam.closures)
    while slam.search.waiting:
        anchors = slam.T_map_anchors()
        attempt = slam.step()
        if attempt is not None and attempt.result == ACCEPTED:
            slam.move_anchors(anchors)
    slam.search.rest()
    if len(slam.closures) > before:
        T_map_anchors, kept = settle(slam, T_map_anchors)
        slam.move_anchors(T_map_anchors)
    T_map_nodes = nodes_at(nodes, submaps, T_map_anchors)
    refined = refine(nodes, T_map_nodes, _kept_closures(slam, kept), config)
    return Finished(refined.T_map_nodes, kept, refined)


def nodes_at(nodes: list[Node], submaps: list[Submap], T_map_anchors: Array) -> Array:
    """(N, 3, 3) the poses of all nodes, by those of the first submaps, (S, 3, 3), S >= 1."""
    fixed = np.array([submap.anchor.index for submap in submaps[: len(T_map_anchors)]])
    way = np.array([node.way_m for node in nodes]) + 1e-3 * np.arange(len(nodes))
    return spread(fixed, T_map_anchors, np.array([node.T_odom_base for node in nodes]), way)


def settle(slam: GlobalSlam, start: Array | None = None) -> tuple[Array, tuple[bool, ...]]:
    """Optimise the submaps with closures as suspects. Returns their poses and who stayed."""
    arrays = ConstraintArrays.of(slam.constraints)
    suspects = np.array([c.kind == "loop" for c in slam.constraints], dtype=bool)
    poses = slam.T_map_anchors() if start is None else start
    if len(poses) < 2:
        return poses, ()
    found = robust_optimise(poses, arrays.pick(~suspects), arrays.pick(suspects))
    return found.T_map_nodes, tuple(verdict.kept for verdict in found.verdicts)


def _kept_closures(slam: GlobalSlam, kept: tuple[bool, ...]) -> ConstraintArrays:
    """The closures that stayed, from anchor to query, as constraints between nodes."""
    stayed = [attempt for (attempt, _), stays in zip(slam.closures, kept, strict=True) if stays]
    return ConstraintArrays.of(
        [
            Constraint(
                attempt.submap.anchor.index,
                attempt.query.index,
                attempt.T_anchor_base,
                attempt.information,
                "loop",
            )
            for attempt in stayed
        ]
    )
