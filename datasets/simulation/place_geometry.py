"""Upright bodies over convex footprints, which all of a place is put together from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.messages import Array

Vertices = npt.NDArray[np.float32]
Triangles = npt.NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class Prism:
    """What stands over a convex footprint, (K, 2) m, counter-clockwise, from bottom to top."""

    footprint: Array
    bottom_m: float
    top_m: float

    def placed(self, x_m: float, y_m: float, yaw_rad: float) -> Prism:
        """The prism turned about the origin, then moved."""
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        moved = self.footprint @ np.array([[c, s], [-s, c]]) + (x_m, y_m)
        return Prism(moved, self.bottom_m, self.top_m)


@dataclass(frozen=True, slots=True)
class Part:
    """A thing of a place before it becomes a mesh: prisms of one material.

    keys : where it stands in the place file.
    wall : walls may run into each other, other things may not.
    material_key : the key that names its material.
    """

    name: str
    material: str
    prisms: tuple[Prism, ...]
    keys: tuple[str | int, ...]
    wall: bool = False
    material_key: str = "material"


def cuboid(
    centre_m: tuple[float, float], size_m: tuple[float, float, float], z_m: float = 0.0
) -> Prism:
    """A box along the axes whose bottom is at ``z_m``; size: x, y, z."""
    half = np.array([size_m[0], size_m[1]]) / 2
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return Prism(np.asarray(centre_m) + corners * half, z_m, z_m + size_m[2])


def column(
    centre_m: tuple[float, float], radius_m: float, height_m: float, z_m: float, sides: int = 24
) -> Prism:
    """A regular prism with the area of the circle it stands for."""
    angles = (np.arange(sides) + 0.5) * 2 * math.pi / sides
    reach_m = radius_m * math.sqrt(2 * math.pi / sides / math.sin(2 * math.pi / sides))
    circle = reach_m * np.column_stack([np.cos(angles), np.sin(angles)])
    return Prism(np.asarray(centre_m) + circle, z_m, z_m + height_m)


def mesh(prisms: Sequence[Prism]) -> tuple[Vertices, Triangles]:
    """Vertices (V, 3) and triangles (T, 3), seen counter-clockwise from outside.

    Each prism has vertices of its own, so that each edge belongs to exactly two triangles.
    """
    vertices, triangles, first = [], [], 0
    for prism in prisms:
        count = len(prism.footprint)
        for z_m in (prism.bottom_m, prism.top_m):
            vertices.append(np.column_stack([prism.footprint, np.full(count, z_m)]))
        here = np.arange(count)
        after = (here + 1) % count
        fan = np.column_stack([np.zeros(count - 2, dtype=int), here[1:-1], here[2:]])
        sides = np.column_stack([here, after, after + count])
        others = np.column_stack([here, after + count, here + count])
        triangles.append(np.concatenate([fan[:, ::-1], fan + count, sides, others]) + first)
        first += 2 * count
    return (
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(triangles).astype(np.uint32),
    )


def penetration_m(a: Prism, b: Prism) -> float:
    """How far one prism must move to leave another; not above 0 if they are apart.

    Separating axes: z and the normals of all sides.
    """
    least = min(a.top_m, b.top_m) - max(a.bottom_m, b.bottom_m)
    for prism in (a, b):
        edges = np.roll(prism.footprint, -1, axis=0) - prism.footprint
        normals = np.column_stack([edges[:, 1], -edges[:, 0]])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        on_a, on_b = a.footprint @ normals.T, b.footprint @ normals.T
        overlap = np.minimum(on_a.max(0), on_b.max(0)) - np.maximum(on_a.min(0), on_b.min(0))
        least = min(least, float(overlap.min()))
    return least


def contains(outline: Array, point: Array) -> bool:
    """Whether a polygon, (K, 2), holds a point, (2,); it need not be convex."""
    x1, y1 = outline.T
    x2, y2 = np.roll(outline, -1, axis=0).T
    crosses = (y1 > point[1]) != (y2 > point[1])
    height = np.where(y2 == y1, 1.0, y2 - y1)
    right = point[0] < x1 + (point[1] - y1) / height * (x2 - x1)
    return bool(np.count_nonzero(crosses & right) % 2)


def segment_distances(start: Array, end: Array, starts: Array, ends: Array) -> Array:
    """Distances (E,) from a segment, (2,) to (2,), to others, (E, 2) to (E, 2); 0 at crossings."""
    many = (np.broadcast_to(start, starts.shape), np.broadcast_to(end, starts.shape))
    distances = np.minimum.reduce(
        [
            _point_distances(many[0], starts, ends),
            _point_distances(many[1], starts, ends),
            _point_distances(starts, *many),
            _point_distances(ends, *many),
        ]
    )
    meet = (_side(*many, starts) * _side(*many, ends) < 0) & (
        _side(starts, ends, many[0]) * _side(starts, ends, many[1]) < 0
    )
    return np.where(meet, 0.0, distances)


def _side(a: Array, b: Array, point: Array) -> Array:
    u, v = b - a, point - a
    side: Array = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return side


def _point_distances(point: Array, a: Array, b: Array) -> Array:
    u = b - a
    square = np.maximum((u * u).sum(1), 1e-18)
    share = np.clip(((point - a) * u).sum(1) / square, 0.0, 1.0)
    return np.linalg.norm(point - a - share[:, None] * u, axis=1)
