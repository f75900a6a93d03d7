"""Loop search: is this place one that an earlier submap shows? And every answer, kept as a row."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from pydantic import Field

from backend.loop_attempt import ACCEPTED, AMBIGUOUS, NEAR_M, WIDE_M, LoopAttempt, PlaceTask
from backend.place_match import QUERY_NEIGHBOURS, PlaceMatcher
from backend.submap_maps import SubmapMaps
from datasets.messages import Array
from datasets.se2 import inverse, se2, xyyaw
from datasets.section import Section
from frontend.local_map import FACING_BINS, facing_of
from frontend.matching import APART_M, APART_RAD
from frontend.nodes import Node, Submap
from frontend.place_search_kernels import agreement
from fusion.scan import LIDAR_LAYER

QUERY_EVERY_M: Final = 1.0
"""Way between two places asked about."""
MIN_WAY_M: Final = 4.0
"""Submaps nearer than this along the graph are joined enough."""
ASKED_SHARE: Final = 0.5
"""A place is asked about again if the guess has moved by more than this share of the window."""
ANYWHERE_PLACES: Final = 4
ANYWHERE_SUBMAPS: Final = 20
"""So many places of a part that nothing joins are looked for, each in so many submaps."""
BEAR_OUT_M: Final = 20.0
"""What is to bear a closure out is no farther from it than this."""


class LoopConfig(Section):
    """Where loops are looked for, and what is believed."""

    candidates: int = Field(6, ge=1, description="submaps tried for each place, nearest first")
    reach_m: float = Field(1.5, gt=0.0, description="submaps nearer than this and the window")
    min_window_m: float = Field(0.6, gt=0.0, description="search window with no drift")
    max_window_m: float = Field(25.0, gt=0.0, description="search window at the most")
    drift_m_per_m: float = Field(0.03, gt=0.0, description="the window grows with the way since")
    drift_rad_per_m: float = Field(0.004, gt=0.0, description="the window grows with the way since")
    ambiguous_ratio: float = Field(0.92, gt=0.0, lt=1.0, description="a second peak this near")


class LoopSearch:
    """Asks for each finished submap, place after place, which earlier submaps show it.

    Work is queued when a submap is finished, and done one piece at a time (``step``), so that no
    scan has to wait for much. Where the poses are known to within WIDE_M every metre is asked
    about; where drift has grown beyond, one place of each submap: a single closure brings the
    windows of the others down again.
    """

    def __init__(self, config: LoopConfig, nodes: list[Node], submaps: list[Submap]) -> None:
        """nodes, submaps : the growing lists of local SLAM, shared, not copied."""
        self._config = config
        self._nodes = nodes
        self._submaps = submaps
        self._maps = SubmapMaps(nodes, submaps)
        self._queries: deque[tuple[Node, Submap]] = deque()
        self._tasks: deque[PlaceTask] = deque()
        self._rivals: list[LoopAttempt] = []
        self.matcher = PlaceMatcher(self._maps, config.ambiguous_ratio)
        self.attempts: list[LoopAttempt] = []
        self._asked: dict[tuple[int, int], tuple[Array, float]] = {}

    def enqueue(self, submap: Submap) -> None:
        """Ask about the places of a finished submap."""
        asked_m = -math.inf
        for node in submap.nodes:
            if node.way_m - asked_m >= QUERY_EVERY_M or node is submap.anchor:
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
    ) -> list[LoopAttempt]:
        """Do one piece of work: choose submaps for a place, draw one, or search one.

        T_map_anchors : (S, 3, 3), present poses of the submaps.
        way_since_m   : for a submap and a number n of submaps, (n,) the way between it and the
                        first n along the graph, m.

        Returns the attempts that were decided on.
        """
        if not self._tasks:
            if self._queries:
                self._plan(*self._queries.popleft(), T_map_anchors, way_since_m)
            return []
        if not self._maps.drawn(self._tasks[0].submap):
            self._maps.get(self._tasks[0].submap)
            return []
        task = self._tasks.popleft()
        attempt = self.matcher.search(task)
        done = [attempt]
        if task.window_m > WIDE_M:
            self._rivals.append(attempt)
            done = []
        if self._rivals and not (self._tasks and self._tasks[0].query is task.query):
            done += self._decided(T_map_anchors, way_since_m)
        self.attempts += done
        return done

    def _plan(
        self,
        query: Node,
        own: Submap,
        T_map_anchors: Array,
        way_since_m: Callable[[int, int], Array],
    ) -> None:
        """Choose the submaps to search for a place, those with small windows first."""
        earlier = own.index - 1
        if earlier < 1:
            return
        config = self._config
        ways_m = way_since_m(own.index, earlier)
        T_map_query = T_map_anchors[own.index] @ own.T_anchor_base(query)
        near: list[tuple[bool, float, int]] = []
        windows_m = np.minimum(config.drift_m_per_m * ways_m, config.max_window_m)
        if query is not own.anchor:
            windows_m[windows_m > WIDE_M] = -np.inf
        bounds_m = self._maps.nearest_bound_m(T_map_anchors[:earlier], T_map_query[:2, 2])
        near_enough = bounds_m < config.reach_m + windows_m
        for index in np.flatnonzero(near_enough & (ways_m >= MIN_WAY_M)).tolist():
            T_guess = inverse(T_map_anchors[index]) @ T_map_query
            away_m = float(self._maps.distances_m(self._submaps[index], T_guess[:2, 2]).min())
            window_m = self._window(ways_m[index])[0]
            if away_m < config.reach_m + windows_m[index] and not self._is_answered(
                (query.index, index), T_guess, window_m
            ):
                near.append((window_m > WIDE_M, away_m, index))
        for _, _, index in sorted(near)[: config.candidates]:
            T_guess = inverse(T_map_anchors[index]) @ T_map_query
            window = self._window(ways_m[index])
            self._asked[query.index, index] = (T_guess[:2, 2], window[0])
            self._tasks.append(PlaceTask(query, own, self._submaps[index], T_guess, *window))

    def enqueue_anywhere(self, part: Sequence[Submap], others: Sequence[Submap]) -> None:
        """Look for some places of a part of the drive in all submaps of other parts, at any yaw.

        For a part of which nobody knows where it lies. The submaps whose surfaces face most like
        the place's, whatever the yaw, come first, and only so many are asked.
        """
        every = max(1, math.ceil(len(part) / ANYWHERE_PLACES))
        for own in part[every // 2 :: every]:
            scan = self.matcher.query_scan(own.anchor, own)
            normals = scan.normals_base[scan.part(LIDAR_LAYER)]
            ranked = []
            for submap in others:
                fits = np.empty(FACING_BINS)
                agreement(self._maps.get(submap).facing, facing_of(normals), fits)
                ranked.append((-float(fits.max()), submap.index))
            for _, index in sorted(ranked)[:ANYWHERE_SUBMAPS]:
                submap = self._submaps[index]
                places = np.array([submap.T_anchor_base(node)[:2, 2] for node in submap.nodes])
                middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
                reach_m = self._config.reach_m + float(np.abs(places - middle).max())
                T_guess = se2(float(middle[0]), float(middle[1]), 0.0)
                window_m = max(reach_m, WIDE_M + 0.1)
                self._tasks.append(PlaceTask(own.anchor, own, submap, T_guess, window_m, math.pi))

    def bear_out(self, attempt: LoopAttempt, count: int) -> None:
        """Ask whether the places around a query are where an attempt would have them.

        They are other places, whose scans took no part in the attempt, looked for in small windows
        in the submaps that should show them. count : of the submaps that the graph knows.
        """
        T_anchor_own = attempt.T_anchor_base @ inverse(attempt.own.T_anchor_base(attempt.query))
        asked = attempt.query
        around = [
            submap
            for submap in self._joined_to(attempt.own, count)
            if abs(submap.index - attempt.own.index) < 3
        ]
        shown_by = self._joined_to(attempt.submap, count)
        for own in around:
            for query in (own.nodes[0], own.anchor, own.nodes[-1]):
                way_m = abs(query.way_m - asked.way_m)
                if abs(query.index - asked.index) <= 2 * QUERY_NEIGHBOURS or way_m > BEAR_OUT_M:
                    continue
                T_own_query = inverse(attempt.own.anchor.T_odom_base) @ query.T_odom_base
                T_anchor_query = T_anchor_own @ T_own_query
                near = []
                for submap in shown_by:
                    if submap.index >= own.index - 1:
                        continue
                    T_other = inverse(attempt.submap.T_anchor_base(submap.anchor)) @ T_anchor_query
                    away_m = float(self._maps.distances_m(submap, T_other[:2, 2]).min())
                    if away_m < self._config.reach_m + 2.0:
                        near.append((away_m, submap.index, T_other))
                if near:
                    _, index, T_other = min(near, key=lambda one: one[:2])
                    window_m = min(NEAR_M, 0.5 + self._config.drift_m_per_m * way_m)
                    window_rad = 0.1 + self._config.drift_rad_per_m * way_m
                    task = PlaceTask(
                        query, own, self._submaps[index], T_other, window_m, window_rad, attempt
                    )
                    self._tasks.append(task)

    def _joined_to(self, submap: Submap, count: int) -> list[Submap]:
        """The submaps some way before and after one, as far as tracking was not lost."""
        found = [submap]
        for step in (-1, 1):
            at = submap.index
            while 0 <= at + step < count and abs(at + step - submap.index) <= 10:
                if self._submaps[max(at, at + step)].nodes[0].lost:
                    break
                at += step
                found.append(self._submaps[at])
        return sorted(found, key=lambda s: s.index)

    def _is_answered(self, asked: tuple[int, int], T_guess: Array, window_m: float) -> bool:
        """Whether an earlier search of the same place in the same submap covers this one."""
        before = self._asked.get(asked)
        if before is None:
            return False
        moved_m = float(np.linalg.norm(before[0] - T_guess[:2, 2]))
        if before[1] > NEAR_M >= window_m:
            return False  # a small window asks for less
        return moved_m < ASKED_SHARE * before[1]

    def _decided(
        self, T_map_anchors: Array, way_since_m: Callable[[int, int], Array]
    ) -> list[LoopAttempt]:
        """The attempts with large windows for one place: several that say otherwise are none."""
        rivals, self._rivals = self._rivals, []
        accepted = [attempt for attempt in rivals if attempt.result == ACCEPTED]
        if len(accepted) < 2:
            return rivals
        best = max(accepted, key=lambda attempt: attempt.score)
        T_map_best = T_map_anchors[best.submap.index] @ best.T_anchor_base
        ways_m = way_since_m(best.submap.index, len(T_map_anchors))
        others = 0.0
        for attempt in accepted:
            T_map_other = T_map_anchors[attempt.submap.index] @ attempt.T_anchor_base
            x, y, yaw = xyyaw(inverse(T_map_best) @ T_map_other)
            drift_m = self._config.drift_m_per_m * float(ways_m[attempt.submap.index])
            if math.hypot(x, y) > APART_M + drift_m or abs(yaw) > APART_RAD:
                others = max(others, attempt.score)
        if others < self._config.ambiguous_ratio * best.score:
            return [a for a in rivals if a.result != ACCEPTED or a is best]
        return [
            replace(a, result=AMBIGUOUS, second_score=others) if a.result == ACCEPTED else a
            for a in rivals
        ]

    def _window(self, way_m: float) -> tuple[float, float]:
        """How far from the guess to search, m and rad: it grows with the way since."""
        config = self._config
        window_m = max(config.min_window_m, 0.3 + config.drift_m_per_m * way_m)
        return min(window_m, config.max_window_m), min(0.15 + config.drift_rad_per_m * way_m, 1.0)
