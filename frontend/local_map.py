"""The map that scans are matched against: surface points and likelihood fields of a small area."""

from __future__ import annotations

import math
from typing import Self

import numpy as np

from datasets.messages import Array
from datasets.se2 import xyyaw
from frontend import map_kernels, match_kernels, search_kernels
from frontend.prepared import PreparedScan

CELL_M = 0.05
LIST_CELL_M = 0.2
LEVELS = 6
MERGE_M = 0.03
BLOB_SIGMA_M = 0.05


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
        self._head = np.full((lists[1], lists[0]), -1, dtype=np.int32)
        self._points = np.empty((2048, 2))
        self._normals = np.empty((2048, 2))
        self._weights = np.empty(2048)
        self._following = np.empty(2048, dtype=np.int32)
        self._count = 0
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
        return self._field.nbytes + self._head.nbytes + self._points.nbytes * 3

    def insert(self, scan: PreparedScan, T_frame_base: Array) -> None:
        """Add a scan at its pose."""
        x, y, yaw = xyyaw(T_frame_base)
        self._grow(self._count + len(scan.points_base))
        self._count = map_kernels.insert_points(
            scan.points_base,
            scan.normals_base,
            x,
            y,
            yaw,
            self._points,
            self._normals,
            self._weights,
            self._following,
            self._count,
            self._head,
            self._origin[0],
            self._origin[1],
            LIST_CELL_M,
            MERGE_M,
        )
        map_kernels.stamp_field(
            scan.points_base,
            x,
            y,
            yaw,
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
        points_base: Array,
        normals_base: Array,
        start: Array,
        expected: Array,
        prior: Array,
        robust_m: tuple[float, float],
        sigma_m: float,
        iterations: int,
    ) -> tuple[Array, Array, int, float, float, int]:
        """Gauss-Newton on the surface: see ``match_kernels.imls_match``.

        Returns (x y yaw (3,), information (3, 3) of the data in the map's axes, points matched,
        sum of weights, rms m, iterations done).
        """
        pose, information = np.zeros(3), np.zeros((3, 3))
        matched, weight, rms_m, done = match_kernels.imls_match(
            points_base,
            normals_base,
            start,
            expected,
            prior,
            self._points,
            self._normals,
            self._weights,
            self._following,
            self._head,
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
        )
        return pose, information, int(matched), float(weight), float(rms_m), int(done)

    def _grow(self, wanted: int) -> None:
        size = len(self._points)
        if wanted <= size:
            return
        size = max(wanted, 2 * size)
        for name in ("_points", "_normals", "_weights", "_following"):
            old = getattr(self, name)
            new = np.empty((size, *old.shape[1:]), dtype=old.dtype)
            new[: self._count] = old[: self._count]
            setattr(self, name, new)
