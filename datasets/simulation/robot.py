"""Robots that drive through simulated places: which sensors stand where, and how well they see."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

from datasets.calibration_file import T_BODY_OPTICAL, mounting
from datasets.messages import Array
from datasets.simulation.depth_camera import DepthModel
from datasets.simulation.lidar import G4, LidarModel
from datasets.simulation.place_file import RobotName
from datasets.simulation.wheels import GyroErrors, WheelErrors

SCAN, LOW_SCAN = "/scan", "/scan_low"
"""Topics of lidars, which are their names."""
DEPTH = "/camera/depth/image_rect_raw"
"""Topic of the depth camera's images, which is its name."""


class MountedLidar(NamedTuple):
    """T_base_lidar : (4, 4)."""

    T_base_lidar: Array
    model: LidarModel = G4


class MountedCamera(NamedTuple):
    """T_base_camera : (4, 4), of the optical frame (z forward, x right, y down)."""

    T_base_camera: Array
    model: DepthModel
    rate_hz: float = 5.0


@dataclass(frozen=True, slots=True)
class Robot:
    """What a base carries; lidars and cameras by their topics.

    wheels : None if nothing counts their turns: then there is no odometry.
    gyro   : if there is one, the odometry's heading is its integral, not the wheels'.
    """

    lidars: Mapping[str, MountedLidar]
    cameras: Mapping[str, MountedCamera] = field(default_factory=dict)
    wheels: WheelErrors | None = WheelErrors()  # noqa: RUF009  # frozen, so one serves all
    gyro: GyroErrors | None = None
    odometry_rate_hz: float = 50.0

    def seeing(self, depth: DepthModel | None, rate_hz: float) -> Robot:
        """The same robot with other depth cameras, or None its own, at another rate."""
        cameras = {
            name: MountedCamera(camera.T_base_camera, depth or camera.model, rate_hz)
            for name, camera in self.cameras.items()
        }
        return replace(self, cameras=cameras)


SLIPPERY = WheelErrors(slip_bouts_per_m=0.2, slip_bout_m=0.5, slip_share=0.5)
"""Wheels on a wet or polished floor: every 5 m they lose up to half of some half a metre."""


def _camera(
    x_m: float, y_m: float, z_m: float, *, roll: float = 0.0, down: float = 0.0, yaw: float = 0.0
) -> dict[str, MountedCamera]:
    """A camera with its body at a place of the base; angles in degrees."""
    T_base_body = mounting(
        (x_m, y_m, z_m), (math.radians(roll), math.radians(down), math.radians(yaw))
    )
    return {DEPTH: MountedCamera(T_base_body @ T_BODY_OPTICAL, DepthModel(mode="640x480"))}


def _lidar(z_m: float) -> MountedLidar:
    return MountedLidar(mounting((0.0, 0.0, z_m), (0.0, 0.0, 0.0)))


_HIGH = {SCAN: _lidar(0.895)}

ROBOTS: Mapping[RobotName, Robot] = MappingProxyType(
    {
        "paper": Robot(_HIGH, _camera(0.15, 0.0, 0.25)),
        "tilted": Robot(_HIGH, _camera(0.15, 0.0, 0.6, down=15.0)),
        "rolled": Robot(_HIGH, _camera(0.15, 0.0, 0.25, roll=10.0)),
        "offset": Robot(_HIGH, _camera(0.1, 0.2, 0.25, yaw=15.0)),
        "two-lidars": Robot(_HIGH | {LOW_SCAN: _lidar(0.15)}),
        "low-lidar": Robot({SCAN: _lidar(0.5)}, _camera(0.15, 0.0, 0.25)),
        "gyro": Robot(_HIGH, _camera(0.15, 0.0, 0.25), gyro=GyroErrors()),
    }
)
"""The paper's robot, and others that differ from it in one thing: see `docs/simulation.md`."""
