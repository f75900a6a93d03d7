"""Likelihood pyramids by their definition, to test the kernels that fill and search them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from frontend import map_kernels, search_kernels

Bytes = npt.NDArray[np.uint8]
CELL_M = 0.05
LEVELS = 4
HALF_BLOB = 2
MARGIN = HALF_BLOB + (1 << LEVELS)
"""Cells at each side that the kernels keep free."""


def blob() -> Bytes:
    """Likelihood around a point, a cell as its standard deviation."""
    squared = np.arange(-HALF_BLOB, HALF_BLOB + 1) ** 2
    return np.round(255.0 * np.exp(-(squared[:, None] + squared) / 2.0)).astype(np.uint8)


@dataclass
class Pyramid:
    """All levels over rows x cols cells from an origin."""

    flat: Bytes
    starts: npt.NDArray[np.int64]
    rows: int
    cols: int
    origin: tuple[float, float]

    @classmethod
    def empty(cls, rows: int, cols: int, origin: tuple[float, float]) -> Pyramid:
        sizes = [(rows >> level) * (cols >> level) for level in range(LEVELS)]
        starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        return cls(np.zeros(int(starts[-1]), dtype=np.uint8), starts, rows, cols, origin)

    @classmethod
    def over(cls, level0: Bytes, origin: tuple[float, float]) -> Pyramid:
        """With each level by its definition: the most in (2^(L+1))^2 cells from the corner on."""
        made = cls.empty(*level0.shape, origin)
        for level in range(LEVELS):
            made.level(level)[:] = maxima(level0, level)
        return made

    def level(self, level: int) -> Bytes:
        first, last = self.starts[level], self.starts[level + 1]
        return self.flat[first:last].reshape(self.rows >> level, self.cols >> level)

    def stamp(self, points: Array, pose: tuple[float, float, float]) -> None:
        map_kernels.stamp_field(
            points,
            *pose,
            self.flat,
            self.starts,
            self.rows,
            self.cols,
            *self.origin,
            CELL_M,
            blob(),
        )

    def score(self, points: Array, pose: tuple[float, float, float]) -> float:
        return float(
            map_kernels.field_score(
                points, *pose, self.flat, self.rows, self.cols, *self.origin, CELL_M
            )
        )

    def search(
        self,
        points: Array,
        guess: tuple[float, float, float],
        half_cells: int,
        half_steps: int,
        yaw_step: float,
        *,
        penalty: tuple[float, float] = (0.0, 0.0),
        min_score: float = 0.0,
        budget: int = 10**9,
        avoid: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, -1.0, -1.0),
    ) -> tuple[bool, float, float, float, float, int]:
        found: tuple[bool, float, float, float, float, int] = search_kernels.branch_and_bound(
            points,
            *guess,
            half_cells,
            half_steps,
            yaw_step,
            self.flat,
            self.starts,
            self.rows,
            self.cols,
            *self.origin,
            CELL_M,
            *penalty,
            min_score,
            budget,
            *avoid,
        )
        return found


def maxima(level0: Bytes, level: int) -> Bytes:
    """Level by level the definition, cell by cell."""
    if level == 0:
        return level0
    span = 1 << level
    wide = np.pad(level0, ((0, span), (0, span)))
    rows, cols = level0.shape[0] // span, level0.shape[1] // span
    found = np.zeros((rows, cols), dtype=np.uint8)
    for row in range(rows):
        for col in range(cols):
            window = wide[row * span : (row + 2) * span, col * span : (col + 2) * span]
            found[row, col] = window.max()
    return found
