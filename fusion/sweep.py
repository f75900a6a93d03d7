"""One turn of a lidar in the base frame with all its beams, those without a return included."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from fusion.scan import FusedScan


@dataclass(frozen=True, slots=True)
class Sweep:
    """The beams of one turn, by ascending bearing around the lidar.

    stamp_ns     : time of the scan's first beam.
    sensor       : name of the lidar.
    origin_base  : (2,) m, where it stands on the base.
    bearings_rad : (N,) ascending, in (-pi, pi], in the base's axes.
    ranges_m     : (N,) horizontal; REP 117: +inf no return (or one too far to be used), -inf
                   too near, NaN invalid.
    points_base  : (N, 2) m, each in the base frame of its own time; NaN where nothing returned.
    offsets_s    : (N,) seconds from ``stamp_ns`` to each beam; empty when unknown.
    variance_m2  : (N,) of each range; NaN where nothing returned.
    spacing_rad  : typical angle between neighbouring beams.
    """

    stamp_ns: int
    sensor: str
    origin_base: Array
    bearings_rad: Array
    ranges_m: Array
    points_base: Array
    offsets_s: Array
    variance_m2: Array
    spacing_rad: float

    @property
    def moment_ns(self) -> int:
        """The middle of the turn; the stamp itself where beam times are unknown."""
        return self.stamp_ns + round(1e9 * self.middle_s)

    @property
    def middle_s(self) -> float:
        """Seconds from the stamp to the middle of the turn."""
        if not self.offsets_s.size:
            return 0.0
        return 0.5 * float(self.offsets_s.min() + self.offsets_s.max())

    def returns(self) -> FusedScan:
        """What the lidar measured, by itself."""
        kept = np.isfinite(self.ranges_m)
        return FusedScan.of_lidar(
            self.stamp_ns,
            self.sensor,
            self.origin_base,
            self.points_base[kept],
            self.offsets_s[kept] if self.offsets_s.size else self.offsets_s,
            self.spacing_rad,
            self.variance_m2[kept],
        )
