"""Which way the walls run, and turning a trajectory so that they run along the axes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from datasets.se2 import se2
from datasets.trajectory import Trajectory
from slam.mapping.scan_store import SURFACE, ScanStore

CELL_M = 0.05
"""Hits are averaged in cells of this size: a place counts once however long one stood there."""
QUARTER_RAD = math.pi / 2


@dataclass(frozen=True, slots=True)
class WallDirection:
    """The direction, modulo 90 degrees, that most walls run along.

    yaw_rad  : in (-pi/4, pi/4], counter-clockwise from the map's x axis.
    contrast : how much sharper the walls stand out there than at a typical angle: about 1 in a
               round room or a garbled map, 1.5 and more in a building with straight walls.
    """

    yaw_rad: float
    contrast: float


def map_points(scans: ScanStore, T_map_base: Trajectory, max_range_m: float) -> Array:
    """Places hit, (P, 2) float64, map frame, m: the mean of the hits in each cell that has any.

    Those of all layers: what stands low stands along the walls, too.
    """
    of_scan = np.repeat(np.arange(len(scans)), np.diff(scans.offsets))
    points_base = scans.points_base.astype(np.float64)
    away = points_base - scans.origins_base[scans.sensor_index[of_scan]]
    near = ((away**2).sum(axis=1) <= max_range_m**2) & (scans.roles <= SURFACE)
    points_base, of_scan = points_base[near], of_scan[near]
    x, y, yaw = T_map_base.at(scans.stamps_ns).T
    c, s = np.cos(yaw)[of_scan], np.sin(yaw)[of_scan]
    px, py = points_base.T
    points_map = np.column_stack([x[of_scan] + c * px - s * py, y[of_scan] + s * px + c * py])
    cells = np.floor(points_map / CELL_M).astype(np.int64)
    _, cell_of, counts = np.unique(
        cells @ np.array([1 << 31, 1]), return_inverse=True, return_counts=True
    )
    sums = [np.bincount(cell_of, points_map[:, k], counts.size) for k in (0, 1)]
    return np.column_stack(sums) / counts[:, None]


def find_wall_direction(points_map: Array) -> WallDirection | None:
    """Find the angle at which points, projected on two square axes, fall into the fewest lines.

    points_map : (P, 2) float64, m, finite. The sharpness of an angle is the sum of the squared
    histograms of both projections: a long wall adds to it with the square of its length. Coarse
    search with wide bins over all 90 degrees, then 0.02 degree steps with narrow ones, then a
    parabola through the peak. None if there are fewer than two points. O(P * 300).
    """
    if len(points_map) < 2:
        return None
    centred = points_map - points_map.mean(axis=0)
    coarse = np.deg2rad(np.arange(-45.0, 45.0, 0.5))
    scores = np.array([_sharpness(centred, angle, 0.10) for angle in coarse])
    best = coarse[int(scores.argmax())]
    contrast = float(scores.max() / np.median(scores))

    step = math.radians(0.02)
    fine = best + step * np.arange(-35, 36)
    scores = np.array([_sharpness(centred, angle, 0.03) for angle in fine])
    # A few steps' running mean: bins are met in jumps, the peak itself is wider.
    smooth = np.convolve(scores, np.ones(5) / 5, mode="valid")
    peak = int(np.clip(smooth.argmax(), 1, smooth.size - 2))
    before, at, after = smooth[peak - 1 : peak + 2]
    bend = before - 2 * at + after
    shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    yaw = float(fine[peak + 2]) + step * float(np.clip(shift, -1.0, 1.0))
    return WallDirection(_within_quarter(yaw), contrast)


def turned(T_map_base: Trajectory, angle_rad: float) -> Trajectory:
    """The trajectory seen from a map frame that is turned about its origin by ``angle_rad``."""
    T_turned_map = se2(0.0, 0.0, -angle_rad)
    xy = T_map_base.xyyaw[:, :2] @ T_turned_map[:2, :2].T
    return Trajectory(
        T_map_base.stamps_ns, np.column_stack([xy, T_map_base.xyyaw[:, 2] - angle_rad])
    )


def _sharpness(points: Array, angle_rad: float, bin_m: float) -> float:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    total = 0.0
    for axis in (np.array([c, s]), np.array([-s, c])):
        along = points @ axis / bin_m
        along -= along.min()
        # Each point is shared between two bins, so that the score has no steps.
        low = along.astype(np.int64)
        share = along - low
        histogram = np.bincount(low, 1.0 - share, int(along.max()) + 2)
        histogram += np.bincount(low + 1, share, histogram.size)
        total += float(histogram @ histogram)
    return total


def _within_quarter(angle_rad: float) -> float:
    """The angle modulo 90 degrees, in (-45, 45]."""
    return angle_rad - QUARTER_RAD * math.ceil(angle_rad / QUARTER_RAD - 0.5)
