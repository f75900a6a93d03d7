"""A place as its sensors see it: rays in, first hits out (Open3D's RaycastingScene, on Embree)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.open3d_import import import_open3d
from datasets.simulation.place import Material, Mover, Place, Solid
from datasets.simulation.scene_kernels import rays_near_spheres

Float32s = npt.NDArray[np.float32]
Sensor = Literal["lidar", "depth"]
_RaycastingScene = Any  # Open3D is imported when a scene is first looked at


@dataclass(frozen=True, slots=True)
class Hits:
    """What N rays meet first.

    distance_m : (N,) float32, in lengths of the ray's direction; inf where nothing is met.
    normals    : (N, 3) float32, unit, map frame, on either side of the surface; 0 without a hit.
    materials  : (N,) int32, index into ``Scene.materials``; -1 where nothing is met.
    """

    distance_m: Float32s
    normals: Float32s
    materials: npt.NDArray[np.int32]


class Scene:
    """The static solids of a place, and its movers where they are at a time.

    materials : those of the place, as ``Hits.materials`` counts them.

    A material that is clear to lidars is not there for them. One that is invisible to the depth
    camera hides what is behind it from the camera all the same.
    """

    def __init__(self, place: Place) -> None:
        self._solids = place.solids
        self._movers = place.movers
        movers_solids = tuple(mover.solid for mover in place.movers)
        found = dict.fromkeys(solid.material for solid in self._solids + movers_solids)
        # Clear ones last: a lidar's scene ends before them and keeps the others' numbers.
        self.materials: tuple[Material, ...] = tuple(
            sorted(found, key=lambda material: material.lidar == "clear")
        )
        self._seen_by = {
            "lidar": sum(material.lidar == "opaque" for material in self.materials),
            "depth": len(self.materials),
        }
        self._spheres = [_bounding_sphere(solid) for solid in movers_solids]
        self._static: dict[int, _RaycastingScene] = {}
        self._moved: tuple[float, int, _RaycastingScene] | None = None

    def cast(self, origins: Float32s, directions: Float32s, sensor: Sensor, time_s: float) -> Hits:
        """What a sensor's rays return from.

        origins, directions : (N, 3) float32, map frame, m; directions unit.

        Where a depth camera meets what is invisible to it, ``distance_m`` is inf and ``materials``
        says what it was. Raises ValueError if shapes disagree.
        """
        if origins.shape != directions.shape or origins.ndim != 2 or origins.shape[1] != 3:
            raise ValueError(f"origins {origins.shape}, directions {directions.shape}: not (N, 3)")
        rays = np.hstack([origins, directions]).astype(np.float32, copy=False)
        hits = self.first_hits(rays, sensor, time_s)
        if sensor == "depth":
            unseen = [material.depth == "invisible" for material in self.materials]
            hits.distance_m[np.array([*unseen, False])[hits.materials]] = np.inf
        return hits

    def first_hits(self, rays: Float32s, sensor: Sensor, time_s: float) -> Hits:
        """The first surface on each ray, whether it returns anything to a depth camera or not.

        rays : (N, 6) float32, C-contiguous: origin m and direction (any length), map frame.
        """
        seen = self._seen_by[sensor]
        if seen not in self._static:
            self._static[seen] = self._built(self._solids, seen)
        hits = _cast(self._static[seen], rays)
        if not self._movers:
            return hits
        poses = [mover.T_map_mover(time_s) for mover in self._movers]
        near = rays_near_spheres(rays, self._spheres_at(poses))
        if near.size == 0:
            return hits
        if self._moved is None or self._moved[:2] != (time_s, seen):
            placed = [_placed(mover, T) for mover, T in zip(self._movers, poses, strict=True)]
            self._moved = (time_s, seen, self._built(placed, seen))
        moving = _cast(self._moved[2], rays[near])
        nearer = moving.distance_m < hits.distance_m[near]
        changed = near[nearer]
        hits.distance_m[changed] = moving.distance_m[nearer]
        hits.normals[changed] = moving.normals[nearer]
        hits.materials[changed] = moving.materials[nearer]
        return hits

    def _spheres_at(self, poses: Sequence[Array]) -> Float32s:
        centres = [
            T[:3, :3] @ sphere[:3] + T[:3, 3]
            for T, sphere in zip(poses, self._spheres, strict=True)
        ]
        return np.column_stack([centres, [sphere[3] for sphere in self._spheres]]).astype(
            np.float32
        )

    def _built(self, solids: Sequence[Solid], seen: int) -> _RaycastingScene:
        """A RaycastingScene of one geometry a material, so that its number is the material's."""
        open3d = import_open3d()
        tensor = open3d.core.Tensor.from_numpy
        scene = open3d.t.geometry.RaycastingScene()
        for material in self.materials[:seen]:
            made_of_it = [solid for solid in solids if solid.material == material]
            vertices, triangles = _merged(made_of_it)
            scene.add_triangles(tensor(vertices), tensor(triangles))
        return scene


def _cast(scene: _RaycastingScene, rays: Float32s) -> Hits:
    answer = scene.cast_rays(import_open3d().core.Tensor.from_numpy(rays))
    # The number for "nothing" has all bits set, which is -1.
    materials = answer["geometry_ids"].numpy().view(np.int32)
    return Hits(answer["t_hit"].numpy(), answer["primitive_normals"].numpy(), materials)


def _merged(solids: Sequence[Solid]) -> tuple[Float32s, npt.NDArray[np.uint32]]:
    """Vertices (V, 3) and triangles (T, 3) of several solids as one mesh."""
    vertices: list[Float32s] = [np.zeros((0, 3), np.float32), *(solid.vertices for solid in solids)]
    triangles = [np.zeros((0, 3), np.uint32)]
    first = 0
    for solid in solids:
        triangles.append(solid.triangles + np.uint32(first))
        first += len(solid.vertices)
    return np.concatenate(vertices), np.concatenate(triangles)


def _placed(mover: Mover, T_map_mover: Array) -> Solid:
    vertices = mover.solid.vertices @ T_map_mover[:3, :3].T + T_map_mover[:3, 3]
    return replace(mover.solid, vertices=vertices.astype(np.float32))


def _bounding_sphere(solid: Solid) -> Array:
    """Centre and radius, (4,), m, with a millimetre to spare."""
    centre = (solid.vertices.min(axis=0) + solid.vertices.max(axis=0)) / 2
    radius_m = np.linalg.norm(solid.vertices - centre, axis=1).max() + 1e-3
    return np.append(centre, radius_m).astype(np.float64)
