"""The map that scans are matched against: surface points and likelihood fields of a small area.

What a camera alone saw stands on lower things, and is kept as a surface of its own (the low
layer): a lidar's points are never laid on it, nor its own points on what the lidar saw. The
likelihood fields are of the main layer alone.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Self

import numpy as np

from datasets.messages import Array
from datasets.se2 import xyyaw
from frontend import map_kernels, match_kernels, search_kernels
from frontend.kernel_types import Cloud
from frontend.prepared import PreparedScan
from frontend.surfels import LIST_CELL_M, Surfels
from fusion.scan import CAMERA_LAYER, LIDAR_LAYER

CELL_M = 0.05
LEVELS = 6
BLOB_SIGMA_M = 0.05

NO_CLOUD: Final[Cloud] = (np.empty((0, 2)), np.empty((0, 2)), np.empty(0))


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
        self._low: Surfels | None = None  # made when something low is first seen
        self._blob = _blob()

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
        low_bytes = self._low.memory_bytes if self._low else 0
        return self._field.nbytes + self._main.memory_bytes + low_bytes

    @property
    def surface_points(self) -> Array:
        """(N, 2) m, in the map's frame: the points of the main layer's surface."""
        return self._main.points

    def insert(self, scan: PreparedScan, T_frame_base: Array) -> None:
        """Add a scan at its pose, each layer to its own."""
        pose = xyyaw(T_frame_base)
        main = scan.part(LIDAR_LAYER)
        self._main.insert(scan.points_base[main], scan.normals_base[main], pose)
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

    def align(
        self,
        cloud: Cloud,
        low_cloud: Cloud,
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
