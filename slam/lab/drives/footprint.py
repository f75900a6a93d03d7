"""Where the outline of an obstacle's footprint lies best on the points of a map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from datasets.messages import Array
from datasets.simulation.place import Place

CORNER_NEAR_M = 0.02
STEP_M = 0.05
BLUR_M = 0.03
FIELD_CELL_M = 0.01
FIELD_BORDER_M = 0.12
BEYOND_M = (0.075, 0.125, 0.175)
"""Where a face has ended, and a wall goes on."""
BEYOND_WEIGHT = 0.5
FAR_WEIGHT = 0.1
"""What an outline loses that lies a whole search radius from the truth: it breaks ties."""
COARSE = (0.04, np.radians(np.arange(-12.0, 13.0, 4.0)))
FINE = (0.01, np.radians(np.arange(-3.0, 3.5, 1.0)))
FINE_M = 0.05
CANDIDATES, APART_M = 4, 0.15
DENSE_CELL_M, DENSE_CELLS = 0.025, 9
DENSE_SHARE = 0.15


@dataclass(frozen=True, slots=True)
class FootprintCorner:
    """A corner of an upright thing. outline_m : (K, 2), counter-clockwise, beginning with it."""

    name: str
    outline_m: Array

    @property
    def corner_m(self) -> Array:
        corner: Array = self.outline_m[0]
        return corner


def footprint_corner(place: Place, name: str) -> FootprintCorner:
    """The corner that a point of a place names.

    Raises ValueError if the place has no such point, or no footprint a corner within 2 cm of it.
    """
    from scipy.spatial import ConvexHull  # noqa: PLC0415

    if name not in place.points:
        raise ValueError(f"{place.name} has no point {name}")
    point = np.array(place.points[name][:2])
    for solid in place.solids:
        vertices = solid.vertices[:, :2].astype(np.float64)
        if np.hypot(*(vertices - point).T).min() > CORNER_NEAR_M:
            continue
        outline = vertices[ConvexHull(vertices).vertices]
        apart_m = np.hypot(*(outline - point).T)
        if apart_m.min() <= CORNER_NEAR_M:
            return FootprintCorner(name, np.roll(outline, -int(np.argmin(apart_m)), axis=0))
    raise ValueError(f"no footprint in {place.name} has a corner at the point {name}")


def dense(points: Array) -> Array:
    """Without the scatter about faces: points where far more are within 10 cm."""
    from scipy.ndimage import maximum_filter  # noqa: PLC0415

    index = np.floor((points - points.min(axis=0)) / DENSE_CELL_M).astype(np.int64)
    counts = np.zeros(index.max(axis=0) + 1)
    np.add.at(counts, tuple(index.T), 1.0)
    kept = counts >= DENSE_SHARE * maximum_filter(counts, DENSE_CELLS, mode="constant")
    found: Array = points[kept[tuple(index.T)]]
    return found


@dataclass(frozen=True, slots=True)
class _Field:
    """How near the next point is: exp(-d^2 / 2 sigma^2) in cells of 1 cm. low : (2,) its corner."""

    low: Array
    near: Array

    @classmethod
    def of(cls, points: Array) -> Self:
        from scipy.ndimage import distance_transform_edt  # noqa: PLC0415

        low = points.min(axis=0) - FIELD_BORDER_M
        size = ((points.max(axis=0) + FIELD_BORDER_M - low) / FIELD_CELL_M).astype(np.int64) + 1
        empty = np.ones(size, dtype=np.bool_)
        empty[tuple(((points - low) / FIELD_CELL_M).astype(np.int64).T)] = False
        distance_m = np.asarray(distance_transform_edt(empty)) * FIELD_CELL_M
        return cls(low, np.exp(-0.5 * (distance_m / BLUR_M) ** 2))

    def cover(self, places: Array) -> Array:
        """(S,) from (S, T, 2): the mean over the T places."""
        index = np.floor((places - self.low) / FIELD_CELL_M).astype(np.int64)
        # The border is as good as empty: what lies beyond it is as well.
        index = np.clip(index, 0, np.array(self.near.shape) - 1)
        mean: Array = self.near[index[..., 0], index[..., 1]].mean(axis=1)
        return mean


def placements(
    corner: FootprintCorner, points: Array, search_m: float
) -> list[tuple[float, Array]]:
    """(yaw, shift (2,)) of the outlines that cover most, the best first, each made finer."""
    field = _Field.of(points)
    outline, beyond = _template(corner.outline_m - corner.corner_m)
    near = _scores(field, corner, (outline, beyond), (0.0, np.zeros(2)), search_m, COARSE, search_m)
    places = []
    for _ in range(CANDIDATES):
        k, turn = np.unravel_index(int(np.argmax(near.score)), near.score.shape)
        rough = (float(near.turns[turn]), near.shifts[k])
        fine = _scores(field, corner, (outline, beyond), rough, FINE_M, FINE, search_m)
        k, turn = np.unravel_index(int(np.argmax(fine.score)), fine.score.shape)
        places.append((float(fine.turns[turn]), fine.shifts[k]))
        near.score[np.hypot(*(near.shifts - rough[1]).T) < APART_M] = -np.inf
    return places


@dataclass(frozen=True, slots=True)
class _Scores:
    """score : (S, T) of shifts (S, 2) and turns (T,)."""

    score: Array
    shifts: Array
    turns: Array


def _scores(
    field: _Field,
    corner: FootprintCorner,
    template: tuple[Array, Array],
    about: tuple[float, Array],
    reach_m: float,
    grid: tuple[float, Array],
    search_m: float,
) -> _Scores:
    """How well the outline fits, all around a yaw and a shift."""
    step_m, turns = grid[0], about[0] + grid[1]
    steps = np.arange(-round(reach_m / step_m), round(reach_m / step_m) + 1) * step_m
    shifts = about[1] + np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)
    at, columns = corner.corner_m + shifts[:, None], []
    for turn in turns.tolist():
        c, s = np.cos(turn), np.sin(turn)
        on, beyond = (part @ np.array([[c, s], [-s, c]]) for part in template)
        columns.append(field.cover(at + on) - BEYOND_WEIGHT * field.cover(at + beyond))
    far = FAR_WEIGHT * np.hypot(*shifts.T) / search_m
    return _Scores(np.column_stack(columns) - far[:, None], shifts, turns)


def _template(outline: Array) -> tuple[Array, Array]:
    """Points along the faces, and points beyond their ends where they must not go on."""
    on, beyond = [], []
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        length_m = np.hypot(*(b - a))
        count = max(1, int(np.ceil(length_m / STEP_M)))
        on.append(a + (np.arange(count)[:, None] + 0.5) / count * (b - a))
        out = np.array(BEYOND_M)[:, None] * (b - a) / length_m
        beyond += [a - out, b + out]
    return np.concatenate(on), np.concatenate(beyond)


def moved_outline(corner: FootprintCorner, yaw: float, shift: Array) -> Array:
    """(K, 2) m, map frame: the outline after a placement."""
    c, s = np.cos(yaw), np.sin(yaw)
    offset = corner.outline_m - corner.corner_m
    moved: Array = corner.corner_m + shift + offset @ np.array([[c, s], [-s, c]])
    return moved
