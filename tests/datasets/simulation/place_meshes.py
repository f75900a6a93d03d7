"""Plain measurements on meshes, for the tests of places."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np

from datasets.messages import Array
from datasets.simulation.place import Place, Solid


def write_place(folder: Path, text: str) -> Path:
    path = folder / "place.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def corners(solid: Solid) -> Array:
    """(T, 3, 3) float64."""
    return solid.vertices.astype(np.float64)[solid.triangles]


def volume_m3(solid: Solid) -> float:
    """By the divergence theorem; negative if the triangles look inwards."""
    a, b, c = np.moveaxis(corners(solid), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


def open_edges(solid: Solid) -> list[tuple[int, int]]:
    """Directed edges that do not belong to one triangle each way."""
    t = solid.triangles.astype(int)
    directed = Counter(
        (int(a), int(b)) for i, j in ((0, 1), (1, 2), (2, 0)) for a, b in t[:, [i, j]]
    )
    return [edge for edge, count in directed.items() if count != 1 or directed[edge[::-1]] != 1]


def nearest_hit_m(triangles: Array, origin: Array, direction: Array) -> float:
    """Distance to the first of (T, 3, 3) triangles along a ray; inf if there is none.

    Source: Moeller, Trumbore, Fast, minimum storage ray-triangle intersection, 1997.
    """
    a, b, c = np.moveaxis(triangles, 1, 0)
    u, v = b - a, c - a
    p = np.cross(direction, v)
    det = np.einsum("ij,ij->i", u, p)
    meets = np.abs(det) > 1e-12
    safe = np.where(meets, det, 1.0)
    s = origin - a
    q = np.cross(s, u)
    along_u = np.einsum("ij,ij->i", s, p) / safe
    along_v = (q @ direction) / safe
    distance = np.einsum("ij,ij->i", v, q) / safe
    inside = (along_u >= -1e-9) & (along_v >= -1e-9) & (along_u + along_v <= 1 + 1e-9)
    hits = distance[meets & inside & (distance > 1e-9)]
    return float(hits.min()) if hits.size else float("inf")


def seen_by_lidar(place: Place, leave_out: Iterable[str] = ()) -> Array:
    """Triangles of everything that stops a lidar's beam."""
    left_out = set(leave_out)
    solids = [s for s in place.solids if s.material.lidar == "opaque" and s.name not in left_out]
    return np.concatenate([corners(solid) for solid in solids])


def plan_clearance_m(solids: Iterable[Solid], path: Array) -> tuple[float, str]:
    """Least distance in the plan from a path, (K, 2), to what a robot would run into, and whose.

    The path is sampled every 2 cm; a triangle counts as its edges, if it is between 5 cm and 1 m.
    """
    steps = [
        np.linspace(a, b, max(2, int(np.linalg.norm(b - a) / 0.02) + 1)) for a, b in pairwise(path)
    ]
    points = np.concatenate(steps) if steps else path
    best = (float("inf"), "")
    for solid in solids:
        t = corners(solid)
        z = t[:, :, 2]
        t = t[(z.max(1) > 0.05 + 1e-6) & (z.min(1) < 1.0)][:, :, :2]
        for i, j in ((0, 1), (1, 2), (2, 0)):
            a, u = t[:, i], t[:, j] - t[:, i]
            square = np.maximum((u * u).sum(1), 1e-12)
            low = np.minimum(t[:, i], t[:, j]) - 1.0
            high = np.maximum(t[:, i], t[:, j]) + 1.0
            for k in range(len(t)):
                near = points[((points > low[k]) & (points < high[k])).all(1)]
                if not len(near):
                    continue
                share = np.clip((near - a[k]) @ u[k] / square[k], 0.0, 1.0)
                gap = np.linalg.norm(near - a[k] - share[:, None] * u[k], axis=1).min()
                best = min(best, (float(gap), solid.name))
    return best
