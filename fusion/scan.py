"""The scan that goes to the front end: end points in the base frame, each with its own time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from fusion.kernel_types import Bytes

LIDAR: Final = 0
"""Value of ``FusedScan.source`` for a beam measured by the scan's own lidar,"""
CAMERA: Final = 1
"""by a sensor that sees lower: a depth camera, or a second lidar at another height,"""
BOTH: Final = 2
"""and by both, which saw the same surface."""

LIDAR_LAYER: Final = 0
"""Value of ``FusedScan.layer``: what the scan's own lidar saw, and what it saw with the camera,"""
CAMERA_LAYER: Final = 1
"""and what only the camera (or a lidar at another height) saw: lower things, as a rule."""


@dataclass(frozen=True, slots=True)
class FusedScan:
    """What was hit around the robot during one turn of a sensor.

    stamp_ns        : time of the scan's first beam.
    sensor          : name of the sensor whose turn this is.
    origin_base     : (2,) m, where that sensor stands on the base.
    points_base     : (N, 2) float64, m, finite: end points of the beams that returned, each in the
                      base frame of its own time; the points of layer 0 first, then those of
                      layer 1, in each by bearing around ``origin_base`` (those of a camera
                      that looks backwards go on across pi).
    offsets_s       : (N,) seconds from ``stamp_ns`` to each beam; empty when unknown.
    source          : (N,) uint8, which kind of sensor measured the point: LIDAR, CAMERA, BOTH.
    beam_spacing_rad: typical angle between neighbouring beams.
    layer           : (N,) uint8, the layer of the map that the point is matched against and
                      inserted into. All 0 is the paper's single grid.
    variance_m2     : (N,) of each range.
    lidar_range_m, camera_range_m : (N,) from ``origin_base``, what each kind of sensor measured in
                      this direction; NaN where it measured nothing. ``source`` says which of
                      them the point is; of BOTH it is the lidar's (in paper mode the smaller one).

    Raises ValueError if shapes disagree, a point is not finite or layers are out of order.
    """

    stamp_ns: int
    sensor: str
    origin_base: Array
    points_base: Array
    offsets_s: Array
    source: Bytes
    beam_spacing_rad: float
    layer: Bytes
    variance_m2: Array
    lidar_range_m: Array
    camera_range_m: Array

    @classmethod
    def of_lidar(
        cls,
        stamp_ns: int,
        sensor: str,
        origin_base: Array,
        points_base: Array,
        offsets_s: Array,
        beam_spacing_rad: float,
        variance_m2: Array,
    ) -> Self:
        """A scan that a lidar took alone."""
        count = len(points_base)
        ranges_m = np.hypot(*(points_base - origin_base).T) if count else np.empty(0)
        return cls(
            stamp_ns,
            sensor,
            origin_base,
            points_base,
            offsets_s,
            np.full(count, LIDAR, dtype=np.uint8),
            beam_spacing_rad,
            np.full(count, LIDAR_LAYER, dtype=np.uint8),
            variance_m2,
            ranges_m,
            np.full(count, np.nan),
        )

    @property
    def at_lidar_range(self) -> npt.NDArray[np.bool_]:
        """(N,) whether a point stands where the lidar measured it, a camera agreeing or not."""
        own = self.source == LIDAR
        both = np.flatnonzero(self.source == BOTH)
        away_m = np.hypot(*(self.points_base[both] - self.origin_base).T)
        own[both] = np.abs(away_m - self.lidar_range_m[both]) < 1e-6
        return own

    def __post_init__(self) -> None:
        count = len(self.points_base)
        if self.points_base.shape != (count, 2) or self.origin_base.shape != (2,):
            raise ValueError("points_base must be (N, 2) and origin_base (2,)")
        if self.source.shape != (count,) or self.offsets_s.shape not in ((count,), (0,)):
            raise ValueError(f"sources or times do not belong to {count} points")
        for each in (self.layer, self.variance_m2, self.lidar_range_m, self.camera_range_m):
            if each.shape != (count,):
                raise ValueError(f"layers, variances or ranges do not belong to {count} points")
        if not np.isfinite(self.points_base).all():
            raise ValueError("points_base must be finite")
        if (self.layer[1:] < self.layer[:-1]).any():
            raise ValueError("the points of layer 0 come first")
