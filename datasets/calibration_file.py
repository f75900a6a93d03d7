"""The calibration YAML: what a person knows about the robot and the recording doesn't say.

    lidars:
      /scan_low:                       # topic; in a CARMEN log: front, rear
        mounting: {x_m: 0.31, y_m: 0.0, z_m: 0.1, roll_deg: 180, pitch_deg: 0, yaw_deg: 0}
        mask_deg: [[-180, -150], [150, 180]]
        clock_offset_s: -0.08
    cameras:
      /camera/depth:                   # topic; the mounting is that of the body, x looking ahead
        mounting: {x_m: 0.15, z_m: 0.25, pitch_deg: 5}
        intrinsics: {width_px: 640, height_px: 480, fx_px: 384, fy_px: 384, cx_px: 320, cy_px: 240}
        clock_offset_s: 0.03
    odometry: /odom                    # topic, or "tf"
    ground_truth: /true_pose           # topic

Everything may be left out; what stands here goes before what the recording says.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from datasets.errors import InputError
from datasets.messages import Array
from datasets.recording import CameraCalibration, Intrinsics, LidarCalibration
from datasets.yaml_file import MarkedYaml

EXAMPLE = "lidars: {/scan: {mounting: {x_m: 0.2, yaw_deg: 180}, mask_deg: [[150, 180]]}}"


@dataclass(frozen=True, slots=True)
class LidarSettings:
    """What the file says about one lidar.

    T_base_lidar    : (4, 4), or None where the file has no mounting.
    masks_rad       : as in ``LidarCalibration``.
    clock_offset_ns : to be added to the lidar's stamps.
    """

    T_base_lidar: Array | None = None
    masks_rad: tuple[tuple[float, float], ...] = ()
    clock_offset_ns: int = 0


@dataclass(frozen=True, slots=True)
class CalibrationFile:
    """A calibration YAML that has been read; empty (and path None) where none was given.

    camera_clock_offsets_ns : to be added to the stamps of a camera, by its name.
    """

    path: Path | None = None
    lidars: Mapping[str, LidarSettings] = field(default_factory=dict)
    odometry: str | None = None
    ground_truth: str | None = None
    cameras: Mapping[str, CameraCalibration] = field(default_factory=dict)
    camera_clock_offsets_ns: Mapping[str, int] = field(default_factory=dict)

    def lidar(self, name: str, recorded_T_base_lidar: Array | None) -> LidarCalibration | None:
        """The calibration of a lidar: the file's mounting, else the recording's, else None."""
        settings = self.lidars.get(name, LidarSettings())
        T_base_lidar = settings.T_base_lidar
        if T_base_lidar is None:
            T_base_lidar = recorded_T_base_lidar
        if T_base_lidar is None:
            return None
        return LidarCalibration(T_base_lidar, settings.masks_rad)

    def clock_offset_ns(self, name: str) -> int:
        """What to add to the stamps of a lidar."""
        return self.lidars.get(name, LidarSettings()).clock_offset_ns

    def require_known(self, names: Collection[str]) -> None:
        """Raise InputError if the file speaks of a lidar that is not among ``names``."""
        self._require("lidar", self.lidars, names)

    def require_known_cameras(self, names: Collection[str]) -> None:
        """Raise InputError if the file speaks of a depth camera that is not among ``names``."""
        self._require("camera", self.cameras, names)

    def _require(self, kind: str, said: Collection[str], names: Collection[str]) -> None:
        for name in said:
            if name not in names:
                raise InputError(
                    f"there is no such {kind} in the recording",
                    where=f"{self.path}, key {kind}s.{name}",
                    remedy=f"The recording has: {', '.join(sorted(names)) or 'none'}",
                )


def read_calibration_file(path: Path | None) -> CalibrationFile:
    """Read a calibration YAML; None gives the empty one.

    Raises InputError that names file, line, key and remedy if it can't be read or says something
    that is not understood.
    """
    if path is None:
        return CalibrationFile()
    source = MarkedYaml.read(
        path,
        "the calibration file",
        f"An example: {EXAMPLE}",
        "Check the path given with --calibration",
    )
    schema = source.validate(_File)
    settings = {name: _settings(lidar) for name, lidar in schema.lidars.items()}
    cameras = {name: _camera(camera) for name, camera in schema.cameras.items()}
    clocks = {name: round(camera.clock_offset_s * 1e9) for name, camera in schema.cameras.items()}
    return CalibrationFile(path, settings, schema.odometry, schema.ground_truth, cameras, clocks)


Triple = tuple[float, float, float]


def mounting(xyz_m: Triple, roll_pitch_yaw_rad: Triple) -> Array:
    """The (4, 4) matrix T_base_lidar; angles about the fixed axes x, y, z in that order."""
    x_m, y_m, z_m = xyz_m
    (cr, cp, cy), (sr, sp, sy) = (tuple(map(f, roll_pitch_yaw_rad)) for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x_m],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y_m],
            [-sp, cp * sr, cp * cr, z_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _interval(mask_deg: tuple[float, float]) -> tuple[float, float]:
    start_deg, end_deg = mask_deg
    if not (-360.0 <= start_deg <= 360.0 and -360.0 <= end_deg <= 360.0):
        raise ValueError("the ends of a mask are angles from -360 to 360")
    if (end_deg - start_deg) % 360.0 == 0.0:
        raise ValueError("a mask runs from one angle to another, such as [150, 180]")
    return mask_deg


_Mask = Annotated[tuple[float, float], AfterValidator(_interval)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class _Mounting(_Section):
    x_m: float = Field(0.0, ge=-100.0, le=100.0)
    y_m: float = Field(0.0, ge=-100.0, le=100.0)
    z_m: float = Field(0.0, ge=-100.0, le=100.0)
    roll_deg: float = Field(0.0, ge=-360.0, le=360.0)
    pitch_deg: float = Field(0.0, ge=-360.0, le=360.0)
    yaw_deg: float = Field(0.0, ge=-360.0, le=360.0)


class _Lidar(_Section):
    mounting: _Mounting | None = None
    mask_deg: tuple[_Mask, ...] = ()
    clock_offset_s: float = Field(0.0, ge=-4e9, le=4e9)  # a clock that starts at 1970


class _Intrinsics(_Section):
    width_px: int = Field(gt=0, le=20_000)
    height_px: int = Field(gt=0, le=20_000)
    fx_px: float = Field(gt=0.0, le=1e5)
    fy_px: float = Field(gt=0.0, le=1e5)
    cx_px: float = Field(ge=-1e5, le=1e5)
    cy_px: float = Field(ge=-1e5, le=1e5)


class _Camera(_Section):
    mounting: _Mounting | None = None
    intrinsics: _Intrinsics | None = None
    clock_offset_s: float = Field(0.0, ge=-4e9, le=4e9)


class _File(_Section):
    lidars: dict[str, _Lidar] = {}
    cameras: dict[str, _Camera] = {}
    odometry: str | None = None
    ground_truth: str | None = None


T_BODY_OPTICAL = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From a camera's optical frame (z forward, x right, y down) to its body's (x forward, z up)."""


def _mounted(m: _Mounting | None) -> Array | None:
    if m is None:
        return None
    angles_rad = (math.radians(m.roll_deg), math.radians(m.pitch_deg), math.radians(m.yaw_deg))
    return mounting((m.x_m, m.y_m, m.z_m), angles_rad)


def _camera(camera: _Camera) -> CameraCalibration:
    T_base_body, i = _mounted(camera.mounting), camera.intrinsics
    intrinsics = None
    if i is not None:
        K = np.array([[i.fx_px, 0.0, i.cx_px], [0.0, i.fy_px, i.cy_px], [0.0, 0.0, 1.0]])
        intrinsics = Intrinsics(K, i.width_px, i.height_px)
    T_base_camera = None if T_base_body is None else T_base_body @ T_BODY_OPTICAL
    return CameraCalibration(T_base_camera, intrinsics)


def _settings(lidar: _Lidar) -> LidarSettings:
    T_base_lidar = _mounted(lidar.mounting)
    masks_rad = tuple((math.radians(a), math.radians(b)) for a, b in lidar.mask_deg)
    return LidarSettings(T_base_lidar, masks_rad, round(lidar.clock_offset_s * 1e9))
