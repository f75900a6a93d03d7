"""Relative poses checked by hand: ``t1 t2 x y z roll pitch yaw``, times in seconds.

Source: Kuemmerle et al., On Measuring the Accuracy of SLAM Algorithms, Autonomous Robots 2009.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datasets.bounds import FARTHEST_M, within
from datasets.errors import InputError
from datasets.messages import Array
from datasets.trajectory import Stamps
from datasets.tum import parse_stamp_ns, text_lines

_REMEDY = "Each line must read: t1 t2 x y z roll pitch yaw."


@dataclass(frozen=True, slots=True)
class Relations:
    """Planar relative poses of the base between two times.

    stamps_1_ns, stamps_2_ns : (N,) int64; the second may be the earlier one.
    xyyaw                    : (N, 3) float64, the pose of base at 2 in base at 1: m, m, rad.

    Raises ValueError if shapes disagree or a value is not finite.
    """

    stamps_1_ns: Stamps
    stamps_2_ns: Stamps
    xyyaw: Array

    def __post_init__(self) -> None:
        if self.stamps_1_ns.ndim != 1 or self.stamps_1_ns.shape != self.stamps_2_ns.shape:
            raise ValueError(f"{self.stamps_1_ns.shape} and {self.stamps_2_ns.shape} stamps")
        if self.xyyaw.shape != (self.stamps_1_ns.size, 3):
            raise ValueError(f"{self.stamps_1_ns.size} stamps for {self.xyyaw.shape} poses")
        if not np.isfinite(self.xyyaw).all():
            raise ValueError("a relation must be finite")

    def __len__(self) -> int:
        return int(self.stamps_1_ns.size)


def read_relations(path: Path) -> Relations:
    """Read the planar part of a relations file; z, roll and pitch are passed over.

    Blank lines and lines that begin with ``#`` are passed over. Raises InputError that names the
    line if one cannot be read, and for a file without relations.
    """
    stamps_ns: list[tuple[int, int]] = []
    rows: list[tuple[float, float, float]] = []
    for number, line in enumerate(text_lines(path, "relations", "of relations"), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            stamps, row = _relation(line.split())
        except ValueError as error:
            where = f"{path}, line {number}"
            raise InputError(str(error), where=where, remedy=_REMEDY) from error
        stamps_ns.append(stamps)
        rows.append(row)
    if not rows:
        raise InputError("there is no relation in this file", where=str(path), remedy=_REMEDY)
    stamps_array = np.array(stamps_ns, dtype=np.int64)
    return Relations(
        stamps_array[:, 0].copy(), stamps_array[:, 1].copy(), np.array(rows, dtype=np.float64)
    )


def _relation(words: list[str]) -> tuple[tuple[int, int], tuple[float, float, float]]:
    """((stamp 1 ns, stamp 2 ns), (x m, y m, yaw rad)) of one line, or a ValueError."""
    if len(words) != 8:
        raise ValueError(f"{len(words)} values where 8 are needed")
    x_m, y_m, z_m, roll, pitch, yaw = (float(word) for word in words[2:])
    if not all(map(math.isfinite, (x_m, y_m, z_m, roll, pitch, yaw))):
        raise ValueError("a value is not finite")
    if not within((x_m, y_m, z_m, roll, pitch, yaw), FARTHEST_M):
        raise ValueError(f"a value is larger than {FARTHEST_M:g}")
    return (parse_stamp_ns(words[0]), parse_stamp_ns(words[1])), (x_m, y_m, yaw)
