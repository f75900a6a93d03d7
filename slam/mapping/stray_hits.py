"""Hits that a lidar's noise has put behind a wall, where no ray ever comes to free them again.

At 12 m a range is off by 4 cm, and one hit in some hundred lies a decimetre too far. Before the
wall it is undone by the rays that pass there; behind it, at a corner or in a niche, it would stay.
"""

from __future__ import annotations

import numpy as np

from datasets.messages import Array
from datasets.trajectory import Trajectory
from slam.mapping.occupancy import MapConfig, OccupancyGrid
from slam.mapping.scan_store import ScanStore

FAR_M = 5.0
"""From here on a range may be off by more than a cell: two standard deviations of a usual lidar."""
REACH_M = 0.3
"""So far behind a surface a hit may lie that is of it."""
TIMES = 10.0
"""A cell explains the hits behind it that has so many times as many."""


def without_strays(
    scans: ScanStore, T_map_base: Trajectory, config: MapConfig, grid: OccupancyGrid
) -> OccupancyGrid:
    """The grid without the hits of cells that have none but far ones a surer cell explains.

    scans : those that the grid was drawn from. Its hits are changed where they stand, for a large
    map has no room to spare; the passes stay as they are.
    """
    # numba costs 0.2 s; commands that only read a folder do without it.
    from slam.mapping import occupancy_kernels  # noqa: PLC0415

    xyyaw: Array = np.ascontiguousarray(T_map_base.at(scans.stamps_ns))
    stray, sound = np.zeros(grid.shape, np.uint8), np.zeros(grid.shape, np.uint8)
    occupancy_kernels.mark_strays(
        scans.points_base,
        scans.offsets,
        scans.sensor_index,
        scans.origins_base,
        xyyaw,
        scans.roles,
        *grid.corner_map_m,
        grid.resolution_m,
        config.max_range_m,
        FAR_M,
        REACH_M,
        TIMES,
        grid.hits,
        stray,
        sound,
    )
    stray &= sound == 0
    np.multiply(grid.hits, stray == 0, out=grid.hits)
    return grid
