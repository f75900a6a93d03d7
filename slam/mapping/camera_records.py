"""What a view puts into the map: a camera's surfaces, and how far each of its rays is free."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.se2 import transform
from fusion.pseudo_scan import PseudoScan
from slam.mapping.occupancy import MARGIN_M
from slam.mapping.scan_store import BEAM, CLEAR, SURFACE, VAGUE

SURFACE_CELL_M = 0.02
"""Of the surfaces that fall into one such cell, one is kept: a map has no finer ones, usually."""
VAGUE_M = 0.05
"""A surface whose range has a larger standard deviation may fall into any of several cells."""
SIGMAS = 2.0
"""Free space ends this many standard deviations of the range before a surface, and MARGIN_M."""
ASIDE_M = 0.04
"""So far to the side of a surface no ray is free: poses are off by 2 or 3 cm from view to view,
and a chair's leg is not wider than that."""


@dataclass(frozen=True, slots=True)
class ViewRecord:
    """A view that was taken in, of a camera or of a lidar that scans are fused with.

    points_base  : (N, 2) float32, m, base frame of ``stamp_ns``.
    roles        : (N,) uint8, SURFACE, VAGUE or CLEAR; a lidar's are BEAM.
    origin_base  : (2,) m, the camera's place.
    clear_from_m : nearer than this the camera doesn't see low things.
    """

    stamp_ns: int
    sensor: str
    points_base: npt.NDArray[np.float32]
    roles: npt.NDArray[np.uint8]
    origin_base: Array
    clear_from_m: float

    def moved(self, T_true_said: Array, clock_s: float) -> Self:
        """The same as of a sensor that stands elsewhere, and was looking at another time.

        T_true_said : (3, 3), from points on the base as they are to where they belong.
        clock_s     : to be added to the stamp.
        """
        points_base = transform(T_true_said, self.points_base.astype(np.float64))
        return replace(
            self,
            stamp_ns=self.stamp_ns + round(clock_s * 1e9),
            points_base=points_base.astype(np.float32),
            origin_base=transform(T_true_said, self.origin_base[None])[0],
        )


def view_record(view: PseudoScan) -> ViewRecord:
    """Surfaces without rays, and rays that end at a margin before what they meet.

    The margin is that of the lidars' map and grows with the noise of the range; rays that pass
    close by an obstacle end before it, too.
    """
    free_m = _free_m(view)
    rays = np.column_stack([np.cos(view.bearings_rad), np.sin(view.bearings_rad)])
    cleared = free_m > view.free_from_m
    ends = view.origin_base + rays[cleared] * free_m[cleared, None]
    kept = _thinned(view.surfaces_base)
    surfaces = view.surfaces_base[kept]
    roles = np.full(len(surfaces) + len(ends), CLEAR, np.uint8)
    roles[: len(surfaces)] = np.where(_sigma_m(view)[kept] > VAGUE_M, VAGUE, SURFACE)
    return ViewRecord(
        view.stamp_ns,
        view.sensor,
        np.concatenate([surfaces, ends.astype(np.float32)]),
        roles,
        view.origin_base,
        view.free_from_m,
    )


def beam_record(view: PseudoScan) -> ViewRecord:
    """A lidar's view: its returns by ascending bearing, each the end of a beam that was free."""
    return ViewRecord(
        view.stamp_ns,
        view.sensor,
        view.surfaces_base,
        np.full(len(view.surfaces_base), BEAM, np.uint8),
        view.origin_base,
        0.0,
    )


def _sigma_m(view: PseudoScan) -> Array:
    """(P,) standard deviation of each surface's range: that of the rays that end as far away."""
    met = np.isfinite(view.sigma_m)
    if not met.any():
        return np.zeros(len(view.surfaces_base))
    order = np.argsort(view.ranges_m[met], kind="stable")
    away = view.surfaces_base.astype(np.float64) - view.origin_base
    ranges_m = np.hypot(*away.T)
    sigma_m = np.interp(ranges_m, view.ranges_m[met][order], view.sigma_m[met][order])
    return np.asarray(sigma_m, dtype=np.float64)


def _free_m(view: PseudoScan) -> Array:
    """(B,) up to where each ray frees cells; 0 where nothing is known."""
    seen_m = np.where(np.isfinite(view.free_to_m), view.free_to_m, 0.0)
    met = np.isfinite(view.ranges_m)
    margin_m = MARGIN_M + SIGMAS * np.where(met, view.sigma_m, 0.0)
    before_m = np.where(met, view.ranges_m - margin_m, np.inf)
    return np.minimum(np.minimum(seen_m, before_m), _beside(view, before_m))


def _beside(view: PseudoScan, before_m: Array) -> Array:
    """(B,) the nearest end of free space among the surfaces within ASIDE_M of each ray; or inf."""
    out = np.full(len(before_m), np.inf)
    if len(out) < 2:
        return out
    near_m = np.where(np.isfinite(view.ranges_m), np.maximum(view.ranges_m, ASIDE_M), np.inf)
    reach = (np.arctan2(ASIDE_M, near_m) / max(view.spacing_rad, 1e-6)).astype(np.int64)
    for k in range(1, min(int(reach.max()), len(out) - 1) + 1):
        reached = np.where(reach >= k, before_m, np.inf)
        out[k:] = np.minimum(out[k:], reached[:-k])
        out[:-k] = np.minimum(out[:-k], reached[k:])
    return out


def _thinned(surfaces_base: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """Which points are the first in their small cell, in order."""
    cells = np.floor(surfaces_base.astype(np.float64) / SURFACE_CELL_M).astype(np.int64)
    _, first = np.unique(cells @ np.array([1 << 31, 1]), return_index=True)
    return np.sort(first)
