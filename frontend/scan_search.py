"""The search for a scan on the local map: near where it is expected, then ever wider."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

from datasets.messages import Array
from datasets.se2 import inverse, xyyaw
from frontend.agreement import agreement
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
from frontend.matching import INFORMATION_PER_POINT, match_correlative
from frontend.motion import Motion
from frontend.prepared import PreparedScan

WIDE_WINDOW_M: Final = 0.5
WIDE_WINDOW_RAD: Final = 1.2
"""How far the wide search goes at the most, where the first match fails."""

SPARSE_STEP_M: Final = 0.3
SPARSE_STEP_RAD: Final = 0.3
"""After a longer step every match is compared with the scans before: it is easily a wrong one."""

COMPARED_SCANS: Final = 3
"""Scans that a match is compared with: the last ones of its sensor that the map holds."""

WIDE_SCORE: Final = 0.3
"""What scores less is not looked for by the wide search."""

SECOND_SCORE: Final = 0.9
"""What is found far away doesn't count where another place scores so much of it."""

DATA_SHARE: Final = math.sqrt(INFORMATION_PER_POINT)
"""The alignment takes its points for independent, ten times what they are worth. A prior that is
meant in earnest is weighed alike."""

HELD_SIGMA: Final = (0.1, 0.03)
"""(m, rad) around what the search found, in which the alignment may move where little is seen: a
few points hold a yaw badly, and turn a scan by many degrees for a better fit of some of them."""

Align = Callable[
    [PreparedScan, LocalMap, Array, Array, tuple[float, float]],
    Match | Rejected,
]
"""From near the answer to the answer: (scan, map, T_start, T_expected, (m, rad) of the prior)."""


class ScanSearch:
    """Matches scans to a local map, and compares what it finds with the scans before.

    before : the scans that a match is compared with, and their poses (3, 3) in the map's frame;
        the caller replaces them as the map grows.
    """

    def __init__(self, align: Align, search_penalty: float, min_inlier_ratio: float) -> None:
        self._align = align
        self._search_penalty = search_penalty
        self._min_inlier_ratio = min_inlier_ratio
        self.before: Sequence[tuple[PreparedScan, Array]] = ()

    def match(
        self, scan: PreparedScan, local_map: LocalMap, T_odom_guess: Array, motion: Motion
    ) -> Match | Rejected:
        """Near the guess; where that contradicts what was seen, or holds little, ever wider."""
        sigma = (motion.sigma_m, motion.sigma_rad)
        loose = (2.0 * sigma[0], 2.0 * sigma[1])
        found, T_start = self._match_near(scan, local_map, T_odom_guess, sigma, sigma, loose)
        good = isinstance(found, Match) and found.inlier_ratio >= GOOD_INLIER_RATIO
        if good and not sparse(motion):
            return found
        near = self._judged(scan, found)
        if good and near.believed(FAR_AGREEMENT):
            return found
        usual = (sigma[0], motion.usual_sigma[1])
        held = (loose[0], DATA_SHARE * usual[1])
        found, _ = self._match_near(scan, local_map, T_odom_guess, sigma, usual, held)
        near = self._judged(scan, found).or_better(near, 0.05)
        # where little is seen, or something else looks alike, the alignment depends on its start
        for T_near, T_held, held in (
            (T_odom_guess, T_odom_guess, sigma),
            (T_start, T_start, HELD_SIGMA),
        ):
            other = self._align(scan, local_map, T_near, T_held, held)
            near = near.or_better(self._judged(scan, other), 0.03)
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
        if isinstance(found, Match) and found.inlier_ratio < self._min_inlier_ratio:
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
        candidate = self._judged(scan, second)
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
        candidate = self._judged(scan, found)
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

    def _judged(self, scan: PreparedScan, found: Match | Rejected) -> Candidate:
        """What was found, with how it agrees with the last scans of its sensor."""
        if isinstance(found, Rejected):
            return Candidate(found, None)
        same = [other for other in self.before if other[0].sensor == scan.sensor]
        return Candidate(found, agreement(scan, found.T_frame_base, same[-COMPARED_SCANS:]))


def sparse(motion: Motion) -> bool:
    x, y, yaw = xyyaw(motion.T_last_base)
    return math.hypot(x, y) > SPARSE_STEP_M or abs(yaw) > SPARSE_STEP_RAD
