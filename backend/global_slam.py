"""Global SLAM while running: submaps in the graph, loops looked for, the map frame kept."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from backend.constraint import Constraint, inverted
from backend.graph import PoseGraph
from backend.loop_attempt import ACCEPTED, ALONE, TOO_FAR, WIDE_M, LoopAttempt
from backend.loop_search import LoopConfig, LoopSearch
from backend.submap_way import LOST_M, SubmapWay
from datasets.messages import Array
from datasets.se2 import inverse
from frontend.nodes import Node, Submap, carried

LOST_SIGMA = 1.0
"""How far and (in rad) how much the base may have moved while local SLAM had lost the thread."""

MOVED_M = 2.0
MOVED_M_S = 1.5
"""How far a base may be moved while tracking is lost, and how fast it is driven or carried."""
LOOSE_M = 9.0
"""Windows from here on, and those of any yaw, follow a loss of tracking, or hundreds of metres
without a closure."""
FOR_WIDE = (1, 0.1)
FOR_LOOSE = (3, 0.06)
"""How many other places must bear out what a large window shows, and the mean share of points that
the other scans may have seen through in all of them: it is about 0.03 where a closure is right, and
0.1 where blocks of a building look alike."""

DOUBTFUL_SIGMA_M = 0.15
"""A step between submaps this uncertain counts for the way that leaves three sigma of drift."""


class GlobalSlam:
    """The graph of submaps: a chain from local SLAM, and loop closures between its members."""

    def __init__(self, config: LoopConfig, nodes: list[Node], submaps: list[Submap]) -> None:
        """nodes, submaps : the growing lists of local SLAM, shared, not copied."""
        self._drift_m_per_m = config.drift_m_per_m
        self._nodes = nodes
        self._submaps = submaps
        self._graph = PoseGraph()
        self._way = SubmapWay()
        self._anchors: Array | None = None
        self.search = LoopSearch(config, nodes, submaps)
        self.constraints: list[Constraint] = []
        self._aside: list[LoopAttempt] = []
        self._bearers: dict[int, list[LoopAttempt]] = {}
        self.closures: list[tuple[LoopAttempt, Constraint]] = []

    def add_submap(self, submap: Submap) -> None:
        """Put a finished submap into the graph and ask which earlier ones show the same place."""
        if submap.index == 0:
            self._graph.add_node(submap.anchor.T_odom_base)
            self._way.add(0.0)
        else:
            before = self._submaps[submap.index - 1]
            T_before_anchor, covariance, lost = self._chain(before.anchor, submap.anchor)
            self._graph.add_node(self._graph.pose(before.index) @ T_before_anchor)
            way_m = submap.anchor.way_m - before.anchor.way_m
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
            if (
                sigma_m > DOUBTFUL_SIGMA_M and not lost
            ):  # a stretch where the way along was not observed
                way_m = max(way_m, 3.0 * sigma_m / self._drift_m_per_m)
            self._way.add(way_m + LOST_M if lost else way_m)
            self._constrain(
                Constraint(
                    before.index, submap.index, T_before_anchor, inverted(covariance), "odometry"
                )
            )
        self._anchors = None
        self.search.enqueue(submap)

    def step(self) -> list[LoopAttempt]:
        """Do one piece of the loop search, and take the closures it finds into the graph.

        A closure from a small window is believed at once. One from a large window is kept aside
        until another place near it bears it out.
        """
        found = self.search.step(self.T_map_anchors(), self._way.since_m)
        closed: list[LoopAttempt] = []
        for attempt in found:
            if attempt.result != ACCEPTED:
                continue
            if attempt.of is not None:
                closed += self._borne_out(attempt.of, attempt)
            elif attempt.window_m <= WIDE_M:
                closed.append(attempt)
            elif self._is_reachable(attempt):
                self._aside.append(attempt)
                self.search.bear_out(attempt, len(self._graph))
            else:
                attempts = self.search.attempts
                attempts[attempts.index(attempt)] = replace(attempt, result=TOO_FAR)
        for attempt in closed:
            self._close(attempt)
        return closed

    def _is_reachable(self, attempt: LoopAttempt) -> bool:
        """Whether the base can have come to a place in the time, where tracking was lost once.

        Wherever it was lost, turned by hand or carried: it was not moved faster than MOVED_M_S.
        """
        between = self._submaps[attempt.submap.index + 1 : attempt.own.index + 1]
        lost = [submap for submap in between if submap.nodes[0].lost]
        if len(lost) != 1:
            return True
        after = lost[0].nodes[0]
        before = self._nodes[after.index - 1]
        of_before = self._submaps[lost[0].index - 1]
        anchors = self.T_map_anchors()
        T_map_before = anchors[of_before.index] @ of_before.T_anchor_base(before)
        T_map_query = anchors[attempt.submap.index] @ attempt.T_anchor_base
        T_query_after = inverse(attempt.query.T_odom_base) @ after.T_odom_base
        jump_m = float(np.linalg.norm((T_map_query @ T_query_after - T_map_before)[:2, 2]))
        gap_s = 1e-9 * (after.scan.stamp_ns - before.scan.stamp_ns)
        drift_m = self._drift_m_per_m * (
            abs(attempt.query.way_m - after.way_m) + abs(before.way_m - attempt.submap.anchor.way_m)
        )
        return jump_m < MOVED_M + MOVED_M_S * gap_s + drift_m

    def _borne_out(self, first: LoopAttempt, by: LoopAttempt) -> list[LoopAttempt]:
        """The closures that are believed now that a place bears one out that was kept aside."""
        if first not in self._aside:
            return [by]
        known = self._bearers.setdefault(id(first), [])
        if all(other.query is not by.query for other in known):
            known.append(by)
        is_loose = first.window_m >= LOOSE_M or first.window_rad >= math.pi
        needed, most = FOR_LOOSE if is_loose else FOR_WIDE
        group = [first, *known]
        share = sum(attempt.contradiction for attempt in group) / len(group)
        if len(known) < needed or share > most:
            return []
        self._aside.remove(first)
        del self._bearers[id(first)]
        return group

    def leave_aside(self) -> None:
        """Say of the closures that too little bore out that they are none, nor what did."""
        aside = {id(attempt) for attempt in self._aside}
        self.search.attempts[:] = [
            replace(attempt, result=ALONE)
            if attempt.result == ACCEPTED and not aside.isdisjoint({id(attempt), id(attempt.of)})
            else attempt
            for attempt in self.search.attempts
        ]
        self._aside = []

    def ask_again(self) -> None:
        """Ask about all places once more, under the present poses."""
        for attempt in self._aside:
            self.search.bear_out(attempt, len(self._graph))
        for submap in self._submaps:
            self.search.enqueue(submap)

    def T_map_anchors(self) -> Array:
        """(S, 3, 3) the present poses of the finished submaps."""
        if self._anchors is None:
            self._graph.update()
            self._anchors = self._graph.poses()
        return self._anchors

    def T_map_odom(self) -> Array:
        """Where the odom frame now is in the map, by the newest finished submap; (3, 3)."""
        anchors = self.T_map_anchors()
        if not len(anchors):
            return np.eye(3)
        T_map_odom: Array = anchors[-1] @ inverse(
            self._submaps[len(anchors) - 1].anchor.T_odom_base
        )
        return T_map_odom

    def move_anchors(self, T_map_anchors: Array) -> None:
        """Take better poses from a batch optimisation, as where the search goes on."""
        self._anchors = T_map_anchors

    def _constrain(self, constraint: Constraint) -> None:
        self.constraints.append(constraint)
        self._graph.add_constraint(constraint)

    def _chain(self, first: Node, last: Node) -> tuple[Array, Array, bool]:
        """The pose of one node in another by local SLAM, its covariance, and if it was lost."""
        covariance = np.zeros((3, 3))
        lost = False
        before = first
        for node in self._nodes[first.index + 1 : last.index + 1]:
            step = inverse(before.T_odom_base) @ node.T_odom_base
            covariance = carried(covariance, step) + node.step_covariance
            lost |= node.lost
            before = node
        covariance += np.diag([1e-6, 1e-6, 1e-8])
        if lost:
            covariance += np.eye(3) * LOST_SIGMA**2
        return inverse(first.T_odom_base) @ last.T_odom_base, covariance, lost

    def _close(self, attempt: LoopAttempt) -> None:
        own = attempt.own
        T_base_anchor = inverse(own.T_anchor_base(attempt.query))
        # what next to nothing observed keeps a standard deviation of 10 m, for the inverse
        covariance = inverted(attempt.information + 0.01 * np.eye(3))
        away_m = abs(own.anchor.way_m - attempt.query.way_m)
        local = np.diag([(0.01 + 0.005 * away_m) ** 2] * 2 + [(0.003 + 0.002 * away_m) ** 2])
        information = inverted(carried(covariance, T_base_anchor) + local)
        T_from_to = attempt.T_anchor_base @ T_base_anchor
        constraint = Constraint(attempt.submap.index, own.index, T_from_to, information, "loop")
        self._constrain(constraint)
        self._way.close(attempt.submap.index, own.index)
        self.closures.append((attempt, constraint))
        self._anchors = None
