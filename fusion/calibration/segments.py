"""Straight pieces of wall in a turn of a lidar."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np

from datasets.messages import Array

GAP_M = 0.3
LEAST_LENGTH_M = 0.4
LEAST_POINTS = 12
SMOOTH_POINTS = 5
BEND_SIGMA = 4.5
"""A mean of ``SMOOTH_POINTS`` neighbours so many sigma off the line means that it bends there."""

ROUGH = 1.6
"""A line whose points scatter by more than this times the sensor's noise is no wall."""


@dataclass(frozen=True, slots=True)
class Segments:
    """S straight pieces in one plane (x, y), m.

    middles : (S, 2); normals : (S, 2) unit, towards the sensor; half_lengths_m : (S,).
    sensors : (S, 2) where the sensor stood that saw each.
    """

    middles: Array
    normals: Array
    half_lengths_m: Array
    sensors: Array

    def __len__(self) -> int:
        return len(self.middles)

    @classmethod
    def joined(cls, several: list[Self]) -> Self:
        """All of them; at least one must be given."""
        return cls(
            np.concatenate([s.middles for s in several]),
            np.concatenate([s.normals for s in several]),
            np.concatenate([s.half_lengths_m for s in several]),
            np.concatenate([s.sensors for s in several]),
        )


def wall_segments(points: Array, sigma_m: Array, sensor: Array) -> Segments:
    """The straight pieces among points in the order of their bearings.

    points : (N, 2) m; sigma_m : (N,), of each; sensor : (2,) where they were seen from.

    A piece is split where its points leave the line by more than their noise, and left out if it
    is short or its points scatter.
    """
    rows = []
    for start, stop in _pieces(points, sigma_m):
        middle, normal, across, along = _line(points[start:stop], sigma_m[start:stop])
        low, high = float(along.min()), float(along.max())
        scatter = np.sqrt(np.mean((across / sigma_m[start:stop]) ** 2))
        if high - low < LEAST_LENGTH_M or scatter > ROUGH:
            continue
        middle = middle + np.array([-normal[1], normal[0]]) * (low + high) / 2.0
        if normal @ (sensor - middle) < 0.0:
            normal = -normal
        rows.append((*middle, *normal, (high - low) / 2.0, *sensor))
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    return Segments(table[:, :2], table[:, 2:4], table[:, 4], table[:, 5:])


def _pieces(points: Array, sigma_m: Array) -> Iterator[tuple[int, int]]:
    """Start and stop of runs of points on one line, in order."""
    gaps = np.flatnonzero(np.hypot(*np.diff(points, axis=0).T) > GAP_M) + 1
    ends = [0, *gaps.tolist(), len(points)]
    todo = list(pairwise(ends))[::-1]
    smoothing = np.full(SMOOTH_POINTS, 1.0 / np.sqrt(SMOOTH_POINTS))
    while todo:
        start, stop = todo.pop()
        if stop - start < LEAST_POINTS:
            continue
        _, _, across, _ = _line(points[start:stop], sigma_m[start:stop])
        off = np.abs(np.convolve(across / sigma_m[start:stop], smoothing, mode="valid"))
        if off.max() < BEND_SIGMA:
            yield start, stop
            continue
        # The corner between two pieces is what lies furthest from the chord between their ends.
        piece = points[start:stop]
        first, last = piece[:3].mean(axis=0), piece[-3:].mean(axis=0)
        side = piece - first
        chord = last - first
        off = np.abs(np.convolve(side[:, 0] * chord[1] - side[:, 1] * chord[0], smoothing, "valid"))
        corner = int(np.argmax(off)) + SMOOTH_POINTS // 2
        split = start + min(max(corner, 3), stop - start - 3)
        todo += [(split, stop), (start, split)]


def _line(points: Array, sigma_m: Array) -> tuple[Array, Array, Array, Array]:
    """The line of least squares: a point on it, its normal, and the points across and along it."""
    weights = 1.0 / sigma_m**2
    weights = weights / weights.sum()
    middle = weights @ points
    centred = points - middle
    (xx, xy), (_, yy) = (centred * weights[:, None]).T @ centred
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)  # of the line
    normal = np.array([-np.sin(angle), np.cos(angle)])
    tangent = np.array([-normal[1], normal[0]])
    return middle, normal, centred @ normal, centred @ tangent
