"""What a depth image, or a second lidar, says in the plane: a pseudo-laser scan, and more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.messages import Array, Float32s


@dataclass(frozen=True, slots=True)
class PseudoScan:
    """The obstacles that one view of a sensor shows, laid into the plane of the base.

    stamp_ns      : of the view; all of it is in the base frame of that moment.
    sensor        : name of the camera, or of the lidar.
    origin_base   : (2,) m, the sensor's place in the plane.
    bearings_rad  : (B,) ascending, around ``origin_base``, in the base's axes; the middles of bins.
    ranges_m      : (B,) horizontal distance from ``origin_base`` to the first obstacle in the bin;
                    +inf where none is (as far as ``free_to_m``), NaN where nothing is known.
    sigma_m       : (B,) standard deviation of each finite range; NaN elsewhere.
    free_from_m   : nearer than this the sensor doesn't see low things: nothing is known there.
    free_to_m     : (B,) up to where each bin was seen to be free; below free_from_m: not at all.
    surfaces_base : (P, 2) float32, m, every supported surface in the gate, those behind the nearest
                    included: what a camera layer takes in, since a camera looks over low things.
    spacing_rad   : typical angle between neighbouring bins.

    Raises ValueError if shapes disagree, bearings fall or a surface is not finite.
    """

    stamp_ns: int
    sensor: str
    origin_base: Array
    bearings_rad: Array
    ranges_m: Array
    sigma_m: Array
    free_from_m: float
    free_to_m: Array
    surfaces_base: Float32s
    spacing_rad: float

    def __post_init__(self) -> None:
        count = len(self.bearings_rad)
        for each in (self.bearings_rad, self.ranges_m, self.sigma_m, self.free_to_m):
            if each.shape != (count,):
                raise ValueError(f"an array does not belong to {count} bearings")
        if self.origin_base.shape != (2,) or self.surfaces_base.shape[1:] != (2,):
            raise ValueError("origin_base must be (2,) and surfaces_base (P, 2)")
        if not np.isfinite(self.surfaces_base).all() or not np.isfinite(self.bearings_rad).all():
            raise ValueError("surfaces and bearings must be finite")
        if (np.diff(self.bearings_rad) < 0.0).any():
            raise ValueError("bearings must ascend")

    @property
    def points_base(self) -> Array:
        """(K, 2) the ends of the finite ranges."""
        hit = np.isfinite(self.ranges_m)
        rays = np.column_stack([np.cos(self.bearings_rad[hit]), np.sin(self.bearings_rad[hit])])
        points: Array = self.origin_base + rays * self.ranges_m[hit, None]
        return points
