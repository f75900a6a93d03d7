"""Which obstacles of a simulated place a robot's cameras could have seen, and where they are.

Each image is taken again without noise: a ray goes from the camera to every surface point in view.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.recording import Intrinsics
from datasets.simulation.place import Place
from datasets.simulation.scene import Scene
from datasets.tf_tree import standing
from datasets.trajectory import Stamps, Trajectory
from slam.evaluation.surfaces import Ints, Mask, SurfacePoints, sample_surfaces, section_points

LOW_M, HIGH_M = 0.05, 1.0
"""Between these heights above the floor stands what a robot must not drive into."""
WITHIN_M = 3.5
LEAST_SIGHTINGS = 3
CELL_M = 0.05
CELL_SHIFT_M = 0.0125
"""Faces lie on multiples of 2.5 cm as a rule: so none lies on a border between two cells."""
BESIDE_M = 0.10
"""What has something in the lidar's plane within this distance is not low."""
VISIT_GAP_NS = 10_000_000_000
HIDDEN_M = 0.005
TRUTHS_KEPT = 4


@dataclass(frozen=True, slots=True)
class CameraView:
    """One camera of a drive and when it took its images.

    T_base_camera : (4, 4), optical frame. stamps_ns : (N,) int64, of its images.
    nearest_m     : nearer than this it sees nothing.
    """

    T_base_camera: Array
    intrinsics: Intrinsics
    stamps_ns: Stamps
    nearest_m: float = 0.2

    @property
    def half_view_rad(self) -> float:
        """Half the horizontal angle that it sees, the smaller half."""
        K, width = self.intrinsics.K, self.intrinsics.width_px
        sides = np.array([K[0, 2] + 0.5, width - 0.5 - K[0, 2]])
        return float(np.arctan(sides / K[0, 0]).min())


@dataclass(frozen=True, slots=True)
class Sightings:
    """From when things were seen: one row for each visit, since errors differ between visits.

    thing : (S,) index of what was seen. stamps_ns : (S,) of one image of the visit.
    A visit ends where a thing was not seen for 10 s.
    """

    thing: Ints
    stamps_ns: Stamps


@dataclass(frozen=True, slots=True)
class ObstacleTruth:
    """The obstacles that noise-free images saw, and every surface that a map may rightly show.

    A map in the plane has one cell for all that stands in a column: so surface points count by
    cells of 5 cm, for each solid its own.

    cells_map    : (C, 2) m, place frame, mean of the seen surface points in each cell.
    heights_m    : (C, 2) the lowest and the highest of them.
    solid        : (C,) index into ``names``.
    low          : (C,) whether it is of a solid that lies wholly below the planes of all lidars, or
                   nothing that a lidar sees stands in its plane within 10 cm.
    sightings    : of the cells.
    surfaces_map : (Q, 2) of all static things between the heights, and in the lidars' planes.
    section_map  : (R, 2) of those in the lidars' planes that a lidar sees.
    movers       : what has no one place and is in none of these.
    views, T_map_base : the cameras, and the true trajectory.
    """

    names: tuple[str, ...]
    cells_map: Array
    heights_m: Array
    solid: Ints
    low: Mask
    sightings: Sightings
    surfaces_map: Array
    section_map: Array
    movers: tuple[str, ...]
    views: tuple[CameraView, ...]
    T_map_base: Trajectory


_truths: dict[str, ObstacleTruth] = {}


def obstacle_truth(
    place: Place,
    T_map_base: Trajectory,
    views: Sequence[CameraView],
    lidar_heights_m: Sequence[float],
    start_ns: int,
) -> ObstacleTruth:
    """Which surfaces between 0.05 and 1.0 m cameras saw within 3.5 m in three images or more.

    T_map_base : the true trajectory, in the place's frame.
    start_ns   : the stamp at which the place's time begins, for what moves.

    Seen is a patch of 5 cm x 5 cm of a vertical face, or at the edge of a horizontal one, if
    its middle lies in the image, not hidden, on a material that returns something to the camera,
    and it covers a pixel at least. The last results are kept: the same question costs nothing.
    """
    key = _digest(place, T_map_base, views, lidar_heights_m, start_ns)
    if key not in _truths:
        while len(_truths) >= TRUTHS_KEPT:
            del _truths[next(iter(_truths))]
        _truths[key] = _obstacle_truth(place, T_map_base, tuple(views), lidar_heights_m, start_ns)
    return _truths[key]


def _obstacle_truth(
    place: Place,
    T_map_base: Trajectory,
    views: tuple[CameraView, ...],
    lidar_heights_m: Sequence[float],
    start_ns: int,
) -> ObstacleTruth:
    from scipy.spatial import cKDTree  # noqa: PLC0415

    surfaces = sample_surfaces(place.solids, LOW_M, HIGH_M)
    seen_by_lidar = [solid for solid in place.solids if solid.material.lidar == "opaque"]
    planes = [section_points(seen_by_lidar, height_m) for height_m in lidar_heights_m]
    section = np.concatenate([np.empty((0, 2)), *planes])
    returns = np.array([solid.material.depth == "opaque" for solid in place.solids], dtype=np.bool_)
    candidates = _chosen(surfaces, surfaces.upright & returns[surfaces.solid])
    point, stamps_ns = _seen(place, candidates, T_map_base, views, start_ns)
    often = np.bincount(point, minlength=len(candidates.solid)) >= LEAST_SIGHTINGS
    kept = often[point]
    cell_of, cells, heights_m, solid = _cells(candidates, often)
    apart_m = cKDTree(section).query(cells)[0] if len(section) else np.full(len(cells), np.inf)
    tops_m = np.array([solid.vertices[:, 2].max() for solid in place.solids])
    wholly_low = tops_m < min(lidar_heights_m, default=np.inf)
    return ObstacleTruth(
        names=tuple(solid.name for solid in place.solids),
        cells_map=cells,
        heights_m=heights_m,
        solid=solid,
        low=(apart_m > BESIDE_M) | wholly_low[solid],
        sightings=by_visit(cell_of[point[kept]], stamps_ns[kept]),
        surfaces_map=np.concatenate([surfaces.points_map[:, :2], section]),
        section_map=section,
        movers=tuple(mover.name for mover in place.movers),
        views=views,
        T_map_base=T_map_base,
    )


def by_visit(thing: Ints, stamps_ns: Stamps, cost: Array | None = None) -> Sightings:
    """One sighting of each visit: that of least cost, or without costs the middle one."""
    order = np.lexsort((stamps_ns, thing))
    thing, stamps_ns = thing[order], stamps_ns[order]
    new = (np.diff(thing) != 0) | (np.diff(stamps_ns) > VISIT_GAP_NS)
    bounds = [0, *(np.flatnonzero(new) + 1).tolist(), thing.size]
    if cost is None:
        chosen = [(a + b) // 2 for a, b in pairwise(bounds) if b > a]
    else:
        chosen = [a + int(np.argmin(cost[order[a:b]])) for a, b in pairwise(bounds) if b > a]
    return Sightings(thing[chosen], stamps_ns[chosen])


@dataclass(frozen=True, slots=True)
class _Tiles:
    """Points by tiles of a metre: an image needs few of a large place.

    centres : (K, 2). members : of each tile, the points' indices.
    """

    centres: Array
    members: tuple[Ints, ...]

    @classmethod
    def of(cls, points: SurfacePoints) -> Self:
        tiles = np.floor(points.points_map[:, :2]).astype(np.int64)
        unique, inverse = np.unique(tiles, axis=0, return_inverse=True)
        order = np.argsort(inverse.reshape(-1), kind="stable")
        ends = np.cumsum(np.bincount(inverse.reshape(-1), minlength=len(unique)))
        return cls(unique.astype(np.float64) + 0.5, tuple(np.split(order, ends[:-1])))

    def around(self, place: Array) -> Ints:
        """All points within reach of an image taken there, and some more."""
        apart_m = np.hypot(*(self.centres - place).T)
        reached = np.flatnonzero(apart_m < WITHIN_M + np.sqrt(0.5)).tolist()
        return np.concatenate([np.empty(0, dtype=np.int64), *(self.members[k] for k in reached)])


def _seen(
    place: Place,
    points: SurfacePoints,
    T_map_base: Trajectory,
    views: Sequence[CameraView],
    start_ns: int,
) -> tuple[Ints, Stamps]:
    """(point, stamp) of every sighting, an image after the other."""
    scene, tiles = Scene(place), _Tiles.of(points)
    found: list[tuple[Ints, int]] = []
    for view in views:
        rows = T_map_base.at(view.stamps_ns)
        for stamp_ns, row in zip(view.stamps_ns.tolist(), rows, strict=True):
            T_map_camera = standing(row) @ view.T_base_camera
            near = tiles.around(T_map_camera[:2, 3])
            index, rays = _in_view(points, near, T_map_camera, view)
            if not index.size:
                continue
            hits = scene.first_hits(rays, "depth", (stamp_ns - start_ns) * 1e-9)
            length_m = np.linalg.norm(rays[:, 3:], axis=1)
            found.append((index[(1.0 - hits.distance_m) * length_m < HIDDEN_M], stamp_ns))
    counts = [index.size for index, _ in found]
    every = np.concatenate([np.empty(0, dtype=np.int64), *(index for index, _ in found)])
    stamps_ns = np.array([stamp_ns for _, stamp_ns in found], dtype=np.int64)
    return every, np.repeat(stamps_ns, counts)


def _in_view(
    points: SurfacePoints, near: Ints, T_map_camera: Array, view: CameraView
) -> tuple[Ints, npt.NDArray[np.float32]]:
    """(indices (N,), rays (N, 6)) of those points that would be seen if nothing hid them.

    A patch of area A covers A cos(incidence) / d^2 of the sphere, a pixel (z / d)^3 / (fx fy).
    """
    origin, K = T_map_camera[:3, 3], view.intrinsics.K
    offset = points.points_map[near] - origin
    length = np.linalg.norm(offset, axis=1)
    x, y, z = (offset @ T_map_camera[:3, :3]).T
    facing = -(offset * points.normals[near]).sum(axis=1) / length
    ahead = (z > view.nearest_m) & (length < WITHIN_M) & (facing > 0.0)
    z = np.where(ahead, z, 1.0)
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    pixels = points.areas_m2[near] * facing * length * K[0, 0] * K[1, 1] / z**3
    ahead &= (u > -0.5) & (u < view.intrinsics.width_px - 0.5) & (pixels >= 1.0)
    ahead &= (v > -0.5) & (v < view.intrinsics.height_px - 0.5)
    rays = np.hstack([np.broadcast_to(origin, (int(ahead.sum()), 3)), offset[ahead]])
    return near[ahead], np.ascontiguousarray(rays, dtype=np.float32)


def _cells(points: SurfacePoints, often: Mask) -> tuple[Ints, Array, Array, Ints]:
    """(cell of each point or -1, mean positions, lowest and highest, solid) of the cells."""
    kept = np.flatnonzero(often)
    at = points.points_map[kept]
    steps = np.floor((at[:, :2] + CELL_SHIFT_M) / CELL_M).astype(np.int64)
    keys = np.column_stack([points.solid[kept], steps])
    unique, inverse = np.unique(keys, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    counts = np.bincount(inverse, minlength=len(unique))
    sums = [np.bincount(inverse, at[:, k], minlength=len(unique)) for k in (0, 1)]
    heights_m = np.column_stack([np.full(len(unique), np.inf), np.full(len(unique), -np.inf)])
    np.minimum.at(heights_m[:, 0], inverse, at[:, 2])
    np.maximum.at(heights_m[:, 1], inverse, at[:, 2])
    cell_of = np.full(len(points.solid), -1, dtype=np.int64)
    cell_of[kept] = inverse
    return cell_of, np.column_stack(sums) / counts[:, None], heights_m, unique[:, 0]


def _chosen(points: SurfacePoints, mask: Mask) -> SurfacePoints:
    return SurfacePoints(
        points.points_map[mask],
        points.normals[mask],
        points.areas_m2[mask],
        points.solid[mask],
        points.upright[mask],
    )


def _digest(
    place: Place,
    T_map_base: Trajectory,
    views: Sequence[CameraView],
    lidar_heights_m: Sequence[float],
    start_ns: int,
) -> str:
    """The same for the same inputs, whatever objects they come in."""
    digest = hashlib.sha256(repr((tuple(lidar_heights_m), start_ns)).encode())
    for part in _parts(place, T_map_base, views):
        digest.update(part)
    return digest.hexdigest()


def _parts(place: Place, T_map_base: Trajectory, views: Sequence[CameraView]) -> Iterator[bytes]:
    for solid in (*place.solids, *(mover.solid for mover in place.movers)):
        yield repr((solid.name, solid.material)).encode()
        yield solid.vertices.tobytes()
        yield solid.triangles.tobytes()
    for mover in place.movers:
        yield mover.stamps_s.tobytes() + mover.xyyaw.tobytes() + bytes([mover.loop])
    yield T_map_base.stamps_ns.tobytes() + T_map_base.xyyaw.tobytes()
    for view in views:
        yield view.T_base_camera.tobytes() + view.intrinsics.K.tobytes()
        size = (view.intrinsics.width_px, view.intrinsics.height_px, view.nearest_m)
        yield repr(size).encode() + view.stamps_ns.tobytes()
