"""Candidates for where a scan was taken, and what is asked of one before it is believed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from frontend.agreement import Agreement
from frontend.match import Match, Rejected

GOOD_INLIER_RATIO: Final = 0.6
"""A match below this is looked for again, wider."""

SURPRISE_INLIER_RATIO: Final = 0.5
"""What only the wide search finds counts from here up."""

AGREEING_POINTS: Final = 0.1
"""Fewer of all points tell nothing."""

SPEED_M_S: Final = 1.5
SPEED_RAD_S: Final = 2.0
"""What bounds the wide search by the time gone."""

NEAR_AGREEMENT: Final = 0.65
FAR_AGREEMENT: Final = 0.8
"""Of the points that a scan and those before it can tell of each other, at the right pose: on
recordings of scans a metre apart the first percentile is 0.76 to 0.93, and half a metre or ten
degrees off the median is 0.2 to 0.65. What lies where it was predicted needs less."""


@dataclass(frozen=True, slots=True)
class Surprise:
    """How far away a scan is looked for at the last, and what is asked of a match there.

    window_m, window_rad   : at the most.
    speed_m_s, speed_rad_s : and no farther than a base gets in the time gone.
    score, inlier_ratio, agreement : at the least.
    """

    window_m: float
    window_rad: float
    speed_m_s: float
    speed_rad_s: float
    score: float
    inlier_ratio: float
    agreement: float


REACHED: Final = Surprise(2.5, 1.6, SPEED_M_S, SPEED_RAD_S, 0.4, 0.4, 0.85)
"""A base that drives backwards while its odometry counts forwards."""
ANYWHERE: Final = Surprise(2.5, math.pi, math.inf, math.inf, 0.6, GOOD_INLIER_RATIO, 0.9)
"""A base turned by hand; stamps that are not true."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A match, and how it agrees with the scans before; None where there is none."""

    found: Match | Rejected
    seen: Agreement | None

    def merit(self) -> float:
        """What the map and the scans before say of it, 0..1."""
        if isinstance(self.found, Rejected) or self.seen is None:
            return -1.0
        return self.seen.share * self.found.score

    def or_better(self, other: Candidate, margin: float) -> Candidate:
        """The other one, if it is better by more than a margin of merit."""
        return other if other.merit() > self.merit() + margin else self

    def believed(self, least_share: float) -> bool:
        """Whether it agrees with the scans before."""
        return (
            self.seen is not None
            and self.seen.share >= least_share
            and self.seen.agreeing >= AGREEING_POINTS * self.seen.total
        )
