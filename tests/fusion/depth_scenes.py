"""Depth cameras on a base, and exact or simulated images of boxes on a floor."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from datasets.messages import Array, DepthImage
from datasets.recording import CameraCalibration, Intrinsics
from datasets.simulation.depth_camera import MODES, DepthModel, simulate_depth
from datasets.simulation.place import MATERIALS, Place, Solid
from datasets.simulation.scene import Scene

FACES = [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6)]
FACES += [(0, 2, 6), (0, 6, 4), (1, 7, 3), (1, 5, 7)]
Corner = tuple[float, float, float]


def rotation(axis: int, angle_rad: float) -> Array:
    """(3, 3), right-handed, about x, y or z."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[first, first] = R[second, second] = c
    R[first, second], R[second, first] = -s, s
    return R


def mounting(
    at: Corner = (0.0, 0.0, 0.25), roll_rad: float = 0.0, pitch_rad: float = 0.0, yaw: float = 0.0
) -> Array:
    """T_base_camera; pitch looks down, yaw to the left."""
    T = np.eye(4)
    optical = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T[:3, :3] = rotation(2, yaw) @ rotation(1, pitch_rad) @ rotation(0, roll_rad) @ optical
    T[:3, 3] = at
    return T


def calibration(
    T_base_camera: Array | None, width: int = 160, height: int = 120, focal_px: float = 96.0
) -> CameraCalibration:
    K = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1.0]])
    return CameraCalibration(T_base_camera, Intrinsics(K, width, height))


def of_model(T_base_camera: Array, model: DepthModel) -> CameraCalibration:
    mode = MODES[model.mode]
    return CameraCalibration(T_base_camera, Intrinsics(model.K, mode.width, mode.height))


def exact_image(camera: CameraCalibration, *planes: tuple[Array, float]) -> DepthImage:
    """Depth of the nearest of some planes, n . x = d in the base frame; NaN where none is seen."""
    assert camera.intrinsics is not None
    assert camera.T_base_camera is not None
    K = camera.intrinsics.K
    v, u = np.mgrid[0 : camera.intrinsics.height_px, 0 : camera.intrinsics.width_px]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)])
    rays_base = np.einsum("ij,jhw->ihw", camera.T_base_camera[:3, :3], rays)
    depth = np.full(u.shape, np.inf)
    for normal, distance in planes:
        along = np.einsum("i,ihw->hw", normal, rays_base)
        gap = distance - normal @ camera.T_base_camera[:3, 3]
        z = np.divide(gap, along, out=np.full(u.shape, np.inf), where=np.abs(along) > 1e-9)
        depth = np.where((z > 0) & (z < depth), z, depth)
    return DepthImage(7, "cam", np.where(np.isfinite(depth), depth, np.nan).astype(np.float32))


def box(low: Corner, high: Corner) -> Solid:
    corners = np.array(list(product(*zip(low, high, strict=True))), dtype=np.float32)
    return Solid("box", corners, np.array(FACES, dtype=np.uint32), MATERIALS["wall"])


FLOOR = box((-60.0, -60.0, -1.0), (60.0, 60.0, 0.0))


def simulated(T_base_camera: Array, model: DepthModel, seed: int, *solids: Solid) -> DepthImage:
    """What the simulated sensor makes of solids, holes NaN as readers give them."""
    scene = Scene(Place("test", solids, floor=False))
    depth = simulate_depth(scene, T_base_camera, model, np.random.default_rng(seed), 0.0)
    return DepthImage(7, "cam", np.where(depth > 0, depth, np.nan).astype(np.float32))
