"""An occupancy grid: what the scans say of each cell, drawn at their final poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from datasets.messages import Array
from datasets.section import Section
from datasets.trajectory import Trajectory
from slam.mapping.scan_store import ScanStore

Classes = npt.NDArray[np.uint8]
Probabilities = npt.NDArray[np.float32]

UNKNOWN, FREE, OCCUPIED = 0, 1, 2

MARGIN_M = 0.05
"""How far before a hit free space ends (one cell at least): the noise of ranges and poses."""
ALL_ROWS = slice(None)
BLOCK_ROWS = 256
BORDER_CELLS = 10
"""Unknown cells left around everything seen."""
MAX_CELLS = 40_000_000
"""316 m squared at 5 cm, 480 MB while drawing; what is larger is drawn in coarser cells.
Several layers share it."""


class MapConfig(Section):
    """How the map is drawn."""

    resolution_m: float = Field(0.05, ge=0.005, le=1.0, description="side of a cell")
    max_range_m: float = Field(
        30.0, gt=0.0, le=1000.0, description="longer beams free the way so far, and hit nothing"
    )
    hit_weight: float = Field(
        3.0, ge=0.1, le=100.0, description="passes of a cell that undo one hit in it"
    )
    camera_memory: float = Field(
        30.0,
        ge=1.0,
        le=1e6,
        description="votes that a cell keeps of the cameras: a third of it in views that look "
        "through a thing undo it, however long it was seen",
    )
    occupied_threshold: float = Field(0.65, ge=0.0, le=1.0, description="occupied from here up")
    free_threshold: float = Field(0.196, ge=0.0, le=1.0, description="free below")

    @model_validator(mode="after")
    def _ordered(self) -> MapConfig:
        if self.free_threshold > self.occupied_threshold:
            raise ValueError("free_threshold must not exceed occupied_threshold")
        return self


class Raster(Protocol):
    """Cells of three classes on a plane: what can be written as a map and drawn as a picture."""

    @property
    def corner_map_m(self) -> tuple[float, float]:
        """(x, y), m, map frame, of the lower left corner of cell [0, 0]."""

    @property
    def resolution_m(self) -> float:
        """The side of a cell."""

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in cells."""

    def classes(self, config: MapConfig) -> Classes:
        """(height, width) of UNKNOWN, FREE, OCCUPIED; row 0 lies at the smallest y."""


@dataclass(frozen=True, slots=True)
class Extent:
    """Where the cells of a map lie. Maps of one extent can be laid on each other cell by cell."""

    corner_map_m: tuple[float, float]
    resolution_m: float
    shape: tuple[int, int]


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """Votes of the scans for every cell.

    corner_map_m : (x, y), m, map frame, of the lower left corner of cell [0, 0].
    hits, passes : (height, width) float32, scans that saw something in the cell, or through it,
                   as far as they are remembered; row 0 lies at the smallest y.
    """

    corner_map_m: tuple[float, float]
    resolution_m: float
    hits: npt.NDArray[np.float32]
    passes: npt.NDArray[np.float32]

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in cells."""
        height, width = self.hits.shape
        return height, width

    def probability(self, hit_weight: float, rows: slice = ALL_ROWS) -> Probabilities:
        """(rows, width) float32, the share of the votes that are hits; NaN where none fell."""
        weighted = np.multiply(self.hits[rows], hit_weight, dtype=np.float32)
        votes = np.add(weighted, self.passes[rows], dtype=np.float32)
        out = np.full(votes.shape, np.nan, np.float32)
        np.divide(weighted, votes, out=out, where=votes > 0)
        return out

    def classes(self, config: MapConfig) -> Classes:
        """(height, width) of UNKNOWN, FREE, OCCUPIED; between the thresholds is UNKNOWN."""
        out = np.empty(self.shape, np.uint8)
        for rows in blocks_of(self.shape[0]):
            out[rows] = classes_of(self.probability(config.hit_weight, rows), config)
        return out


def blocks_of(height: int) -> Iterator[slice]:
    """The rows of a grid, some at a time, so that what is computed of them needs little memory."""
    for first in range(0, height, BLOCK_ROWS):
        yield slice(first, min(first + BLOCK_ROWS, height))


def classes_of(probability: Probabilities, config: MapConfig) -> Classes:
    """UNKNOWN, FREE or OCCUPIED by the thresholds; UNKNOWN between them and where it is NaN."""
    out = np.full(probability.shape, UNKNOWN, np.uint8)
    out[probability >= config.occupied_threshold] = OCCUPIED
    out[probability < config.free_threshold] = FREE
    return out


def occupied_cells(grid: Raster, classes: Classes) -> Array:
    """(N, 2) m, map frame, the centres of the occupied cells, row by row.

    classes : those of the grid; whoever has them needn't have them made again.
    """
    rows, columns = np.nonzero(classes == OCCUPIED)
    cells = np.column_stack([columns, rows]).astype(np.float64) + 0.5
    centres: Array = cells * grid.resolution_m + np.array(grid.corner_map_m)
    return centres


def extent_of(scans: ScanStore, T_map_base: Trajectory, config: MapConfig) -> Extent:
    """The cells that hold every sensor and every point within ``max_range_m``, and a border.

    A single far return makes it larger by that range at most. Where it would still exceed
    ``MAX_CELLS`` in all layers together (a trajectory that ran away), cells are doubled in size
    until it fits.

    Raises ValueError if there is no scan.
    """
    # numba costs 0.2 s; commands that only read a folder do without it.
    from slam.mapping import occupancy_kernels  # noqa: PLC0415

    if not len(scans):
        raise ValueError("no scans to draw")
    x_min, y_min, x_max, y_max = occupancy_kernels.extent(
        *_rays(scans, T_map_base), config.max_range_m
    )
    resolution_m = config.resolution_m
    while True:
        # Corners on multiples of the cell's side: two maps of one place overlay exactly.
        left, right = (math.floor(x / resolution_m) for x in (x_min, x_max))
        low, high = (math.floor(y / resolution_m) for y in (y_min, y_max))
        width, height = (b - a + 1 + 2 * BORDER_CELLS for a, b in ((left, right), (low, high)))
        if width * height * len(scans.layer_names) <= MAX_CELLS:
            break
        resolution_m *= 2.0
    corner = tuple(round((k - BORDER_CELLS) * resolution_m, 9) for k in (left, low))
    return Extent((corner[0], corner[1]), resolution_m, (height, width))


def draw_grid(
    scans: ScanStore,
    T_map_base: Trajectory,
    config: MapConfig,
    extent: Extent | None = None,
    memory: float = math.inf,
) -> OccupancyGrid:
    """Draw scans at the poses a trajectory gives for their stamps, whatever their layers.

    extent : where; None for what ``extent_of`` finds, or a larger one.
    memory : votes that a cell keeps. Beyond it each new vote takes the place of an old one that
             said the opposite, so that the order of the scans counts.

    Serial and deterministic. Raises ValueError if there is no scan.
    """
    from slam.mapping import occupancy_kernels  # noqa: PLC0415

    where = extent or extent_of(scans, T_map_base, config)
    hits, passes = np.zeros(where.shape, np.float32), np.zeros(where.shape, np.float32)
    occupancy_kernels.count(
        *_rays(scans, T_map_base),
        scans.roles,
        scans.clear_from_m,
        *where.corner_map_m,
        where.resolution_m,
        config.max_range_m,
        max(1.0, MARGIN_M / where.resolution_m),
        config.hit_weight,
        memory,
        hits,
        passes,
    )
    return OccupancyGrid(where.corner_map_m, where.resolution_m, hits, passes)


def _rays(scans: ScanStore, T_map_base: Trajectory) -> tuple[npt.NDArray[np.generic], ...]:
    """What the kernels begin with: points, offsets, sensors, their origins, poses."""
    xyyaw = np.ascontiguousarray(T_map_base.at(scans.stamps_ns))
    return scans.points_base, scans.offsets, scans.sensor_index, scans.origins_base, xyyaw
