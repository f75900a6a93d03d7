"""The occupancy grid, drawn from all scans at the final poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from datasets.messages import Array
from datasets.section import Section
from datasets.trajectory import Stamps, Trajectory

UNKNOWN, FREE, OCCUPIED = 0, 1, 2

MARGIN_M = 0.05
"""How far before a hit free space ends (one cell at least): the noise of ranges and poses."""
BORDER_CELLS = 10
"""Unknown cells left around everything seen."""
MAX_CELLS = 40_000_000
"""316 m squared at 5 cm, 480 MB while drawing; what is larger is drawn in coarser cells."""


class MapConfig(Section):
    """How the map is drawn."""

    resolution_m: float = Field(0.05, ge=0.005, le=1.0, description="side of a cell")
    max_range_m: float = Field(
        30.0, gt=0.0, le=1000.0, description="longer beams free the way so far, and hit nothing"
    )
    hit_weight: float = Field(
        3.0, ge=0.1, le=100.0, description="passes of a cell that undo one hit in it"
    )
    occupied_threshold: float = Field(0.65, ge=0.0, le=1.0, description="occupied from here up")
    free_threshold: float = Field(0.196, ge=0.0, le=1.0, description="free below")

    @model_validator(mode="after")
    def _ordered(self) -> MapConfig:
        if self.free_threshold > self.occupied_threshold:
            raise ValueError("free_threshold must not exceed occupied_threshold")
        return self


@dataclass(frozen=True, slots=True)
class ScanStore:
    """All scans of a run, compact: what the map can be drawn from without the recording.

    stamps_ns    : (N,) int64, not decreasing (two lidars may share a stamp).
    lidar_index  : (N,) int64, rows of ``lidars`` and ``origins_base``.
    offsets      : (N + 1,) int64; scan i owns rows offsets[i]:offsets[i + 1] of the points.
    points_base  : (M, 2) float32, m, hits in order of the beams, de-skewed, base frame of the
                   scan's stamp, finite.
    lidars       : names; several lidars have several origins.
    origins_base : (K, 2) float64, m, the sensors' places in the base frame.

    Raises ValueError if shapes or dtypes disagree or a number is not finite.
    """

    stamps_ns: Stamps
    lidar_index: npt.NDArray[np.int64]
    offsets: npt.NDArray[np.int64]
    points_base: npt.NDArray[np.float32]
    lidars: tuple[str, ...]
    origins_base: Array

    def __post_init__(self) -> None:
        n = self.stamps_ns.size
        for name, dtype, shape in (
            ("stamps_ns", np.int64, (n,)),
            ("lidar_index", np.int64, (n,)),
            ("offsets", np.int64, (n + 1,)),
            ("points_base", np.float32, (len(self.points_base), 2)),
            ("origins_base", np.float64, (len(self.lidars), 2)),
        ):
            array = getattr(self, name)
            if array.dtype != dtype or array.shape != shape:
                raise ValueError(f"{name} is {array.dtype} {array.shape}, not {dtype} {shape}")
        steps = np.diff(self.offsets)
        if self.offsets[0] != 0 or self.offsets[-1] != len(self.points_base) or (steps < 0).any():
            raise ValueError("offsets must rise from 0 to the number of points")
        if n and not 0 <= self.lidar_index.min() <= self.lidar_index.max() < len(self.lidars):
            raise ValueError("lidar_index names a lidar that is not there")
        if (np.diff(self.stamps_ns) < 0).any():
            raise ValueError("stamps_ns must not decrease")
        if not (np.isfinite(self.points_base).all() and np.isfinite(self.origins_base).all()):
            raise ValueError("points and origins must be finite")

    def __len__(self) -> int:
        return int(self.stamps_ns.size)

    @classmethod
    def from_scans(
        cls,
        stamps_ns: Sequence[int],
        lidars: Sequence[str],
        points_base: Sequence[npt.NDArray[np.floating]],
        origins_base: Mapping[str, npt.ArrayLike],
    ) -> ScanStore:
        """One entry a scan: its stamp, its lidar, its (n, 2) hits; and each lidar's origin (2,)."""
        names = tuple(sorted(origins_base))
        counts = [len(points) for points in points_base]
        flat = [np.asarray(points, np.float32).reshape(-1, 2) for points in points_base]
        return cls(
            stamps_ns=np.asarray(stamps_ns, np.int64),
            lidar_index=np.asarray([names.index(name) for name in lidars], np.int64),
            offsets=np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).astype(np.int64),
            points_base=np.concatenate([np.empty((0, 2), np.float32), *flat]),
            lidars=names,
            origins_base=np.array([origins_base[name] for name in names]).reshape(-1, 2) * 1.0,
        )


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """Votes of the scans for every cell.

    corner_map_m : (x, y), m, map frame, of the lower left corner of cell [0, 0].
    hits, passes : (height, width) int32, scans that saw something in the cell, or through it;
                   row 0 lies at the smallest y.
    """

    corner_map_m: tuple[float, float]
    resolution_m: float
    hits: npt.NDArray[np.int32]
    passes: npt.NDArray[np.int32]

    def probability(self, hit_weight: float) -> npt.NDArray[np.float32]:
        """(height, width) float32, the share of the votes that are hits; NaN where none fell."""
        weighted = np.multiply(self.hits, hit_weight, dtype=np.float32)
        votes = np.add(weighted, self.passes, dtype=np.float32)
        out = np.full(votes.shape, np.nan, np.float32)
        np.divide(weighted, votes, out=out, where=votes > 0)
        return out

    def classes(self, config: MapConfig) -> npt.NDArray[np.uint8]:
        """(height, width) of UNKNOWN, FREE, OCCUPIED; between the thresholds is UNKNOWN."""
        probability = self.probability(config.hit_weight)
        out = np.full(probability.shape, UNKNOWN, np.uint8)
        out[probability >= config.occupied_threshold] = OCCUPIED
        out[probability < config.free_threshold] = FREE
        return out


def draw_grid(scans: ScanStore, T_map_base: Trajectory, config: MapConfig) -> OccupancyGrid:
    """Draw scans at the poses a trajectory gives for their stamps. Serial and deterministic.

    The grid holds every sensor and every hit within ``max_range_m``, and a border: a single far
    return makes it larger by that range at most. Where it would still exceed ``MAX_CELLS`` (a
    trajectory that ran away), cells are doubled in size until it fits; the result's
    ``resolution_m`` tells. A layer of one kind of sensor is drawn by giving its scans only.

    Raises ValueError if there is no scan.
    """
    # numba costs 0.2 s; commands that only read a folder do without it.
    from slam import _kernels  # noqa: PLC0415

    if not len(scans):
        raise ValueError("no scans to draw")
    xyyaw = np.ascontiguousarray(T_map_base.at(scans.stamps_ns))
    beams = (scans.points_base, scans.offsets, scans.lidar_index, scans.origins_base, xyyaw)
    x_min, y_min, x_max, y_max = _kernels.extent(*beams, config.max_range_m)

    resolution_m = config.resolution_m
    while True:
        # Corners on multiples of the cell's side: two maps of one place overlay exactly.
        left, right = (math.floor(x / resolution_m) for x in (x_min, x_max))
        low, high = (math.floor(y / resolution_m) for y in (y_min, y_max))
        width, height = (b - a + 1 + 2 * BORDER_CELLS for a, b in ((left, right), (low, high)))
        if width * height <= MAX_CELLS:
            break
        resolution_m *= 2.0
    corner = tuple(round((k - BORDER_CELLS) * resolution_m, 9) for k in (left, low))
    hits = np.zeros((height, width), np.int32)
    passes = np.zeros((height, width), np.int32)
    margin_cells = max(1.0, MARGIN_M / resolution_m)
    _kernels.count(*beams, *corner, resolution_m, config.max_range_m, margin_cells, hits, passes)
    return OccupancyGrid((corner[0], corner[1]), resolution_m, hits, passes)
