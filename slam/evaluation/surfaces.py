"""The surfaces of a place as points: what a map could show of it, and what stands in one plane."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.simulation.place import Solid

STEP_M = 0.05
INSIDE_M = 0.005
FLAT = 0.999
"""Faces whose normal leans less than 2.6 deg from the vertical are horizontal, others are not."""

Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class SurfacePoints:
    """Points on the faces of solids, one for each patch of at most 5 cm x 5 cm.

    points_map : (P, 3) m. normals : (P, 3), unit, outwards. areas_m2 : (P,) of the patches.
    solid      : (P,) index into the solids they were sampled from.
    upright    : (P,) whether a map in the plane shows it as a line: points of faces that aren't
                 horizontal, and of the edges of horizontal ones. The others lie amid such a face.
    """

    points_map: Array
    normals: Array
    areas_m2: Array
    solid: Ints
    upright: Mask


@dataclass(frozen=True, slots=True)
class _Face:
    """Triangles of one plane that hang together. corners : (K, 3, 3) m."""

    corners: Array
    normal: Array


def sample_surfaces(solids: Sequence[Solid], low_m: float, high_m: float) -> SurfacePoints:
    """Points on all faces between two heights, whether anything could see them or not.

    Each face is cut into equal patches, however small it is: a leg of 3 cm has points too. Points
    of edges lie 5 mm inside their face, so that a ray can meet them.
    """
    rows: list[tuple[Array, Array, float, int, bool]] = []
    for index, solid in enumerate(solids):
        for face in _faces(solid):
            heights = face.corners[..., 2]
            if heights.max() <= low_m or heights.min() >= high_m:
                continue
            flat = abs(face.normal[2]) > FLAT
            points, area_m2 = _lattice(face, low_m, high_m, flat)
            rows.append((points, face.normal, area_m2, index, not flat))
            if flat:
                rows.append((_edge_points(face), face.normal, STEP_M**2, index, True))
    counts = np.array([len(row[0]) for row in rows], dtype=np.int64)
    normals = np.array([row[1] for row in rows]).reshape(-1, 3)
    return SurfacePoints(
        points_map=np.concatenate([np.empty((0, 3)), *(row[0] for row in rows)]),
        normals=np.repeat(normals, counts, axis=0),
        areas_m2=np.repeat(np.array([row[2] for row in rows]), counts),
        solid=np.repeat(np.array([row[3] for row in rows], dtype=np.int64), counts),
        upright=np.repeat(np.array([row[4] for row in rows], dtype=np.bool_), counts),
    )


def section_points(solids: Sequence[Solid], height_m: float, step_m: float = 0.02) -> Array:
    """(N, 2) m: points along the lines in which a horizontal plane cuts the faces of solids."""
    pieces = [np.empty((0, 2))]
    for solid in solids:
        corners = solid.vertices.astype(np.float64)[solid.triangles]
        above = corners[..., 2] > height_m
        for triangle, side in zip(corners, above, strict=True):
            if side.all() or not side.any():
                continue
            ends = [
                _crossing(triangle[k], triangle[(k + 1) % 3], height_m)
                for k in range(3)
                if side[k] != side[(k + 1) % 3]
            ]
            count = max(2, int(np.ceil(np.hypot(*(ends[1] - ends[0])) / step_m)) + 1)
            pieces.append(np.linspace(ends[0], ends[1], count))
    return np.concatenate(pieces)


def _crossing(a: Array, b: Array, height_m: float) -> Array:
    at: Array = (a + (b - a) * (height_m - a[2]) / (b[2] - a[2]))[:2]
    return at


def _faces(solid: Solid) -> Iterator[_Face]:
    corners = solid.vertices.astype(np.float64)[solid.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1)
    normals = across / np.maximum(length, 1e-12)[:, None]
    neighbours: dict[tuple[int, int], list[int]] = defaultdict(list)
    for index, triangle in enumerate(solid.triangles.tolist()):
        for k in range(3):
            a, b = triangle[k], triangle[(k + 1) % 3]
            neighbours[min(a, b), max(a, b)].append(index)
    beside: dict[int, list[int]] = defaultdict(list)
    for shared in neighbours.values():
        for one in shared:
            beside[one] += [o for o in shared if o != one and normals[one] @ normals[o] > 0.9999]
    waiting = {index for index in range(len(corners)) if length[index] > 1e-12}
    for seed in range(len(corners)):
        if seed not in waiting:
            continue
        waiting.discard(seed)
        found, stack = [seed], [seed]
        while stack:
            fresh = [other for other in beside[stack.pop()] if other in waiting]
            for other in fresh:
                if other in waiting:
                    waiting.discard(other)
                    found.append(other)
                    stack.append(other)
        yield _Face(corners[sorted(found)], normals[seed])


def _lattice(face: _Face, low_m: float, high_m: float, flat: bool) -> tuple[Array, float]:
    """(points (N, 3), area of a patch in m^2), the middles of equal patches of a face."""
    corners = face.corners.reshape(-1, 3)
    if flat:
        u = max((b - a for a, b, _ in _outline(face)), key=lambda edge: float(edge @ edge))
    else:
        u = np.array([-face.normal[1], face.normal[0], 0.0])
    u = u / np.linalg.norm(u)
    v = np.cross(face.normal, u)
    on_u, on_v = corners @ u, corners @ v
    low_v, high_v = on_v.min(), on_v.max()
    if abs(v[2]) > FLAT:  # a vertical face: only the part between the heights
        bounds = np.sort(np.array([low_m, high_m]) / v[2])
        low_v, high_v = max(low_v, bounds[0]), min(high_v, bounds[1])
    at_u, step_u = _middles(on_u.min(), on_u.max())
    at_v, step_v = _middles(low_v, high_v)
    uv = np.stack(np.meshgrid(at_u, at_v, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = np.zeros(len(uv), dtype=np.bool_)
    for triangle in face.corners:
        inside |= _in_triangle(uv, np.column_stack([triangle @ u, triangle @ v]))
    points = uv[inside, :1] * u + uv[inside, 1:] * v + (corners[0] @ face.normal) * face.normal
    kept = (points[:, 2] >= low_m) & (points[:, 2] <= high_m)
    return points[kept], step_u * step_v


def _middles(low: float, high: float) -> tuple[Array, float]:
    count = max(1, int(np.ceil((high - low) / STEP_M - 1e-6)))
    step = float(high - low) / count
    middles: Array = np.asarray(low + (np.arange(count) + 0.5) * step, dtype=np.float64)
    return middles, step


def _in_triangle(points: Array, triangle: Array) -> Mask:
    sides = []
    for k in range(3):
        a, b = triangle[k], triangle[(k + 1) % 3]
        sides.append((b[0] - a[0]) * (points[:, 1] - a[1]) - (b[1] - a[1]) * (points[:, 0] - a[0]))
    turn = np.array(sides)
    inside: Mask = np.logical_or((turn >= -1e-9).all(axis=0), (turn <= 1e-9).all(axis=0))
    return inside


def _outline(face: _Face) -> Iterator[tuple[Array, Array, Array]]:
    """The edges of a face: both ends, and the third corner of the triangle they belong to."""
    seen: dict[tuple[tuple[float, ...], ...], list[tuple[int, int]]] = defaultdict(list)
    for index, triangle in enumerate(np.round(face.corners, 6).tolist()):
        for k in range(3):
            ends = sorted((tuple(triangle[k]), tuple(triangle[(k + 1) % 3])))
            seen[tuple(ends)].append((index, k))
    for uses in seen.values():
        if len(uses) == 1:
            index, k = uses[0]
            yield tuple(face.corners[index, (k + np.arange(3)) % 3])


def _edge_points(face: _Face) -> Array:
    """(N, 3) along the outline of a face, every 5 cm, a little inside it."""
    pieces = [np.empty((0, 3))]
    for a, b, c in _outline(face):
        length_m = float(np.linalg.norm(b - a))
        along = (b - a) / length_m
        inwards = (c - a) - ((c - a) @ along) * along
        inwards *= INSIDE_M / np.linalg.norm(inwards)
        at, _ = _middles(0.0, length_m)
        pieces.append(a + at[:, None] * along + inwards)
    return np.concatenate(pieces)
