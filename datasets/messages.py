"""What a recording consists of: one frozen dataclass for each kind of message.

All of them are in REP 103 units (metres, radians, seconds) and counter-clockwise angles; readers
convert, nobody downstream has to. Stamps are integers in nanoseconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Float32s = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class LaserScan:
    """One turn of a 2D lidar, in the lidar's own frame.

    stamp_ns       : time of the first beam.
    lidar          : which lidar; a key of ``Calibration.lidars``.
    ranges_m       : (N,) float64; REP 117: +inf no return, -inf too near, NaN invalid.
    bearings_rad   : (N,) float64, finite, counter-clockwise from the lidar's x axis.
    beam_offsets_s : (N,) float64 seconds from ``stamp_ns`` to each beam; empty when unknown.
    range_min_m, range_max_m : what the sensor can measure.

    Raises ValueError if shapes disagree or a bearing is not finite.
    """

    stamp_ns: int
    lidar: str
    ranges_m: Array
    bearings_rad: Array
    beam_offsets_s: Array
    range_min_m: float
    range_max_m: float

    def __post_init__(self) -> None:
        if self.ranges_m.ndim != 1 or self.ranges_m.shape != self.bearings_rad.shape:
            raise ValueError(
                f"ranges {self.ranges_m.shape} and bearings {self.bearings_rad.shape} "
                "must be one-dimensional and equally long"
            )
        if self.beam_offsets_s.size and self.beam_offsets_s.shape != self.ranges_m.shape:
            raise ValueError(
                f"{self.beam_offsets_s.size} beam times for {self.ranges_m.size} ranges"
            )
        if not np.isfinite(self.bearings_rad).all():
            raise ValueError("bearings must be finite")


@dataclass(frozen=True, slots=True)
class Odometry:
    """The pose of the base by dead reckoning. T_odom_base : (3, 3) float64, finite."""

    stamp_ns: int
    T_odom_base: Array

    def __post_init__(self) -> None:
        if self.T_odom_base.shape != (3, 3) or not np.isfinite(self.T_odom_base).all():
            raise ValueError("T_odom_base must be a finite (3, 3) matrix")


@dataclass(frozen=True, slots=True)
class DepthImage:
    """What a depth camera measured at one moment.

    stamp_ns : of the exposure.
    camera   : which camera; a key of ``Calibration.cameras``, where its mounting and pinhole are.
    depth_m  : (H, W) float32, m along the optical axis (z, not the length of the ray), positive;
               NaN where there is no measurement (REP 118): a hole is no free space.

    Raises ValueError if it is no (H, W) float32 image.
    """

    stamp_ns: int
    camera: str
    depth_m: Float32s

    def __post_init__(self) -> None:
        if self.depth_m.ndim != 2 or self.depth_m.dtype != np.float32 or not self.depth_m.size:
            raise ValueError(f"depth must be (H, W) float32, not {self.depth_m.shape}")


Message = LaserScan | DepthImage | Odometry
