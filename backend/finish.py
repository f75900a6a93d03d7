"""After the last scan: search once more, throw out what does not agree, match again, settle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from backend.constraint import Constraint
from backend.doubts import Contradictions, contradictions
from backend.global_slam import GlobalSlam
from backend.graph_arrays import ConstraintArrays, joined
from backend.loose_steps import LooseStep, loose_steps
from backend.parts import Labels, parts_of
from backend.refine import RefineConfig, Refined, refine
from backend.robust import robust_optimise
from backend.spread import spread
from datasets.messages import Array
from frontend.nodes import Node, Submap

SEARCH_ROUNDS = 4
PARTS_SOUGHT = 4
"""Only so many parts, the largest, are looked for everywhere: it costs seconds each."""
JOIN_ROUNDS = 2
"""Rounds of search and optimisation after the last scan, at the most; and of looking everywhere for
parts that nothing joins."""


WORSE_TIMES = 1.1
WORSE_SHARE = 0.005
"""The final passes are undone if they raise the share of contradicted points by more than this."""


@dataclass(frozen=True, slots=True)
class Finished:
    """The result of global SLAM.

    T_map_nodes   : (N, 3, 3).
    kept          : closure by closure, whether it stayed in the graph.
    parts         : (S,) the part of each submap; 0 is the longest. Parts hang together by nothing
                    but a guess.
    refined       : the final passes.
    undone        : the final passes made the scans contradict each other more, and were undone.
    contradictions : of the scans at their final poses.
    loose         : steps whose length is a guess.
    """

    T_map_nodes: Array
    kept: tuple[bool, ...]
    parts: Labels
    refined: Refined
    undone: bool
    contradictions: Contradictions
    loose: tuple[LooseStep, ...]


def finish(
    slam: GlobalSlam, nodes: list[Node], submaps: list[Submap], config: RefineConfig
) -> Finished:
    """Bring a graph to its end: see the module."""
    while slam.search.waiting:
        slam.step()
    T_map_anchors, kept = settle(slam)
    slam.move_anchors(T_map_anchors)
    for _ in range(SEARCH_ROUNDS):
        # under better poses more places are within reach, and the windows are small
        slam.ask_again()
        if not _found_more(slam):
            break
        T_map_anchors, kept = settle(slam, T_map_anchors)
        slam.move_anchors(T_map_anchors)
    for _ in range(JOIN_ROUNDS):
        parts = _parts(slam, submaps, kept)
        if not parts.any():
            break
        for part in range(1, min(int(parts.max()), PARTS_SOUGHT) + 1):
            own = [submap for submap in submaps if parts[submap.index] == part]
            others = [submap for submap in submaps if parts[submap.index] != part]
            slam.search.enqueue_anywhere(own, others)
        if not _found_more(slam):
            break
        T_map_anchors, kept = settle(slam, T_map_anchors)
        slam.move_anchors(T_map_anchors)
        slam.ask_again()
        if _found_more(slam):
            T_map_anchors, kept = settle(slam, T_map_anchors)
            slam.move_anchors(T_map_anchors)
    slam.search.rest()
    slam.leave_aside()
    T_map_nodes = nodes_at(nodes, submaps, T_map_anchors)
    refined = refine(nodes, T_map_nodes, _kept_closures(slam, kept), config)
    before, after = (
        contradictions(nodes, T_map_nodes),
        contradictions(refined.nodes, refined.T_map_nodes),
    )
    undone = after.share > WORSE_TIMES * before.share + WORSE_SHARE and not refined.offsets
    if undone:
        refined, after = replace(refined, T_map_nodes=T_map_nodes), before
    parts = _parts(slam, submaps, kept)
    graph = joined(refined.held, refined.pairs)
    loose = loose_steps(refined.nodes, refined.T_map_nodes, graph)
    return Finished(refined.T_map_nodes, kept, parts, refined, undone, after, loose)


def _found_more(slam: GlobalSlam) -> bool:
    """Do all searches that wait, from the present poses. Whether there are new closures."""
    before = len(slam.closures)
    while slam.search.waiting:
        anchors = slam.T_map_anchors()
        if slam.step():
            slam.move_anchors(anchors)
    return len(slam.closures) > before


def _parts(slam: GlobalSlam, submaps: list[Submap], kept: tuple[bool, ...]) -> Labels:
    """The part of each submap, by the closures that stayed."""
    stayed = [
        (attempt.submap.index, attempt.own.index)
        for (attempt, _), stays in zip(slam.closures, kept, strict=True)
        if stays
    ]
    return parts_of(submaps, stayed)


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
