"""A pseudo-laser scan by itself as a fused scan: the robot that has no lidar, or doesn't use it."""

from __future__ import annotations

import numpy as np

from fusion.pseudo_scan import PseudoScan
from fusion.scan import CAMERA, LIDAR_LAYER, FusedScan


def camera_scan(pseudo: PseudoScan) -> FusedScan:
    """The nearest obstacles of one view, seen at one moment, in the only layer there is."""
    hit = np.isfinite(pseudo.ranges_m)
    ranges_m = pseudo.ranges_m[hit]
    count = int(ranges_m.size)
    return FusedScan(
        pseudo.stamp_ns,
        pseudo.sensor,
        pseudo.origin_base,
        pseudo.points_base,
        np.empty(0),
        np.full(count, CAMERA, dtype=np.uint8),
        pseudo.spacing_rad,
        np.full(count, LIDAR_LAYER, dtype=np.uint8),
        pseudo.sigma_m[hit] ** 2,
        np.full(count, np.nan),
        ranges_m,
    )
