"""A planar trajectory: poses with stamps, as the evaluation and the run folder use it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.se2 import pose_matrices, xyyaw_rows

Stamps = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses of one frame in another over time.

    stamps_ns : (N,) int64, strictly increasing.
    xyyaw     : (N, 3) float64: x m, y m, yaw rad (any branch).

    Raises ValueError if shapes disagree, a value is not finite or stamps do not increase.
    """

    stamps_ns: Stamps
    xyyaw: Array

    def __post_init__(self) -> None:
        if self.xyyaw.shape != (self.stamps_ns.size, 3) or self.stamps_ns.ndim != 1:
            raise ValueError(f"{self.stamps_ns.shape} stamps for {self.xyyaw.shape} poses")
        if not np.isfinite(self.xyyaw).all():
            raise ValueError("a trajectory must be finite")
        if (np.diff(self.stamps_ns) <= 0).any():
            raise ValueError("the stamps of a trajectory must increase")

    def __len__(self) -> int:
        return int(self.stamps_ns.size)

    @classmethod
    def from_matrices(cls, stamps_ns: Sequence[int], poses: Sequence[Array]) -> Self:
        """poses : matrices T_a_b, (3, 3)."""
        rows = xyyaw_rows(np.asarray(poses, dtype=np.float64).reshape(-1, 3, 3))
        return cls(np.asarray(stamps_ns, dtype=np.int64), rows)

    def matrices(self) -> Array:
        """The poses as T_a_b, (N, 3, 3)."""
        return pose_matrices(self.xyyaw)

    def at(self, stamps_ns: Stamps) -> Array:
        """Poses (M, 3) at any stamps, linear in between (yaw the shorter way), held at the ends."""
        base_ns = self.stamps_ns[0]
        t_s = (self.stamps_ns - base_ns) * 1e-9
        query_s = (np.asarray(stamps_ns, dtype=np.int64) - base_ns) * 1e-9
        yaws = np.unwrap(self.xyyaw[:, 2])
        columns = (self.xyyaw[:, 0], self.xyyaw[:, 1], yaws)
        return np.column_stack([np.interp(query_s, t_s, column) for column in columns])

    def before(self, stamps_ns: Stamps) -> Self:
        """The trajectory at other stamps, as ``at``; before the first pose it goes on backwards.

        stamps_ns : (M,) increasing.
        """
        rows = self.at(stamps_ns)
        early = stamps_ns < self.stamps_ns[0]
        if early.any() and len(self) > 1:
            first, second = self.xyyaw[0], self.at(self.stamps_ns[1:2])[0]
            share = (stamps_ns[early] - self.stamps_ns[0]) / (self.stamps_ns[1] - self.stamps_ns[0])
            turn = np.arctan2(np.sin(second[2] - first[2]), np.cos(second[2] - first[2]))
            step = np.array([second[0] - first[0], second[1] - first[1], turn])
            rows[early] = first + share[:, None] * step
        return type(self)(stamps_ns, rows)
