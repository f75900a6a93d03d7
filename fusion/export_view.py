"""A fused scan as a laser scan that any program takes: even angles, one range a direction."""

from __future__ import annotations

import math

import numpy as np

from datasets.messages import Array, LaserScan
from fusion.deskew import deskew
from fusion.scan import FusedScan


def laser_view(
    scan: FusedScan, velocity_base: Array, *, beams: int = 720, range_max_m: float = 30.0
) -> LaserScan:
    """The nearest of all layers' points in each of ``beams`` even directions, seen at one moment.

    velocity_base : (3,) m/s, m/s, rad/s, of the base in its own frame during the turn.

    Directions are those of the base's axes, around ``origin_base``, from -pi on, all round and none
    twice; their count never changes. +inf stands where nothing is, or what is farther than
    ``range_max_m``. The points are those of the middle of the turn, which is the stamp, so the
    beams have no times of their own.

    Raises ValueError unless there are two beams or more and the range is positive.
    """
    if beams < 2 or not 0.0 < range_max_m < math.inf:
        raise ValueError(f"{beams} beams of {range_max_m} m make no scan")
    points, stamp_ns = scan.points_base, scan.stamp_ns
    if scan.offsets_s.size:
        middle_s = 0.5 * float(scan.offsets_s.min() + scan.offsets_s.max())
        points = deskew(points, scan.offsets_s - middle_s, velocity_base)
        stamp_ns += round(1e9 * middle_s)
    bearings: Array = np.arange(beams, dtype=np.float64) * (2.0 * math.pi / beams) - math.pi
    seen = points - scan.origin_base
    lengths = np.hypot(seen[:, 0], seen[:, 1])
    turned = (np.arctan2(seen[:, 1], seen[:, 0]) + math.pi) * (beams / (2.0 * math.pi))
    ranges = np.full(beams, np.inf)
    near = (lengths > 0.0) & (lengths < range_max_m)
    np.minimum.at(ranges, np.rint(turned[near]).astype(np.int64) % beams, lengths[near])
    return LaserScan(
        stamp_ns=stamp_ns,
        lidar=scan.sensor,
        ranges_m=ranges,
        bearings_rad=bearings,
        beam_offsets_s=np.empty(0),
        range_min_m=0.0,
        range_max_m=range_max_m,
    )
