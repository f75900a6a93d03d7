"""The map that scans are matched against: surface points and likelihood fields of a small area.

What a camera alone saw stands on lower things, and is kept as a surface of its own (the low
layer): a lidar's points are never laid on it, nor its own points on what the lidar saw. The
likelihood fields are of the main layer alone.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.se2 import xyyaw
from frontend import map_kernels, match_kernels, place_search_kernels, search_kernels
from frontend.kernel_types import Bytes, Cloud, Ints
from frontend.prepared import PreparedScan
from frontend.surfels import LIST_CELL_M, Surfels
from fusion.scan import CAMERA_LAYER, LIDAR_LAYER

Mask = npt.NDArray[np.bool_]

CELL_M = 0.05
LEVELS = 6
FACING_BINS = 120
"""Of 3 deg each."""
COARSE_LEVELS = 2
"""Further levels that only the search for places needs; they are made when it first asks."""
BLOB_SIGMA_M = 0.05

NO_POINTS: Final = np.empty((0, 2))
NO_CLOUD: Final[Cloud] = (np.empty((0, 2)), np.empty((0, 2)), np.empty(0))


class Pyramid(NamedTuple):
    """A likelihood pyramid as the search for places takes it; see ``search_places``."""

    field: Bytes
    starts: Ints
    shapes: Ints
    pads: Ints


class Alignment(NamedTuple):
    """What Gauss-Newton came to.

    pose                         : (3,) x, y, yaw in the map's frame.
    information, low_information : (3, 3) of each layer's points, in the map's axes, without prior.
    matched                      : points of the main layer with a partner.
    usable                       : weight that all its points with a normal would have on the map.
    weight, low_weight           : sum of the points' weights in each layer.
    rms_m                        : of the weighted distances in the main layer.
    iterations                   : done; 0 if the system could not be solved.
    """

    pose: Array
    information: Array
    low_information: Array
    matched: int
    usable: float
    weight: float
    low_weight: float
    rms_m: float
    iterations: int


def _blob() -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    offsets = np.arange(-2, 3) * CELL_M
    squared = offsets[:, None] ** 2 + offsets[None, :] ** 2
    return np.round(255.0 * np.exp(-squared / (2.0 * BLOB_SIGMA_M**2))).astype(np.uint8)


def facing_of(normals: Array) -> Array:
    """(FACING_BINS,) histogram of the directions of unit normals (N, 2); sums to 1."""
    out = np.empty(FACING_BINS)
    place_search_kernels.facing(normals, out)
    return out


class LocalMap:
    """Surface points with normals, and a likelihood pyramid, over a window of one frame.

    The frame is the caller's: the odom frame for the map of the front end, an anchor's frame for a
    finished submap. Points outside the window are left out.
    """

    def __init__(self, low_xy_m: Array, high_xy_m: Array) -> None:
        """low_xy_m, high_xy_m : (2,) corners of the window, m."""
        # the kernels keep a margin of a blob and the coarsest window free at each side
        margin_m = CELL_M * (2 + (1 << LEVELS)) + LIST_CELL_M
        self._origin = np.floor((low_xy_m - margin_m) / CELL_M) * CELL_M
        unit = 1 << (LEVELS - 1)
        extent = high_xy_m + margin_m - self._origin
        cols, rows = (math.ceil(float(e) / CELL_M / unit) * unit for e in extent)
        self._shape = (rows, cols)
        sizes = [(rows >> level) * (cols >> level) for level in range(LEVELS)]
        self._starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        self._field = np.zeros(int(self._starts[-1]), dtype=np.uint8)
        lists = [math.ceil(float(e) / LIST_CELL_M) + 1 for e in extent]
        self._list_shape = (lists[1], lists[0])
        self._main = Surfels(*self._list_shape, self._origin)
        self._single: Surfels | None = None  # made when a sparse scan is inserted
        self._low: Surfels | None = None  # made when something low is first seen
        self._blob = _blob()
        self._coarse: Pyramid | None = None
        self._facing: Array | None = None

    @classmethod
    def around(cls, scans: list[tuple[PreparedScan, Array]]) -> Self:
        """A map just large enough for scans at their poses T_frame_base."""
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for scan, T_frame_base in scans:
            if not len(scan.points_base):
                continue
            points = scan.points_base @ T_frame_base[:2, :2].T + T_frame_base[:2, 2]
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        if not np.isfinite(low).all():
            low, high = np.zeros(2), np.zeros(2)
        made = cls(low, high)
        for scan, T_frame_base in scans:
            made.insert(scan, T_frame_base)
        return made

    @property
    def memory_bytes(self) -> int:
        """What the fields and lists take."""
        more = (surfels.memory_bytes for surfels in (self._single, self._low) if surfels)
        return self._field.nbytes + self._main.memory_bytes + sum(more)

    @property
    def has_single(self) -> bool:
        """Whether points without a normal were inserted as well."""
        return self._single is not None

    @property
    def surface_points(self) -> Array:
        """(N, 2) m, in the map's frame: the points of the main layer's surface."""
        return self._main.points

    def insert(self, scan: PreparedScan, T_frame_base: Array, *, single: bool = False) -> None:
        """Add a scan at its pose, each layer to its own.

        single : with the main layer's points that have no normal, to match such points with.
        """
        pose = xyyaw(T_frame_base)
        main = scan.part(LIDAR_LAYER)
        self._main.insert(scan.points_base[main], scan.normals_base[main], pose)
        if single:
            if self._single is None:
                self._single = Surfels(*self._list_shape, self._origin)
            points = scan.single_points
            self._single.insert(points, np.tile([1.0, 0.0], (len(points), 1)), pose)
        if scan.has_low:
            low = scan.part(CAMERA_LAYER)
            if self._low is None:
                self._low = Surfels(*self._list_shape, self._origin)
            self._low.insert(scan.points_base[low], scan.normals_base[low], pose)
        map_kernels.stamp_field(
            scan.points_base[main],
            *pose,
            self._field,
            self._starts,
            self._shape[0],
            self._shape[1],
            self._origin[0],
            self._origin[1],
            CELL_M,
            self._blob,
        )

    def score(self, points_base: Array, T_frame_base: Array) -> float:
        """Mean likelihood under the points at a pose, in 0..1."""
        x, y, yaw = xyyaw(T_frame_base)
        rows, cols = self._shape
        return float(
            map_kernels.field_score(
                points_base,
                x,
                y,
                yaw,
                self._field,
                rows,
                cols,
                self._origin[0],
                self._origin[1],
                CELL_M,
            )
        )

    def search(
        self,
        points_base: Array,
        guess: tuple[float, float, float],
        window_m: float,
        window_rad: float,
        step_rad: float,
        penalty: tuple[float, float],
        min_score: float,
        budget: int,
        avoid: tuple[float, float, float, float, float] | None = None,
    ) -> tuple[bool, float, float, float, float, int]:
        """Branch and bound around a guess (x, y, yaw): see ``search_kernels.branch_and_bound``."""
        rows, cols = self._shape
        found, x, y, yaw, score, scored = search_kernels.branch_and_bound(
            points_base,
            *guess,
            math.ceil(window_m / CELL_M),
            math.ceil(window_rad / step_rad),
            step_rad,
            self._field,
            self._starts,
            rows,
            cols,
            self._origin[0],
            self._origin[1],
            CELL_M,
            *penalty,
            min_score,
            budget,
            *(avoid or (0.0, 0.0, 0.0, -1.0, -1.0)),
        )
        return bool(found), float(x), float(y), float(yaw), float(score), int(scored)

    def search_places(
        self,
        points_base: Array,
        xy_guess: tuple[float, float],
        yaws_rad: Array,
        window_m: float,
        min_score: float,
        budget: int,
        avoid: tuple[float, float, float, float, float] | None = None,
    ) -> tuple[bool, float, float, float, float, int]:
        """Branch and bound over a large window: see ``place_search_kernels.search_places``.

        Nothing may be inserted afterwards.
        """
        if self._coarse is None:
            self._coarse = self._with_coarse_levels()
        found, x, y, yaw, score, scored = place_search_kernels.search_places(
            points_base,
            *xy_guess,
            yaws_rad,
            math.ceil(window_m / CELL_M),
            *self._coarse,
            self._origin[0],
            self._origin[1],
            CELL_M,
            min_score,
            budget,
            *(avoid or (0.0, 0.0, 0.0, -1.0, -1.0)),
        )
        return bool(found), float(x), float(y), float(yaw), float(score), int(scored)

    def near(self, points: Array) -> Mask:
        """(N,) bool, whether a point lies within about two cells of a surface."""
        rows, cols = self._shape
        at = np.floor((points - self._origin) / CELL_M).astype(np.int64)
        inside = ((at >= 0) & (at < (cols, rows))).all(axis=1)
        out = np.zeros(len(points), dtype=np.bool_)
        out[inside] = self._field[at[inside, 1] * cols + at[inside, 0]] > 0
        return out

    @property
    def facing(self) -> Array:
        """(FACING_BINS,) histogram of the directions that the main layer's surfaces face."""
        if self._facing is None:
            self._facing = facing_of(self._main.normals)
        return self._facing

    def _with_coarse_levels(self) -> Pyramid:
        """The likelihood pyramid with COARSE_LEVELS more."""
        rows, cols = self._shape
        shapes = [(rows >> level, cols >> level) for level in range(LEVELS)]
        finer = self._field[self._starts[LEVELS - 1] :].reshape(shapes[-1])
        parts = [self._field]
        for level in range(COARSE_LEVELS):
            shape = ((finer.shape[0] + 1) // 2 + 1, (finer.shape[1] + 1) // 2 + 1)
            coarser = np.empty(shape, dtype=np.uint8)
            place_search_kernels.pooled(finer, *finer.shape, level > 0, coarser)
            shapes.append(shape)
            parts.append(coarser.ravel())
            finer = coarser
        sizes = [r * c for r, c in shapes]
        starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
        pads = np.array([0] * LEVELS + [1] * COARSE_LEVELS, dtype=np.int64)
        field = np.concatenate(parts)
        self._field = field[: self._field.size]  # not held twice
        return Pyramid(field, starts, np.array(shapes, dtype=np.int64), pads)

    def align(
        self,
        cloud: Cloud,
        low_cloud: Cloud,
        single_points: Array,
        common: Array,
        start: Array,
        expected: Array,
        prior: Array,
        robust_m: tuple[float, float],
        sigma_m: float,
        iterations: int,
    ) -> Alignment:
        """Gauss-Newton on the surfaces of both layers: see ``match_kernels.imls_match``."""
        pose, information, low_information = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        matched, usable, weight, low_weight, rms_m, done = match_kernels.imls_match(
            cloud,
            self._main.arrays,
            NO_CLOUD if self._low is None else low_cloud,
            (self._low or self._main).arrays,
            NO_POINTS if self._single is None else single_points,
            (self._single or self._main).arrays,
            common,
            start,
            expected,
            prior,
            self._origin[0],
            self._origin[1],
            LIST_CELL_M,
            LIST_CELL_M,
            robust_m[0],
            robust_m[1],
            sigma_m,
            iterations,
            pose,
            information,
            low_information,
        )
        return Alignment(
            pose, information, low_information, matched, usable, weight, low_weight, rms_m, done
        )
