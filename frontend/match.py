"""What a scan match gives: a pose with all that is needed to judge it, or why there is none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from datasets.messages import Array

UNOBSERVED_SIGMA_M: Final = 0.05
"""A match that leaves a direction this uncertain did not observe it: odometry holds it."""


@dataclass(frozen=True, slots=True)
class Match:
    """A scan laid on a map.

    T_frame_base : (3, 3), in the map's frame.
    information  : (3, 3) of the data alone, in base axes (x m, y m, yaw rad); a direction that was
                   not observed has next to none. Cautious: see ``INFORMATION_PER_POINT``.
    score        : mean likelihood of the map's field under the points, 0..1.
    inlier_ratio : share of the points with a normal that lie on the map, robustly weighted, 0..1.
    rms_m        : of the weighted distances to the surface.
    weak_sigma_m : standard deviation along the least observed direction.
    weak_base    : (2,) that direction, unit, base axes.
    """

    T_frame_base: Array
    information: Array
    score: float
    inlier_ratio: float
    rms_m: float
    weak_sigma_m: float
    weak_base: Array


@dataclass(frozen=True, slots=True)
class Rejected:
    """No match, and why, in the words of the report."""

    reason: str
