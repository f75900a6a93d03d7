"""Loop search: is this place one that an earlier submap shows? And every answer, kept as a row."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import Field

from backend.submap_maps import SubmapMaps
from backend.submap_way import LOST_M
from datasets.messages import Array
from datasets.se2 import inverse, se2, transform, xyyaw
from datasets.section import Section
from frontend.local_map import LocalMap
from frontend.match import Match, Rejected
from frontend.matching import APART_M, APART_RAD, match_surface, thinned, yaw_step_rad
from frontend.nodes import Node, Submap
from frontend.prepared import PreparedScan
from fusion.scan import LIDAR_LAYER

ACCEPTED: Final = "accepted"
SEARCH_BUDGET_BOXES: Final = 200_000
LOST_REACH_M: Final = 15.0
"""Way after the thread was lost in which places are asked about within LOST_WINDOW_M, any yaw."""
LOST_WINDOW_M: Final = 2.5
QUERY_EVERY_M: Final = 1.0
"""Way between two places asked about."""
QUERY_NEIGHBOURS: Final = 4
"""Nodes before and after a place that take part in its query."""
MIN_WAY_M: Final = 4.0
"""Submaps nearer than this along the graph are joined enough."""
LAYER_CELLS: Final = 1 << 50
"""More than there are numbers of cells in a layer."""


class LoopConfig(Section):
    """Where loops are looked for, and what is believed."""

    candidates: int = Field(3, ge=1, description="submaps tried for each place, nearest first")
    reach_m: float = Field(1.5, gt=0.0, description="submaps nearer than this and the window")
    min_window_m: float = Field(0.6, gt=0.0, description="search window with no drift")
    max_window_m: float = Field(8.0, gt=0.0, description="search window at the most")
    drift_m_per_m: float = Field(0.03, gt=0.0, description="the window grows with the way since")
    drift_rad_per_m: float = Field(0.004, gt=0.0, description="the window grows with the way since")
    min_score: float = Field(0.5, gt=0.0, lt=1.0, description="below: refused")
    min_inlier_ratio: float = Field(0.55, gt=0.0, lt=1.0, description="below: refused")
    ambiguous_ratio: float = Field(0.92, gt=0.0, lt=1.0, description="a second peak this near")


@dataclass(frozen=True, slots=True)
class LoopAttempt:
    """One search of one place in one submap: accepted, or why not.

    query, own, submap : the node asked about, the submap it is of, and the submap searched.
    window_m, window_rad : how far from the guess was searched.
    result        : ACCEPTED or the reason against it.
    score, second_score, inlier_ratio : of the best pose; of the best pose elsewhere (0: none).
    T_anchor_base : (3, 3), the query's base in the submap's frame.
    information   : (3, 3) of that pose in the query's base axes.
    """

    query: Node
    own: Submap
    submap: Submap
    window_m: float
    window_rad: float
    result: str
    score: float
    second_score: float
    inlier_ratio: float
    T_anchor_base: Array
    information: Array

    @property
    def stamp_ns(self) -> int:
        """Of the query."""
        return self.query.scan.stamp_ns


class LoopSearch:
    """Asks for each finished submap, place after place, which earlier submaps show it.

    Work is queued when a submap is finished, and done one piece at a time (``step``), so that no
    scan has to wait for much.
    """

    def __init__(self, config: LoopConfig, nodes: list[Node], submaps: list[Submap]) -> None:
        """nodes, submaps : the growing lists of local SLAM, shared, not copied."""
        self._config = config
        self._nodes = nodes
        self._submaps = submaps
        self._maps = SubmapMaps(nodes, submaps)
        self._queries: deque[tuple[Node, Submap]] = deque()
        self._tasks: deque[tuple[Node, Submap, Submap, float]] = deque()
        self._scan: tuple[int, PreparedScan] | None = None
        self.attempts: list[LoopAttempt] = []
        self._asked: set[tuple[int, int]] = set()

    def enqueue(self, submap: Submap) -> None:
        """Ask about the places of a finished submap."""
        asked_m = -math.inf
        for node in submap.nodes:
            if node.way_m - asked_m >= QUERY_EVERY_M or (
                node is submap.anchor and submap.nodes[-1].way_m - submap.nodes[0].way_m < 1.0
            ):
                self._queries.append((node, submap))
                asked_m = node.way_m

    def rest(self) -> None:
        """No more searches come for now: give back the memory of the maps."""
        self._maps.clear()

    @property
    def waiting(self) -> bool:
        """Whether there is work left."""
        return bool(self._queries or self._tasks)

    def step(
        self, T_map_anchors: Array, way_since_m: Callable[[int, int], Array]
    ) -> LoopAttempt | None:
        """Do one piece of work: choose submaps for a place, draw one, or search one.

        T_map_anchors : (S, 3, 3), present poses of the submaps.
        way_since_m   : for a submap and a number n of submaps, (n,) the way between it and the
                        first n along the graph, m.

        Returns the attempt if it was a search.
        """
        if not self._tasks:
            if self._queries:
                self._plan(*self._queries.popleft(), T_map_anchors, way_since_m)
            return None
        if not self._maps.drawn(self._tasks[0][2]):
            self._maps.get(self._tasks[0][2])
            return None
        query, own, candidate, drift_way_m = self._tasks.popleft()
        T_map_query = T_map_anchors[own.index] @ own.T_anchor_base(query)
        T_guess = inverse(T_map_anchors[candidate.index]) @ T_map_query
        attempt = self._search(query, own, candidate, T_guess, drift_way_m)
        self.attempts.append(attempt)
        return attempt

    def _plan(
        self,
        query: Node,
        own: Submap,
        T_map_anchors: Array,
        way_since_m: Callable[[int, int], Array],
    ) -> None:
        """Choose the submaps to search for a place."""
        earlier = own.index - 1
        if earlier < 1:
            return
        config = self._config
        ways_m = way_since_m(own.index, earlier)
        position = (T_map_anchors[own.index] @ own.T_anchor_base(query))[:2, 2]
        near: list[tuple[float, int, float]] = []
        windows_m = np.minimum(config.drift_m_per_m * ways_m, config.max_window_m)
        # where the thread was lost only the next metres are known to be near what was before
        windows_m[ways_m >= LOST_M] = LOST_WINDOW_M
        windows_m[ways_m >= LOST_M + LOST_REACH_M] = -np.inf
        bounds_m = self._maps.nearest_bound_m(T_map_anchors[:earlier], position)
        near_enough = bounds_m < config.reach_m + windows_m
        for index in np.flatnonzero(near_enough & (ways_m >= MIN_WAY_M)).tolist():
            candidate = self._submaps[index]
            T_anchor_map = inverse(T_map_anchors[index])
            there = transform(T_anchor_map, position[None])[0]
            away_m = float(self._maps.distances_m(candidate, there).min())
            asked = (query.index, index) in self._asked
            if away_m < config.reach_m + windows_m[index] and not asked:
                near.append((away_m, index, float(ways_m[index])))
        for _, index, way_m in sorted(near)[: config.candidates]:
            self._asked.add((query.index, index))
            self._tasks.append((query, own, self._submaps[index], way_m))

    def _search(
        self, query: Node, own: Submap, candidate: Submap, T_guess: Array, way_m: float
    ) -> LoopAttempt:
        config = self._config
        window_m, window_rad = self._window(way_m)
        local_map = self._maps.get(candidate)
        scan = self._query_scan(query, own)

        def attempt(
            result: str, score: float = 0.0, second: float = 0.0, match: Match | None = None
        ) -> LoopAttempt:
            return LoopAttempt(
                query,
                own,
                candidate,
                window_m,
                window_rad,
                result,
                score,
                second,
                match.inlier_ratio if match else 0.0,
                match.T_frame_base if match else T_guess,
                match.information if match else np.zeros((3, 3)),
            )

        if scan.surface_count < 30:
            return attempt("too few points on surfaces")
        points = thinned(scan.points_base[scan.part(LIDAR_LAYER)], 200)
        step_rad = yaw_step_rad(points)
        found, x, y, yaw, score, _ = local_map.search(
            points,
            xyyaw(T_guess),
            window_m,
            window_rad,
            step_rad,
            (0.0, 0.0),
            config.min_score,
            _budget(window_m, window_rad),
        )
        if not found:
            return attempt(f"score below {config.min_score:g}")
        second = self._second_peak(
            local_map,
            points,
            T_guess,
            (window_m, window_rad, step_rad),
            (x, y, yaw, score),
            _budget(window_m, window_rad),
        )
        T_found = se2(x, y, yaw)
        # the prior holds next to nothing
        match = match_surface(scan, local_map, T_found, T_found, (1.0, 1.0))
        if isinstance(match, Rejected):
            return attempt(match.reason, score, second)
        if second >= config.ambiguous_ratio * score:
            return attempt("ambiguous: another place fits nearly as well", score, second, match)
        if match.inlier_ratio < config.min_inlier_ratio:
            reason = f"inlier ratio below {config.min_inlier_ratio:g}"
            return attempt(reason, score, second, match)
        return attempt(ACCEPTED, score, second, match)

    def _window(self, way_m: float) -> tuple[float, float]:
        """How far from the guess to search, m and rad: it grows with the way since."""
        config = self._config
        if way_m >= LOST_M:
            return LOST_WINDOW_M, math.pi
        window_m = max(config.min_window_m, 0.3 + config.drift_m_per_m * way_m)
        return min(window_m, config.max_window_m), min(0.15 + config.drift_rad_per_m * way_m, 1.0)

    def _second_peak(
        self,
        local_map: LocalMap,
        points: Array,
        T_guess: Array,
        window: tuple[float, float, float],
        best: tuple[float, float, float, float],
        budget: int,
    ) -> float:
        """Score of the best pose but the best one; 0 where the window has no room for it."""
        window_m, window_rad, step_rad = window
        if window_m < 1.0:
            return 0.0
        x, y, yaw, score = best
        floor = self._config.ambiguous_ratio * score
        found, _, _, _, second, boxes = local_map.search(
            points,
            xyyaw(T_guess),
            window_m,
            window_rad,
            step_rad,
            (0.0, 0.0),
            floor,
            budget,
            (x, y, yaw, APART_M, APART_RAD),
        )
        if boxes > budget:
            return score  # not searched to the end: nobody knows
        return second if found else 0.0

    def _query_scan(self, query: Node, own: Submap) -> PreparedScan:
        """The query's scan with those around it, about one point of each layer in each 10 cm."""
        if self._scan is not None and self._scan[0] == query.index:
            return self._scan[1]
        reach = QUERY_NEIGHBOURS
        near, points, normals = [], [], []
        T_base_anchor = inverse(own.T_anchor_base(query))
        for node in own.nodes:
            if abs(node.index - query.index) <= reach:
                T = T_base_anchor @ own.T_anchor_base(node)
                near.append(node.scan)
                points.append(transform(T, node.scan.points_base))
                normals.append(node.scan.normals_base @ T[:2, :2].T)
        all_points, all_normals = np.concatenate(points), np.concatenate(normals)
        layer = np.concatenate([scan.layer for scan in near])
        cells = np.floor(all_points / 0.1).astype(np.int64)
        # the cells of layer 0 come first, and so do its points
        keys = layer.astype(np.int64) * LAYER_CELLS + cells[:, 0] * 1_000_003 + cells[:, 1]
        _, kept = np.unique(keys, return_index=True)
        scan = PreparedScan(
            query.scan.stamp_ns,
            query.scan.moment_ns,
            query.scan.sensor,
            query.scan.origin_base,
            np.ascontiguousarray(all_points[kept]),
            np.ascontiguousarray(all_normals[kept]),
            np.zeros(len(kept)),
            layer[kept],
            np.concatenate([scan.weights for scan in near])[kept],
        )
        self._scan = (query.index, scan)
        return scan


def _budget(window_m: float, window_rad: float) -> int:
    """How many boxes a search may score: enough for its window, so that it seldom runs out."""
    return int(SEARCH_BUDGET_BOXES * max(1.0, (window_m / 2.0) ** 2 * (window_rad / 0.5)))
