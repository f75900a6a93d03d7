"""Recordings of a robot among vertical walls on a floor, without noise: every pixel by formula."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from datasets.calibration_file import T_BODY_OPTICAL, mounting
from datasets.messages import Array, DepthImage, Float32s, LaserScan, Message, Odometry
from datasets.recording import Calibration, CameraCalibration, Intrinsics, LidarCalibration
from datasets.se2 import se2
from datasets.trajectory import Trajectory

Wall = tuple[tuple[float, float], tuple[float, float]]
PoseAt = Callable[[float], tuple[float, float, float]]

CORNER: tuple[Wall, ...] = (((3.0, -2.0), (3.0, 2.0)), ((-3.0, 2.0), (3.0, 2.0)))
THREE: tuple[Wall, ...] = (*CORNER, ((-3.0, -2.0), (3.0, -2.0)))
CORRIDOR: tuple[Wall, ...] = (((-30.0, 1.2), (30.0, 1.2)), ((-30.0, -1.2), (30.0, -1.2)))

PINHOLE = Intrinsics(np.array([[96.0, 0.0, 79.5], [0.0, 96.0, 59.5], [0.0, 0.0, 1.0]]), 160, 120)
START_NS = 1_700_000_000_000_000_000
CAMERA, LIDAR = "/depth", "/scan"


def body(values: Sequence[float]) -> Array:
    """T_base_camera, optical, of x, y, z m and roll, pitch, yaw deg."""
    x, y, z, roll, pitch, yaw = values
    angles = (math.radians(roll), math.radians(pitch), math.radians(yaw))
    return mounting((x, y, z), angles) @ T_BODY_OPTICAL


def swaying(time_s: float) -> tuple[float, float, float]:
    """Slowly ahead, looking left and right."""
    return 0.05 * time_s, 0.1 * math.sin(time_s), 0.5 * math.sin(0.7 * time_s)


def straight(time_s: float) -> tuple[float, float, float]:
    return 0.3 * time_s, 0.0, 0.0


@dataclass
class Room:
    """A ``Recording``: 10 s, 2 images and 5 turns of the lidar a second.

    clock_s : images are of so much later than their stamps.
    bearings : of the beams, rad.
    spoil   : what becomes of each image.
    """

    walls: Sequence[Wall]
    T_base_camera: Array
    pose: PoseAt = swaying
    floor: bool = True
    clock_s: float = 0.0
    bearings: Array = field(default_factory=lambda: np.linspace(-np.pi, np.pi, 720))
    spoil: Callable[[Float32s], Float32s] = lambda depth: depth
    name: str = "room"

    def __post_init__(self) -> None:
        T_base_lidar = mounting((0.05, 0.0, 0.9), (0.0, 0.0, 0.0))
        self.calibration = Calibration(
            {LIDAR: LidarCalibration(T_base_lidar)}, {CAMERA: CameraCalibration(None, PINHOLE)}
        )
        self.notes: Counter[str] = Counter()

    def ground_truth(self) -> Trajectory | None:
        return None

    def __iter__(self) -> Iterator[Message]:
        messages: list[Message] = [self._turn(k / 5.0) for k in range(50)]
        messages += [self._image(0.3 + k / 2.0) for k in range(19)]
        stamps = np.arange(0.0, 10.3, 0.02).tolist()
        messages += [Odometry(_stamp(time_s), se2(*self.pose(time_s))) for time_s in stamps]
        return iter(sorted(messages, key=lambda message: message.stamp_ns))

    def _turn(self, time_s: float) -> LaserScan:
        offsets_s = np.linspace(0.0, 0.19, len(self.bearings))
        T_base_lidar = self.calibration.lidars[LIDAR].T_base_lidar
        x, y, yaw = np.array([self.pose(t) for t in (time_s + offsets_s).tolist()]).T
        ahead, left = T_base_lidar[:2, 3]
        c, s = np.cos(yaw), np.sin(yaw)
        origins = np.column_stack([x + c * ahead - s * left, y + s * ahead + c * left])
        angles = yaw + self.bearings
        ranges = self._to_walls(origins, np.column_stack([np.cos(angles), np.sin(angles)]))
        return LaserScan(_stamp(time_s), LIDAR, ranges, self.bearings, offsets_s, 0.1, 40.0)

    def _image(self, time_s: float) -> DepthImage:
        x, y, yaw = self.pose(time_s + self.clock_s)
        T_map_camera = mounting((x, y, 0.0), (0.0, 0.0, yaw)) @ self.T_base_camera
        v, u = np.mgrid[0:120, 0:160]
        K = PINHOLE.K
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)
        rays_map = rays.reshape(-1, 3) @ T_map_camera[:3, :3].T
        depth = self._to_walls(T_map_camera[:2, 3], rays_map[:, :2])
        if self.floor:
            with np.errstate(divide="ignore"):
                down = T_map_camera[2, 3] / -rays_map[:, 2]
            depth = np.minimum(depth, np.where(down > 0.0, down, np.inf))
        depth[~(depth < 20.0)] = np.nan
        image = depth.reshape(120, 160).astype(np.float32)
        return DepthImage(_stamp(time_s), CAMERA, self.spoil(image))

    def _to_walls(self, origins: Array, rays: Array) -> Array:
        """Lengths, in lengths of the rays (N, 2), to the nearest wall; inf where there is none."""
        nearest = np.full(len(rays), np.inf)
        for start, end in self.walls:
            along = np.subtract(end, start)
            across = np.array([-along[1], along[0]])
            with np.errstate(divide="ignore", invalid="ignore"):
                length = (np.asarray(start) - origins) @ across / (rays @ across)
                at = (origins + length[:, None] * rays - start) @ along / (along @ along)
                hit = (length > 0.0) & (at >= 0.0) & (at <= 1.0)
            nearest[hit] = np.minimum(nearest[hit], length[hit])
        return nearest


def _stamp(time_s: float) -> int:
    return START_NS + round(time_s * 1e9)
