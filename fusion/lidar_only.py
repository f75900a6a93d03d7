"""A lidar scan by itself as a fused scan: the case without a second sensor."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt
from pydantic import Field

from datasets.messages import Array, LaserScan
from datasets.recording import LidarCalibration
from datasets.section import Section
from fusion.scan import FusedScan
from fusion.sweep import Sweep

LIMIT_SIGMAS: Final = 3.0
LIMIT_NEIGHBOURS: Final = 5
"""Beams on each side of one near the limit of its range that must have come back as well."""


class BeamLimits(Section):
    """Which beams take part."""

    min_range_m: float = Field(0.05, ge=0.0, description="nearer returns are left out")
    max_range_m: float = Field(
        40.0,
        gt=0.0,
        le=1000.0,
        description="farther returns are left out, and surfaces that reach beyond it at the limit",
    )
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
        kept = ~(near | far | np.isnan(ranges_m) | self._cut_off(ranges_m, scan.range_max_m))
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

    def _cut_off(self, ranges_m: Array, range_max_m: float) -> npt.NDArray[np.bool_]:
        """Returns from surfaces that lie at the limit of the range, as far as it can be told.

        Of such a surface only those readings come back that noise made short: it would stand in
        the map too near, by two sigma at the worst, and draw the scans that see all of it later.
        So a return within three sigma of the limit counts only if all beams beside it came back.
        Invalid beams (NaN) tell nothing: they may be anything.
        """
        limits = self._limits
        limit_m = min(limits.max_range_m, range_max_m)
        margin_m = LIMIT_SIGMAS * (limits.noise_m + limits.noise_per_m * limit_m)
        doubtful: npt.NDArray[np.bool_] = (ranges_m > limit_m - margin_m) & (ranges_m <= limit_m)
        if not doubtful.any():
            return doubtful
        # the bearings of the beams that did not come back, once around and a little more
        missing_rad = self._bearings_base[ranges_m > limit_m]
        missing_rad = np.concatenate(
            [
                missing_rad[-LIMIT_NEIGHBOURS:] - 2.0 * math.pi,
                missing_rad,
                missing_rad[:LIMIT_NEIGHBOURS] + 2.0 * math.pi,
            ]
        )
        beside_rad = (LIMIT_NEIGHBOURS + 0.5) * self._spacing_rad
        at_rad = self._bearings_base[doubtful]
        first = np.searchsorted(missing_rad, at_rad - beside_rad)
        doubtful[doubtful] = np.searchsorted(missing_rad, at_rad + beside_rad) > first
        return doubtful

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
