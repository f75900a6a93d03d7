"""Corridors of known shape, as a lidar and a sensor below it see them without errors."""

from __future__ import annotations

import math

import numpy as np

from datasets.messages import Array, LaserScan
from datasets.recording import LidarCalibration
from fusion.lidar_only import BeamLimits, LidarProjection
from fusion.pseudo_scan import PseudoScan
from fusion.sweep import Sweep

Segments = list[tuple[tuple[float, float], tuple[float, float]]]

WALLS: Segments = [
    ((-10.0, -1.2), (10.0, -1.2)),
    ((10.0, -1.2), (10.0, 1.2)),
    ((10.0, 1.2), (-10.0, 1.2)),
    ((-10.0, 1.2), (-10.0, -1.2)),
]


def box(x: float, y: float, length: float, width: float) -> Segments:
    """The sides of a box whose least corner is (x, y)."""
    corners = [(x, y), (x + length, y), (x + length, y + width), (x, y + width)]
    return [(corners[i], corners[(i + 1) % 4]) for i in range(4)]


def cast(segments: Segments, origin: Array, bearings: Array) -> Array:
    """Distance (N,) along each bearing to the first segment; inf where there is none."""
    ux, uy = np.cos(bearings), np.sin(bearings)
    nearest = np.full(bearings.shape, np.inf)
    for (ax, ay), (bx, by) in segments:
        dx, dy, wx, wy = bx - ax, by - ay, ax - origin[0], ay - origin[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = ux * dy - uy * dx
            along, share = (wx * dy - wy * dx) / cross, (wx * uy - wy * ux) / cross
        hit = (along > 0.0) & (share >= 0.0) & (share <= 1.0) & (along < nearest)
        nearest[hit] = along[hit]
    return nearest


def clockwise(count: int = 1286) -> Array:
    """Bearings of a turning lidar, the first one backwards."""
    bearings: Array = math.pi - np.arange(count) * 2.0 * math.pi / count
    return bearings


def sweep_of(
    ranges_m: Array,
    bearings_rad: Array,
    offsets_s: Array | None = None,
    place: tuple[float, float] = (0.0, 0.0),
    limits: BeamLimits | None = None,
) -> Sweep:
    T = np.eye(4)
    T[:2, 3] = place
    times = np.empty(0) if offsets_s is None else offsets_s
    scan = LaserScan(1_000_000_000, "lidar", ranges_m, bearings_rad, times, 0.1, 30.0)
    return LidarProjection(LidarCalibration(T), limits or BeamLimits()).sweep(scan)


def pseudo_of(
    bearings_rad: Array,
    ranges_m: Array,
    sigma_m: Array | float,
    place: tuple[float, float] = (0.15, 0.0),
    spacing_rad: float = 0.005,
) -> PseudoScan:
    hit = np.isfinite(ranges_m)
    return PseudoScan(
        stamp_ns=1_000_000_000,
        sensor="camera",
        origin_base=np.array(place),
        bearings_rad=bearings_rad,
        ranges_m=ranges_m,
        sigma_m=np.where(hit, sigma_m, np.nan),
        free_from_m=0.3,
        free_to_m=np.where(hit, ranges_m, 0.0),
        surfaces_base=np.empty((0, 2), dtype=np.float32),
        spacing_rad=spacing_rad,
    )


def stereo_sigma_m(ranges_m: Array) -> Array:
    """What a D435 at 640 x 480 errs by, one sigma: z^2 0.08 / (f B)."""
    sigma: Array = ranges_m**2 * 0.08 / (384.0 * 0.05)
    return sigma
