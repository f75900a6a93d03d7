"""A second lidar at another height as a source: its turn as a view, like that of a camera."""

from __future__ import annotations

import numpy as np

from datasets.messages import Array, LaserScan
from datasets.recording import LidarCalibration
from fusion.deskew import deskew
from fusion.lidar_only import BeamLimits, LidarProjection
from fusion.pseudo_scan import PseudoScan

SYSTEMATIC_SHARE = 0.003
"""By how much of them a lidar's ranges are off as a whole, at most: ``PlacedView``'s."""


class LidarView:
    """Takes the scans of one lidar for pseudo-scans."""

    def __init__(self, calibration: LidarCalibration, limits: BeamLimits) -> None:
        self._projection = LidarProjection(calibration, limits)
        self._limits = limits

    def __call__(self, scan: LaserScan, velocity_base: Array) -> PseudoScan:
        """The scan as of the middle of its turn.

        velocity_base : (3,) m/s, m/s, rad/s, of the base in its own frame during the turn.

        Beams that returned are free up to there. Those without a return say nothing (NaN, and free
        nowhere): glass and black things don't return either.
        """
        sweep = self._projection.sweep(scan)
        hit = np.isfinite(sweep.ranges_m)
        rays = np.column_stack([np.cos(sweep.bearings_rad), np.sin(sweep.bearings_rad)])
        lengths = np.where(hit, sweep.ranges_m, 1.0)
        points = sweep.origin_base + rays * lengths[:, None]
        if sweep.offsets_s.size:
            points = deskew(points, sweep.offsets_s - sweep.middle_s, velocity_base)
        seen = points - sweep.origin_base
        bearings = np.arctan2(seen[:, 1], seen[:, 0])
        order = np.argsort(bearings, kind="stable")
        hit = hit[order]
        ranges = np.where(hit, np.hypot(seen[order, 0], seen[order, 1]), np.nan)
        return PseudoScan(
            stamp_ns=sweep.moment_ns,
            sensor=scan.lidar,
            origin_base=sweep.origin_base,
            bearings_rad=bearings[order],
            ranges_m=ranges,
            sigma_m=np.sqrt(sweep.variance_m2[order]),
            free_from_m=max(self._limits.min_range_m, scan.range_min_m),
            free_to_m=np.where(hit, ranges, 0.0),
            surfaces_base=points[order][hit].astype(np.float32),
            spacing_rad=sweep.spacing_rad,
        )
