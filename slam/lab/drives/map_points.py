"""Where a map has the corner of an obstacle, found by fitting its faces (paper, tables 1 and 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from datasets.messages import Array
from slam.evaluation.surfaces import Mask
from slam.lab.drives.footprint import (
    BEYOND_M,
    STEP_M,
    FootprintCorner,
    dense,
    moved_outline,
    placements,
)

SEARCH_M = 1.0
HOWS = ("two faces", "one face")
NEAR_M = 0.05
CORNER_M = 0.045
"""So near the ends of a face points may be of the next one."""
LEAST_SEEN = 0.5
BESIDE_SHARE = 0.5
RUN_GAP_M = 0.12
FIT_ROUNDS = 4
WALL_NEAR_M = 0.10


@dataclass(frozen=True, slots=True)
class CornerFound:
    """position_map : (2,) m. error_m : its distance from the truth, without any alignment.

    how        : from two faces, the corner is where their lines meet; from one, it is its end.
    residual_m : of the points about the lines.
    """

    name: str
    position_map: Array
    error_m: float
    how: Literal["two faces", "one face"]
    residual_m: float


@dataclass(frozen=True, slots=True)
class CornerNotFound:
    """A corner that the map doesn't show, and why."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class _Face:
    """A face that leaves the corner. start : (2,). u, n : along it, and square to it, outwards."""

    start: Array
    u: Array
    n: Array
    length_m: float


def find_corner(
    corner: FootprintCorner,
    points_map: Array,
    *,
    walls_map: Array | None = None,
    search_m: float = SEARCH_M,
) -> CornerFound | CornerNotFound:
    """Find a corner among the occupied cells' centres, or points, of a map or a camera layer.

    points_map : (N, 2) m, finite. walls_map : (M, 2), those of the lidar layer, if apart; what lies
                 within 10 cm of them is left out.

    The outline of the footprint is laid on the points, up to ``search_m`` and 12 deg from the
    truth, where it covers most and no face goes on beyond its ends; the scatter about faces, where
    points are far fewer than within 10 cm, is left out. Of the four best places the first with both
    faces counts, else the first with one. Then the two faces at the
    corner are fitted together, with the angle between them as it is, and moved until they rest. A
    face counts as seen if half of it is covered. Raises ValueError for other points.
    """
    if points_map.ndim != 2 or points_map.shape[1] != 2 or not np.isfinite(points_map).all():
        raise ValueError(f"points {points_map.shape} must be finite and (N, 2)")
    points = _near(corner, points_map, walls_map, search_m)
    if not len(points):
        return CornerNotFound(corner.name, f"nothing within {search_m:g} m of the obstacle")
    results = [_fit(corner, points, *place) for place in placements(corner, points, search_m)]
    by_faces = [each for how in HOWS for each in results if getattr(each, "how", None) == how]
    return (by_faces or results)[0]


def _fit(
    corner: FootprintCorner, points: Array, yaw: float, shift: Array
) -> CornerFound | CornerNotFound:
    """The corner by its faces, from about where the outline lies."""
    outline = moved_outline(corner, yaw, shift)
    faces = [_face(outline[0], outline[1], -1.0), _face(outline[0], outline[-1], 1.0)]
    for _ in range(FIT_ROUNDS):
        seen = [_covered(points, face) >= LEAST_SEEN for face in faces]
        if not any(seen):
            return CornerNotFound(corner.name, "no outline like its own: neither face is there")
        faces, residual_m = _fitted(points, faces, seen)
    ends = [_goes_on(points, face) for face in faces]
    if all(seen):
        if all(far for _, far in ends):
            return CornerNotFound(corner.name, "what fits best is a corner between longer walls")
        return _found(corner, faces[0].start, "two faces", residual_m)
    k = seen.index(True)
    if ends[k][0]:
        return CornerNotFound(corner.name, "what fits best is part of a longer wall")
    face = faces[k]
    position = face.start + _end_m(points, face) * face.u
    return _found(corner, position, "one face", residual_m)


def _found(
    corner: FootprintCorner,
    position: Array,
    how: Literal["two faces", "one face"],
    residual_m: float,
) -> CornerFound:
    error_m = float(np.hypot(*(position - corner.corner_m)))
    return CornerFound(corner.name, position, error_m, how, residual_m)


def _near(
    corner: FootprintCorner, points_map: Array, walls_map: Array | None, search_m: float
) -> Array:
    from scipy.spatial import cKDTree  # noqa: PLC0415

    reach_m = search_m + np.hypot(*(corner.outline_m - corner.corner_m).T).max() + max(BEYOND_M)
    points = points_map[np.hypot(*(points_map - corner.corner_m).T) < reach_m]
    if walls_map is not None and len(walls_map) and len(points):
        points = points[cKDTree(dense(walls_map)).query(points)[0] > WALL_NEAR_M]
    return dense(points) if len(points) else points


def _face(start: Array, end: Array, left: float) -> _Face:
    """left : 1 if the outside is to the left of who goes along it, otherwise -1."""
    length_m = float(np.hypot(*(end - start)))
    u = (end - start) / length_m
    return _Face(start, u, left * np.array([-u[1], u[0]]), length_m)


def _on(points: Array, face: _Face, margin_m: float) -> tuple[Array, Array, Mask]:
    """(along, across, which lie on the face, not so near its ends)."""
    along, across = (points - face.start) @ face.u, (points - face.start) @ face.n
    inside = (along > margin_m) & (along < face.length_m - margin_m)
    return along, across, inside & (np.abs(across) < NEAR_M)


def _covered(points: Array, face: _Face) -> float:
    """The share of pieces of 5 cm of a face, but for its ends, that have points.

    A piece beside which far more lies than on it is the scatter about something else; one that has
    as much before it as on it is amid a thick wall.
    """
    along, across, _ = _on(points, face, 0.0)
    length_m = face.length_m - 2 * CORNER_M
    count = max(1, round(length_m / STEP_M))
    piece = np.floor((along - CORNER_M) / length_m * count).astype(np.int64)
    inside, off_m = (piece >= 0) & (piece < count), np.abs(across)
    on = np.bincount(piece[inside & (off_m < NEAR_M)], minlength=count)
    beside = inside & (off_m >= NEAR_M) & (off_m < 3 * NEAR_M)
    before = np.bincount(piece[beside & (across > 0.0)], minlength=count)
    behind = np.bincount(piece[beside & (across < 0.0)], minlength=count)
    return float(((on > before) & (on >= BESIDE_SHARE * (before + behind))).mean())


def _fitted(points: Array, faces: list[_Face], seen: list[bool]) -> tuple[list[_Face], float]:
    """(both faces turned and moved by one least squares, residual m) over those that were seen."""
    slope, spread, parts = 0.0, 0.0, []
    for face, usable in zip(faces, seen, strict=True):
        if not usable:
            continue
        along, across, on = _on(points, face, CORNER_M)
        x, y = along[on], across[on]
        left = float(face.u[0] * face.n[1] - face.u[1] * face.n[0])
        slope += left * float(((x - x.mean()) * (y - y.mean())).sum())
        spread += float(((x - x.mean()) ** 2).sum())
        parts.append((face, x, left * y))
    turn = float(np.arctan2(slope, spread)) if spread > 0.0 else 0.0
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    rows, values, residuals = [], [], []
    for face, x, y in parts:
        normal = np.array([-face.u[1], face.u[0]])
        through = face.start + x.mean() * face.u + y.mean() * normal
        rows.append(R @ normal)
        values.append(float(rows[-1] @ through))
        residuals.append(y - y.mean() - np.tan(turn) * (x - x.mean()))
    # One line leaves the place along it open: the least change of the corner is taken then.
    old = faces[0].start
    start = old + np.linalg.lstsq(np.array(rows), np.array(values) - np.array(rows) @ old)[0]
    turned = [_Face(start, R @ face.u, R @ face.n, face.length_m) for face in faces]
    return turned, float(np.concatenate(residuals).std())


def _goes_on(points: Array, face: _Face) -> tuple[bool, bool]:
    """Whether there are points on the line of a face beyond the corner, and beyond its far end."""
    along, across, _ = _on(points, face, 0.0)
    along = along[np.abs(across) < NEAR_M]
    low, high = BEYOND_M[0] - STEP_M / 2, BEYOND_M[-1] + STEP_M / 2

    def filled(out_m: Array) -> bool:
        pieces = (out_m[(out_m > low) & (out_m < high)] - low) / STEP_M
        return np.unique(pieces.astype(np.int64)).size >= 2

    return filled(-along), filled(along - face.length_m)


def _end_m(points: Array, face: _Face) -> float:
    """Where the points of a face end at the corner, m along it; stray ones apart don't count."""
    along, across, _ = _on(points, face, 0.0)
    near = np.abs(across) < NEAR_M
    near &= (along > -face.length_m) & (along < face.length_m)
    run = np.sort(along[near])
    middle = int(np.searchsorted(run, face.length_m / 2))
    gaps = np.flatnonzero(np.diff(run[: middle + 1]) > RUN_GAP_M)
    first = int(gaps[-1]) + 1 if gaps.size else 0
    return float(np.quantile(run[first:], 0.01, method="lower"))
