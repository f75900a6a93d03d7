"""The surface of one layer of a local map: points with normals, in a grid of linked lists."""

from __future__ import annotations

import numpy as np

from frontend import map_kernels
from frontend.kernel_types import Floats, Surface

LIST_CELL_M = 0.2
MERGE_M = 0.03


class Surfels:
    """Surface points of a window, averaged where they meet."""

    def __init__(self, rows: int, cols: int, origin: Floats) -> None:
        """rows, cols : list cells of the window; origin : (2,) m, its lower corner."""
        self._origin = origin
        self._head = np.full((rows, cols), -1, dtype=np.int32)
        self._points = np.empty((2048, 2))
        self._normals = np.empty((2048, 2))
        self._weights = np.empty(2048)
        self._following = np.empty(2048, dtype=np.int32)
        self._count = 0

    @property
    def arrays(self) -> Surface:
        """As the kernels take it."""
        return self._points, self._normals, self._weights, self._following, self._head

    @property
    def points(self) -> Floats:
        """(N, 2) m, a view."""
        return self._points[: self._count]

    @property
    def memory_bytes(self) -> int:
        """What the lists and points take."""
        return self._head.nbytes + self._points.nbytes * 3

    @property
    def normals(self) -> Floats:
        """(N, 2) unit normals of the points."""
        return self._normals[: self._count]

    def insert(self, points: Floats, normals: Floats, pose: tuple[float, float, float]) -> None:
        """Add points that have a normal, at a pose (x, y, yaw)."""
        self._grow(self._count + len(points))
        self._count = map_kernels.insert_points(
            points,
            normals,
            *pose,
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
