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
from frontend.agreement import Agreement, agreement
from frontend.candidates import (
    ANYWHERE,
    FAR_AGREEMENT,
    GOOD_INLIER_RATIO,
    NEAR_AGREEMENT,
    REACHED,
    SPEED_M_S,
    SPEED_RAD_S,
    SURPRISE_INLIER_RATIO,
    Candidate,
    Surprise,
)
from frontend.local_map import LocalMap
from frontend.match import UNOBSERVED_SIGMA_M, Match, Rejected
from frontend.matching import INFORMATION_PER_POINT, match_correlative, match_surface
from frontend.motion import Motion
from frontend.prepared import PreparedScan

LOST: Final = "lost: the map of the last metres was given up and a new one begun"


WIDE_WINDOW_M: Final = 0.5
WIDE_WINDOW_RAD: Final = 1.2
"""How far the wide search goes at the most, where the first match fails."""

DATA_SHARE: Final = math.sqrt(INFORMATION_PER_POINT)
"""The alignment takes its points for independent, ten times what they are worth. A prior that is
meant in earnest is weighed alike."""

HELD_SIGMA: Final = (0.1, 0.03)
"""(m, rad) around what the search found, in which the alignment may move where little is seen: a
few points hold a yaw badly, and turn a scan by many degrees for a better fit of some of them."""

SPARSE_STEP_M: Final = 0.3
SPARSE_STEP_RAD: Final = 0.3
"""After a longer step every match is compared with the scans before: it is easily a wrong one."""

COMPARED_SCANS: Final = 3
"""Scans that a match is compared with: the last ones of its sensor that the map holds."""

MIN_SURFACE_POINTS: Final = 10
"""A scan with fewer is neither matched nor kept."""

WIDE_SCORE: Final = 0.3
"""What scores less is not looked for by the wide search."""

SECOND_SCORE: Final = 0.9
"""What is found far away doesn't count where another place scores so much of it."""

SEARCH_PENALTY: Final = 0.0125
"""Loss of score one standard deviation away from the prediction."""

Align = Callable[
    [PreparedScan, LocalMap, Array, Array, tuple[float, float]],
    Match | Rejected,
]
"""From near the answer to the answer: (scan, map, T_start, T_expected, (m, rad) of the prior)."""

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
        self._align = align
        self._search_penalty = search_penalty
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
            outcome = self._match(scan, self._map, T_odom_guess, motion)
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
        second = self._match(other, local_map, T_odom_guess, motion)
        if isinstance(second, Match) and second.inlier_ratio > first.inlier_ratio:
            return other, second
        return scan, first

    def _match(
        self, scan: PreparedScan, local_map: LocalMap, T_odom_guess: Array, motion: Motion
    ) -> Match | Rejected:
        """Near the guess; where that contradicts what was seen, or holds little, ever wider."""
        sigma = (motion.sigma_m, motion.sigma_rad)
        loose = (2.0 * sigma[0], 2.0 * sigma[1])
        found, T_start = self._match_near(scan, local_map, T_odom_guess, sigma, sigma, loose)
        good = isinstance(found, Match) and found.inlier_ratio >= GOOD_INLIER_RATIO
        if good and not self._sparse:
            return found
        near = Candidate(found, self._agreement(scan, found))
        if good and near.believed(FAR_AGREEMENT):
            return found
        usual = (sigma[0], motion.usual_sigma[1])
        held = (loose[0], DATA_SHARE * usual[1])
        found, _ = self._match_near(scan, local_map, T_odom_guess, sigma, usual, held)
        near = Candidate(found, self._agreement(scan, found)).or_better(near, 0.05)
        # where little is seen, or something else looks alike, the alignment depends on its start
        for T_near, T_held, held in (
            (T_odom_guess, T_odom_guess, sigma),
            (T_start, T_start, HELD_SIGMA),
        ):
            other = self._align(scan, local_map, T_near, T_held, held)
            near = near.or_better(Candidate(other, self._agreement(scan, other)), 0.03)
        wide = self._match_wide(scan, local_map, T_odom_guess, motion, near)
        best = near if wide is None or not wide.believed(FAR_AGREEMENT) else wide
        if not self._sure(best, T_odom_guess, motion):
            for surprise in (REACHED, ANYWHERE):
                widest = self._match_widest(scan, local_map, T_odom_guess, motion, surprise)
                if widest is not None and widest.believed(surprise.agreement):
                    best = best.or_better(widest, 0.1)
                    break
        if not best.believed(self._least_agreement(best, T_odom_guess, motion)):
            return Rejected("contradicts what the scans before saw")
        found = best.found
        if isinstance(found, Match) and found.inlier_ratio < self._config.min_inlier_ratio:
            return Rejected("too little of the scan lies on the map")
        return found

    def _match_near(
        self,
        scan: PreparedScan,
        local_map: LocalMap,
        T_odom_guess: Array,
        sigma: tuple[float, float],
        usual: tuple[float, float],
        held: tuple[float, float],
    ) -> tuple[Match | Rejected, Array]:
        """Search within three sigma (m, rad), preferring what is usual; align, held to the guess.

        Returns the match, and where its alignment began.
        """
        first = match_correlative(
            scan,
            local_map,
            T_odom_guess,
            min(2.5, 0.1 + 3.0 * sigma[0]),
            min(1.5, 3.0 * sigma[1]),
            (self._search_penalty / usual[0] ** 2, self._search_penalty / usual[1] ** 2),
        )
        T_start = T_odom_guess if isinstance(first, Rejected) else first[0]
        return self._align(scan, local_map, T_start, T_odom_guess, held), T_start

    def _agreement(self, scan: PreparedScan, found: Match | Rejected) -> Agreement | None:
        """Of a match with the scans before; None where there are none to tell."""
        if isinstance(found, Rejected):
            return None
        others = [
            other
            for other in [*self._before, *self._growing][-4 * COMPARED_SCANS :]
            if other[0].sensor == scan.sensor
        ][-COMPARED_SCANS:]
        return agreement(scan, found.T_frame_base, others)

    def _give_up(self, scan: PreparedScan, T_odom_base: Array, outcome: Rejected) -> Rejected:
        """After too many scans without a match the old map is of no use: begin a new one here."""
        self._unmatched += 1
        if self._unmatched < self._config.lost_after_scans:
            return outcome
        self._unmatched = 0
        self._map, self._before, self._growing, self._inserted = None, [], [], {}
        self._insert(scan, T_odom_base)
        return Rejected(LOST)

    def _match_wide(
        self,
        scan: PreparedScan,
        local_map: LocalMap,
        T_odom_guess: Array,
        motion: Motion,
        near: Candidate,
    ) -> Candidate | None:
        """Search again as if the prediction were off by what no model foresees: slip, a lift.

        But not by more than a robot can move in the time. None if nothing better is found.
        """
        elapsed_s = max(motion.elapsed_s, 0.25)  # stamps are not always true
        window_m = min(WIDE_WINDOW_M, 0.05 + SPEED_M_S * elapsed_s)
        window_rad = min(WIDE_WINDOW_RAD, 0.05 + SPEED_RAD_S * elapsed_s)
        wide = match_correlative(
            scan,
            local_map,
            T_odom_guess,
            max(window_m, 3.0 * motion.sigma_m),
            max(window_rad, 3.0 * motion.sigma_rad),
            (0.1, 0.1),
            WIDE_SCORE,
        )
        if isinstance(wide, Rejected):
            return None
        second = self._align(scan, local_map, wide[0], wide[0], (window_m, window_rad))
        if isinstance(second, Rejected) or second.inlier_ratio < SURPRISE_INLIER_RATIO:
            return None
        first = near.found
        if (
            isinstance(first, Match)
            and near.believed(NEAR_AGREEMENT)
            and second.inlier_ratio <= first.inlier_ratio + 0.05
        ):
            return None
        candidate = Candidate(second, self._agreement(scan, second))
        return candidate if candidate.merit() > near.merit() else None

    def _match_widest(
        self,
        scan: PreparedScan,
        local_map: LocalMap,
        T_odom_guess: Array,
        motion: Motion,
        surprise: Surprise,
    ) -> Candidate | None:
        """Search far away, whatever the odometry says. None for what another place is as good as.

        A direction that the match leaves open holds no surprise.
        """
        elapsed_s = max(motion.elapsed_s, 0.25)
        window_m = min(surprise.window_m, 0.05 + surprise.speed_m_s * elapsed_s)
        window_rad = min(surprise.window_rad, 0.05 + surprise.speed_rad_s * elapsed_s)
        if window_m <= WIDE_WINDOW_M and window_rad <= WIDE_WINDOW_RAD:
            return None
        where = (T_odom_guess, window_m, window_rad, (0.02, 0.02))
        widest = match_correlative(scan, local_map, *where, surprise.score)
        if isinstance(widest, Rejected):
            return None
        T_start, score = widest
        found = self._align(scan, local_map, T_start, T_start, (WIDE_WINDOW_M, WIDE_WINDOW_RAD))
        if (
            isinstance(found, Rejected)
            or found.inlier_ratio < surprise.inlier_ratio
            or found.weak_sigma_m > UNOBSERVED_SIGMA_M
        ):
            return None
        candidate = Candidate(found, self._agreement(scan, found))
        if not candidate.believed(surprise.agreement):
            return None
        second = match_correlative(
            scan, local_map, *where, SECOND_SCORE * score, found.T_frame_base
        )
        return candidate if isinstance(second, Rejected) else None

    def _least_agreement(self, candidate: Candidate, T_odom_guess: Array, motion: Motion) -> float:
        """What a match must agree to be believed: less, where it was expected."""
        if isinstance(candidate.found, Rejected):
            return FAR_AGREEMENT
        x, y, yaw = xyyaw(inverse(T_odom_guess) @ candidate.found.T_frame_base)
        expected = (
            math.hypot(x, y) <= 0.1 + 3.0 * motion.sigma_m and abs(yaw) <= 3.0 * motion.sigma_rad
        )
        return NEAR_AGREEMENT if expected else FAR_AGREEMENT

    def _sure(self, candidate: Candidate, T_odom_guess: Array, motion: Motion) -> bool:
        """Whether there is no need to look farther away."""
        found = candidate.found
        if isinstance(found, Rejected) or not candidate.believed(FAR_AGREEMENT):
            return False
        near = self._least_agreement(candidate, T_odom_guess, motion) < FAR_AGREEMENT
        return near or found.inlier_ratio >= GOOD_INLIER_RATIO

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


def sparse(motion: Motion) -> bool:
    x, y, yaw = xyyaw(motion.T_last_base)
    return math.hypot(x, y) > SPARSE_STEP_M or abs(yaw) > SPARSE_STEP_RAD


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
