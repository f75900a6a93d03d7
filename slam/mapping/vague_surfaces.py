"""Surfaces that a camera saw from too far to say where: kept only if nothing surer explains them.

The depth of a stereo camera is off by a decimetre at 4 m, in slow waves that stay from view to
view: of a wall at that distance it makes a second one. What a lidar, or the same camera from
nearer, saw on the same ray is that wall; what nobody else saw is better kept than lost.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.trajectory import Trajectory
from slam.mapping.occupancy import Extent
from slam.mapping.scan_store import VAGUE, ScanStore

REACH_M = 0.2
"""So far before and behind a vague surface a surer one explains it: two or three standard
deviations of its range. With 0.4 m the far sides of tables and boxes went with the walls behind
them, with less walls came back a second time."""


def without_explained(
    scans: ScanStore, T_map_base: Trajectory, extent: Extent, occupied: npt.NDArray[np.bool_]
) -> ScanStore:
    """Leave out the vague points near which an occupied cell lies on their ray.

    occupied : (height, width) on the cells of ``extent``, by all but the vague points.
    """
    vague = scans.roles == VAGUE
    of_scan = np.repeat(np.arange(len(scans)), np.diff(scans.offsets))[vague]
    points_base = scans.points_base[vague].astype(np.float64)
    origins_base = scans.origins_base[scans.sensor_index[of_scan]]
    away = points_base - origins_base
    rays_base = away / np.maximum(np.hypot(*away.T), 1e-9)[:, None]
    rows = T_map_base.at(scans.stamps_ns)[of_scan]
    points_map = rows[:, :2] + _turned(points_base, rows[:, 2])
    rays_map = _turned(rays_base, rows[:, 2])
    explained = np.zeros(len(points_map), dtype=np.bool_)
    height, width = extent.shape
    steps = int(np.ceil(2.0 * REACH_M / extent.resolution_m))
    for along_m in np.linspace(-REACH_M, REACH_M, 2 * steps + 1):
        cells = (points_map + along_m * rays_map - extent.corner_map_m) / extent.resolution_m
        column, row = np.floor(cells).astype(np.int64).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        explained[inside] |= occupied[row[inside], column[inside]]
    kept = np.ones(len(scans.roles), dtype=np.bool_)
    kept[vague] = ~explained
    return scans.with_points(kept)


def _turned(vectors: Array, yaw_rad: Array) -> Array:
    """Vectors (N, 2), each turned by its own angle (N,)."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y = vectors.T
    return np.column_stack([c * x - s * y, s * x + c * y])
