"""Scan after scan against the map of the last few metres: the base's pose in the odom frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from pydantic import Field

from datasets.messages import Array
from datasets.se2 import inverse, xyyaw
from datasets.section import Section
from frontend.local_map import LocalMap
from frontend.match import Match, Rejected
from frontend.matching import match_surface
from frontend.motion import Motion
from frontend.prepared import PreparedScan
from frontend.scan_search import COMPARED_SCANS, Align, ScanSearch, sparse

LOST: Final = "lost: the map of the last metres was given up and a new one begun"


MIN_SURFACE_POINTS: Final = 10
"""A scan with fewer is neither matched nor kept."""

SEARCH_PENALTY: Final = 0.0125
"""Loss of score one standard deviation away from the prediction."""

Anew = Callable[[Match], PreparedScan | None]
"""The same scan de-skewed by what its match says of the motion; None where that is nothing new."""


def as_it_is(_match: Match) -> None:
    """An ``Anew`` that knows nothing better than the scan as it is."""


class TrackerConfig(Section):
    """When a match is believed, and how the local map grows."""

    step_m: float = Field(0.1, gt=0.0, description="scans nearer to the last are not added")
    step_rad: float = Field(0.1, gt=0.0, description="scans turned by less are not added")
    scans_per_map: int = Field(20, ge=2, description="a map holds these and those before")
    min_inlier_ratio: float = Field(0.15, gt=0.0, lt=1.0, description="below: no match")
    lost_after_scans: int = Field(5, ge=1, description="so many without a match: start anew")


@dataclass(frozen=True, slots=True)
class Tracked:
    """A scan with its pose in the odom frame, and how it came by it.

    T_odom_base : (3, 3).
    outcome     : the match, or why there is none and the prediction stands in.
    motion      : what was predicted.
    """

    scan: PreparedScan
    T_odom_base: Array
    outcome: Match | Rejected
    motion: Motion


class Tracker(Protocol):
    """Finds the pose of one scan after the other in the odom frame, which drifts."""

    def track(self, scan: PreparedScan, motion: Motion, anew: Anew = as_it_is) -> Tracked:
        """The scan's pose; a scan that can't be matched keeps the predicted one.

        anew : is asked once the scan is matched, if the tracker can match it a second time.
        """
        ...


class ScanPlacer:
    """Matches each scan to the union of the last and the growing local map, and lets these grow.

    Where a scan is expected its caller says.
    """

    def __init__(self, config: TrackerConfig, align: Align, search_penalty: float) -> None:
        self._config = config
        self._search = ScanSearch(align, search_penalty, config.min_inlier_ratio)
        self._map: LocalMap | None = None
        self._before: list[tuple[PreparedScan, Array]] = []
        self._growing: list[tuple[PreparedScan, Array]] = []
        self._inserted: dict[str, Array] = {}
        self._unmatched = 0
        self._sparse = False

    def place(self, scan: PreparedScan, T_odom_guess: Array, motion: Motion, anew: Anew) -> Tracked:
        """The scan's pose: the match near the guess, or the guess itself.

        motion : how far the guess may be off, and the time since the scan before.
        anew   : see Tracker; counts if the scan then lies better on the map.
        """
        self._sparse = sparse(motion)
        if scan.surface_count < MIN_SURFACE_POINTS:  # blind: it says nothing, not even "lost"
            return Tracked(scan, T_odom_guess, Rejected("too few points on surfaces"), motion)
        if self._map is None:
            outcome: Match | Rejected = Rejected("first scan")
            T_odom_base = T_odom_guess
            self._insert(scan, T_odom_base)
        else:
            outcome = self._find(scan, self._map, T_odom_guess, motion)
            if isinstance(outcome, Match):
                scan, outcome = self._anew(scan, self._map, T_odom_guess, motion, outcome, anew)
            if scan.sensor not in self._inserted and not isinstance(outcome, Match):
                # what this sensor sees no other may have seen: it begins where it is predicted
                self._insert(scan, T_odom_guess)
            if isinstance(outcome, Match):
                self._unmatched = 0
                T_odom_base = outcome.T_frame_base
                if self._moved(scan.sensor, T_odom_base):
                    self._insert(scan, T_odom_base)
            else:
                T_odom_base = T_odom_guess
                outcome = self._give_up(scan, T_odom_base, outcome)
        return Tracked(scan, T_odom_base, outcome, motion)

    def _anew(
        self,
        scan: PreparedScan,
        local_map: LocalMap,
        T_odom_guess: Array,
        motion: Motion,
        first: Match,
        anew: Anew,
    ) -> tuple[PreparedScan, Match]:
        other = anew(first)
        if other is None:
            return scan, first
        second = self._find(other, local_map, T_odom_guess, motion)
        if isinstance(second, Match) and second.inlier_ratio > first.inlier_ratio:
            return other, second
        return scan, first

    def _find(
        self, scan: PreparedScan, local_map: LocalMap, T_odom_guess: Array, motion: Motion
    ) -> Match | Rejected:
        self._search.before = [*self._before, *self._growing][-4 * COMPARED_SCANS :]
        return self._search.match(scan, local_map, T_odom_guess, motion)

    def _give_up(self, scan: PreparedScan, T_odom_base: Array, outcome: Rejected) -> Rejected:
        """After too many scans without a match the old map is of no use: begin a new one here."""
        self._unmatched += 1
        if self._unmatched < self._config.lost_after_scans:
            return outcome
        self._unmatched = 0
        self._map, self._before, self._growing, self._inserted = None, [], [], {}
        self._insert(scan, T_odom_base)
        return Rejected(LOST)

    def _moved(self, sensor: str, T_odom_base: Array) -> bool:
        T_odom_inserted = self._inserted.get(sensor)
        if T_odom_inserted is None:
            return True
        x, y, yaw = xyyaw(inverse(T_odom_inserted) @ T_odom_base)
        return math.hypot(x, y) > self._config.step_m or abs(yaw) > self._config.step_rad

    def _insert(self, scan: PreparedScan, T_odom_base: Array) -> None:
        if self._map is None or len(self._growing) >= self._config.scans_per_map:
            self._before, self._growing = self._growing, []
            reach_m = 15.0
            for other, T in [*self._before, (scan, T_odom_base)]:
                seen = np.hypot(*(other.points_base.T)) if len(other.points_base) else np.zeros(1)
                shift = float(np.linalg.norm(T[:2, 2] - T_odom_base[:2, 2]))
                reach_m = max(reach_m, float(seen.max()) + shift)
            # some metres more than is seen now, for what comes into view while the map grows
            half = min(reach_m, 30.0) + 5.0
            self._map = LocalMap(T_odom_base[:2, 2] - half, T_odom_base[:2, 2] + half)
            for other, T in self._before:
                self._map.insert(other, T, single=self._sparse)
        self._growing.append((scan, T_odom_base))
        self._map.insert(scan, T_odom_base, single=self._sparse)
        self._inserted[scan.sensor] = T_odom_base


class ScanMatchingTracker:
    """Expects each scan where the motion since the last leads to; see Tracker."""

    def __init__(
        self,
        config: TrackerConfig,
        align: Align = match_surface,
        search_penalty: float = SEARCH_PENALTY,
    ) -> None:
        self._placer = ScanPlacer(config, align, search_penalty)
        self._T_odom_last = np.eye(3)

    def track(self, scan: PreparedScan, motion: Motion, anew: Anew = as_it_is) -> Tracked:
        """See Tracker."""
        tracked = self._placer.place(scan, self._T_odom_last @ motion.T_last_base, motion, anew)
        self._T_odom_last = tracked.T_odom_base
        return tracked
