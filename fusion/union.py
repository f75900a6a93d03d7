"""The union of all sensors' points without association: what merging scans does, to compare."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datasets.messages import Array
from fusion.placed_points import PlacedView, place_views
from fusion.scan import CAMERA, LIDAR, LIDAR_LAYER, FusedScan
from fusion.sweep import Sweep


def union(sweep: Sweep, views: Sequence[PlacedView], velocity_base: Array) -> FusedScan:
    """All points of the lidar and of the views in one layer, by bearing.

    velocity_base : (3,) m/s, m/s, rad/s, of the base in its own frame during the turn.
    """
    if not sweep.bearings_rad.size:
        return sweep.returns()
    found = place_views(sweep, views, velocity_base, 0.0)
    kept = np.isfinite(sweep.ranges_m)
    order = np.argsort(
        np.concatenate([sweep.bearings_rad[kept], found.bearings_rad]), kind="stable"
    )

    def joined(of_beams: Array, of_points: Array) -> Array:
        both: Array = np.concatenate([of_beams[kept], of_points])[order]
        return both

    beams, nothing = np.full(sweep.ranges_m.size, np.nan), np.full(found.beams.size, np.nan)
    sources = np.full(order.size, LIDAR, dtype=np.uint8)
    sources[order >= np.count_nonzero(kept)] = CAMERA
    times = sweep.offsets_s
    return FusedScan(
        sweep.stamp_ns,
        sweep.sensor,
        sweep.origin_base,
        joined(sweep.points_base, found.points_base),
        joined(times, found.times_s) if times.size else times,
        sources,
        sweep.spacing_rad,
        np.full(order.size, LIDAR_LAYER, dtype=np.uint8),
        joined(sweep.variance_m2, found.sigma_m**2),
        joined(sweep.ranges_m, nothing),
        joined(beams, found.ranges_m),
    )
