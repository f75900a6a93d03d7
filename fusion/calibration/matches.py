"""Which block of a depth image lies on which plane that is known in the base frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from fusion.calibration.blocks import DepthBlocks, DepthNoise
from fusion.calibration.floor import on_floor
from fusion.calibration.segments import Segments
from fusion.calibration.views import View

Bools = np.ndarray[tuple[int], np.dtype[np.bool_]]
Indices = np.ndarray[tuple[int], np.dtype[np.int64]]
Columns = npt.NDArray[Any]

WALL_FROM_M, WALL_TO_M = 0.12, 2.5
"""Above the floor; what is lower may be a skirting board, or the floor's noise."""

UPRIGHT = math.sin(math.radians(20.0))
"""How far a wall's normal may seem to leave the horizontal; noise does that as well."""

SAME_WAY = math.cos(math.radians(30.0))
FAR_SIGMA = 3.0


@dataclass(frozen=True, slots=True)
class Matches:
    """N blocks with the plane that each lies on; sorted by group.

    rays, inverse_depth : as in ``DepthBlocks``, optical frame.
    sigma   : (N,) 1/m, of the noise at the plane's depth.
    normals : (N, 3) of the plane, base frame; through points : (N, 3) m, base frame.
    sensors : (N, 3) m, base frame, where the lidar stood that saw the plane; of the floor, 0.
    groups  : (N,) which plane in which image; errors of one group are common to it.
    floor   : (N,) whether it is the floor.
    views   : (N,) which image.
    velocity_base : (N, 3) of the base at the image.
    """

    rays: Array
    inverse_depth: Array
    sigma: Array
    normals: Array
    points: Array
    sensors: Array
    groups: Indices
    floor: Bools
    views: Indices
    velocity_base: Array

    def __len__(self) -> int:
        return len(self.groups)


def match(
    views: list[View],
    T_base_camera: Array,
    floor_z_m: float,
    gate_m: float,
    noise: DepthNoise,
    *,
    floor: bool,
) -> Matches:
    """Match the blocks of all views with walls and floor, for a mounting.

    floor_z_m : height of the floor in the base frame.
    gate_m    : a block belongs to a wall within it, and its noise.
    floor     : whether the mounting's height and level come from the floor, so that it can be told.
    """
    parts: list[tuple[Columns, ...]] = []
    for index, view in enumerate(views):
        blocks = view.blocks
        wall = _walls_of(blocks, view.walls, T_base_camera, floor_z_m, gate_m)
        ground = np.zeros(len(blocks), dtype=np.bool_)
        if floor:
            height_m = float(T_base_camera[2, 3]) - floor_z_m
            ground = on_floor(blocks, T_base_camera[2, :3], height_m)
        plane = np.where(ground, -1, np.where(wall >= 0, wall, -2))
        kept = np.flatnonzero(plane >= -1)
        kept = kept[np.argsort(plane[kept], kind="stable")]
        parts.append(_rows(index, view, blocks.chosen(kept), plane[kept], floor_z_m))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    rays, q, normals, points, sensors, plane, number, velocity = columns
    # Noise and reach go by where the planes are. By what was measured, what seems near would count
    # more than what seems far, and pull.
    R, t = T_base_camera[:3, :3], T_base_camera[:3, 3]
    towards = np.einsum("nx,nx->n", normals, rays @ R.T)
    away = np.einsum("nx,nx->n", normals, points - t)
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = towards / away
    near = expected > 1.0 / noise.farthest_m
    sigma = noise.of_inverse_depth(expected[near], views[0].blocks.focal_px)
    groups = np.unique(number[near] * 100_000 + plane[near] + 1, return_inverse=True)[1]
    return Matches(
        *(rays[near], q[near], sigma, normals[near], points[near], sensors[near], groups),
        *(plane[near] == -1, number[near], velocity[near]),
    )


def upright_points(blocks: DepthBlocks, T_base_camera: Array, floor_z_m: float) -> Array:
    """(K, 2) m, base frame: the blocks that stand upright, clear of the floor."""
    points = (blocks.rays / blocks.inverse_depth[:, None]) @ T_base_camera[:3, :3].T
    points = points + T_base_camera[:3, 3]
    kept = _upright(blocks, T_base_camera, points[:, 2] - floor_z_m)
    return np.asarray(points[kept, :2])


def _upright(blocks: DepthBlocks, T_base_camera: Array, height_m: Array) -> Bools:
    leaning = np.abs(blocks.normals @ T_base_camera[2, :3])
    upright: Bools = (leaning < UPRIGHT) & (height_m > WALL_FROM_M) & (height_m < WALL_TO_M)
    return upright


def _rows(
    index: int, view: View, blocks: DepthBlocks, plane: Indices, floor_z_m: float
) -> tuple[Columns, ...]:
    count, flat = len(blocks), plane < 0
    normals, points, sensors = (np.zeros((count, 3)) for _ in range(3))
    normals[flat, 2] = 1.0
    points[flat, 2] = floor_z_m
    of = plane[~flat]
    normals[~flat, :2] = view.walls.normals[of]
    points[~flat, :2] = view.walls.middles[of]
    sensors[~flat, :2] = view.walls.sensors[of]
    measured = (blocks.rays, blocks.inverse_depth)
    velocity = np.broadcast_to(view.velocity_base, (count, 3))
    number = np.full(count, index, dtype=np.int64)
    return (*measured, normals, points, sensors, plane, number, velocity)


def _walls_of(
    blocks: DepthBlocks, walls: Segments, T_base_camera: Array, floor_z_m: float, gate_m: float
) -> Indices:
    """The wall that each block lies on, (N,), -1 for none."""
    R, t = T_base_camera[:3, :3], T_base_camera[:3, 3]
    points = (blocks.rays / blocks.inverse_depth[:, None]) @ R.T + t
    normals = blocks.normals @ R.T
    asked = np.flatnonzero(_upright(blocks, T_base_camera, points[:, 2] - floor_z_m))
    found = np.full(len(blocks), -1, dtype=np.int64)
    if not len(walls) or not len(asked):
        return found
    n = normals[asked, :2] / np.linalg.norm(normals[asked, :2], axis=1)[:, None]
    p = points[asked, :2]
    across = p @ walls.normals.T - np.einsum("sx,sx->s", walls.middles, walls.normals)
    tangents = np.column_stack([-walls.normals[:, 1], walls.normals[:, 0]])
    along = p @ tangents.T - np.einsum("sx,sx->s", walls.middles, tangents)
    # sigma of the distance from the wall: that of the depth, times the cosine of incidence
    rays = blocks.rays[asked] @ R.T
    depth_sigma_m = blocks.sigma[asked] / blocks.inverse_depth[asked] ** 2
    sigma_m = np.abs(rays[:, :2] @ walls.normals.T) * depth_sigma_m[:, None]
    facing = (t[:2] @ walls.normals.T) > np.einsum("sx,sx->s", walls.middles, walls.normals)
    fits = (
        (np.abs(across) < gate_m + FAR_SIGMA * sigma_m)
        & (np.abs(along) < walls.half_lengths_m)
        & (n @ walls.normals.T > SAME_WAY)
        & facing
    )
    away = np.where(fits, np.abs(across), np.inf)
    best = np.argmin(away, axis=1)
    hit = np.isfinite(away[np.arange(len(asked)), best])
    found[asked[hit]] = best[hit]
    return found
