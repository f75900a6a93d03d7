"""The scan that goes to the front end: end points in the base frame, each with its own time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from datasets.messages import Array

LIDAR: Final = 0
"""Value of ``FusedScan.source`` for a beam measured by a lidar."""


@dataclass(frozen=True, slots=True)
class FusedScan:
    """What was hit around the robot during one turn of a sensor.

    stamp_ns        : time of the scan's first beam.
    sensor          : name of the sensor whose turn this is.
    origin_base     : (2,) m, where that sensor stands on the base.
    points_base     : (N, 2) float64, m, finite: end points of the beams that returned, ordered by
                      bearing around ``origin_base``, each in the base frame of its own time.
    offsets_s       : (N,) seconds from ``stamp_ns`` to each beam; empty when unknown.
    source          : (N,) uint8, which kind of sensor measured the point.
    beam_spacing_rad: typical angle between neighbouring beams.

    Raises ValueError if shapes disagree or a point is not finite.
    """

    stamp_ns: int
    sensor: str
    origin_base: Array
    points_base: Array
    offsets_s: Array
    source: npt.NDArray[np.uint8]
    beam_spacing_rad: float

    def __post_init__(self) -> None:
        count = len(self.points_base)
        if self.points_base.shape != (count, 2) or self.origin_base.shape != (2,):
            raise ValueError("points_base must be (N, 2) and origin_base (2,)")
        if self.source.shape != (count,) or self.offsets_s.shape not in ((count,), (0,)):
            raise ValueError(f"sources or times do not belong to {count} points")
        if not np.isfinite(self.points_base).all():
            raise ValueError("points_base must be finite")
