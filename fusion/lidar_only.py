"""A lidar scan by itself as a fused scan: the case without a second sensor."""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from datasets.messages import Array, LaserScan
from datasets.recording import LidarCalibration
from datasets.section import Section
from fusion.scan import FusedScan
from fusion.sweep import Sweep


class BeamLimits(Section):
    """Which beams take part."""

    min_range_m: float = Field(0.05, ge=0.0, description="nearer returns are left out")
    max_range_m: float = Field(40.0, gt=0.0, le=1000.0, description="farther returns are left out")
    noise_m: float = Field(0.01, gt=0.0, description="of a range, one sigma at 0 m")
    noise_per_m: float = Field(0.003, ge=0.0, description="and growing with the range")


class LidarProjection:
    """Takes the scans of one lidar to the base frame, for any mounting.

    A mounting that turns the lidar over reverses the order of the bearings; a tilted one shortens
    the beams to their horizontal part.
    """

    def __init__(self, calibration: LidarCalibration, limits: BeamLimits) -> None:
        T = calibration.T_base_lidar
        self._rotation = T[:2, :2]
        self._limits = limits
        self.origin_base: Array = T[:2, 3].copy()
        self._bearings: Array | None = None
        self._directions_base = np.empty((0, 2))
        self._bearings_base = self._horizontal = np.empty(0)
        self._order = np.empty(0, dtype=np.int64)
        self._spacing_rad = 0.0

    def __call__(self, scan: LaserScan) -> FusedScan:
        """The scan's returns within the limits, in the base frame, by ascending bearing."""
        return self.sweep(scan).returns()

    def sweep(self, scan: LaserScan) -> Sweep:
        """All beams of the scan: what another sensor's points are compared with."""
        if scan.bearings_rad is not self._bearings:
            self._aim(scan.bearings_rad)
        ranges_m = scan.ranges_m[self._order]
        nearest = max(self._limits.min_range_m, scan.range_min_m)
        # comparisons with NaN are False, so invalid beams are left out with the rest
        near, far = ranges_m < nearest, ranges_m > self._limits.max_range_m
        kept = ~(near | far | np.isnan(ranges_m))
        returned_m = np.where(kept, ranges_m, np.nan)
        horizontal_m = returned_m * self._horizontal
        horizontal_m[near], horizontal_m[far] = -np.inf, np.inf
        return Sweep(
            scan.stamp_ns,
            scan.lidar,
            self.origin_base,
            self._bearings_base,
            horizontal_m,
            self._directions_base * returned_m[:, None] + self.origin_base,
            scan.beam_offsets_s[self._order] if scan.beam_offsets_s.size else np.empty(0),
            (self._limits.noise_m + self._limits.noise_per_m * returned_m) ** 2,
            self._spacing_rad,
        )

    def _aim(self, bearings_rad: Array) -> None:
        """Directions of the beams in the base frame, kept while the same array comes again."""
        rays_lidar = np.column_stack([np.cos(bearings_rad), np.sin(bearings_rad)])
        rays_base = rays_lidar @ self._rotation.T
        angles = np.arctan2(rays_base[:, 1], rays_base[:, 0])
        self._order = np.argsort(angles, kind="stable")
        self._directions_base = rays_base[self._order]
        self._bearings_base = angles[self._order]
        self._horizontal = np.hypot(*self._directions_base.T)
        steps = np.diff(self._bearings_base)
        self._spacing_rad = float(np.median(steps)) if steps.size else math.radians(1.0)
        self._bearings = bearings_rad
