"""Figures over the seeds, in words: mean and spread."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol, TypeVar

import numpy as np

NOTHING = "-"


def number(value: float | None, decimals: int = 3) -> str:
    """A figure, or a dash."""
    return NOTHING if value is None else f"{value:.{decimals}f}"


def mean_of(values: Iterable[float | None]) -> float | None:
    """Of those that are there; None of none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def mean_spread(values: Iterable[float | None], decimals: int = 3) -> str:
    """Mean and standard deviation (n - 1) of those that are there; the mean alone of one."""
    known = [value for value in values if value is not None]
    if not known:
        return NOTHING
    mean = f"{np.mean(known):.{decimals}f}"
    return mean if len(known) == 1 else f"{mean} ± {np.std(known, ddof=1):.{decimals}f}"


class OfSystem(Protocol):
    """A row that says of which system it is."""

    @property
    def system(self) -> str: ...


Row = TypeVar("Row", bound=OfSystem)


def by_system(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by their system, in the order in which the systems first come."""
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(row.system, []).append(row)
    return out
