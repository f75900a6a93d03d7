"""What the drivers of a simulated robot give, and what a reader makes of it.

A bag holds the former, the streams of this project are the latter. Both come from here, so a
drive that is written and read back is the drive that was streamed, bit by bit.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.messages import Array, DepthImage, LaserScan, Odometry
from datasets.simulation.lidar import LidarTurn
from datasets.tf_tree import planar, se3

ODOMETRY, TRUTH = "/odom", "/ground_truth"
"""Topics of the base's poses."""


@dataclass(frozen=True, slots=True)
class DriverTurn:
    """A turn of a lidar; stamp_ns is of its first beam, and it is published with its last."""

    stamp_ns: int
    topic: str
    turn: LidarTurn

    @property
    def published_ns(self) -> int:
        return self.stamp_ns + round(self.turn.scan_time_s * 1e9)

    def as_read(self, notes: Counter[str]) -> LaserScan:
        """What is changed on reading is counted in ``notes``."""
        start_ns = self.stamp_ns - round(self.turn.stamp_s * 1e9)
        return self.turn.normalised(start_ns=start_ns, lidar=self.topic, notes=notes)


@dataclass(frozen=True, slots=True)
class DriverDepth:
    """A depth image. depth_mm : (H, W) uint16, 0 for holes (16UC1)."""

    stamp_ns: int
    topic: str
    depth_mm: npt.NDArray[np.uint16]

    @property
    def published_ns(self) -> int:
        return self.stamp_ns

    def as_read(self, notes: Counter[str]) -> DepthImage:
        """Nothing is changed that were to be noted."""
        del notes
        depth_m = self.depth_mm.astype(np.float32) / np.float32(1000.0)
        depth_m[self.depth_mm == 0] = np.nan
        return DepthImage(self.stamp_ns, self.topic, depth_m)


@dataclass(frozen=True, slots=True)
class DriverPose:
    """Where the base is, by its odometry or in truth.

    xyyaw : (3,) m, m, rad. speed_m_s, turn_rate_rad_s : forward and counter-clockwise.
    """

    stamp_ns: int
    topic: str
    xyyaw: Array
    speed_m_s: float
    turn_rate_rad_s: float

    @property
    def published_ns(self) -> int:
        return self.stamp_ns

    @property
    def quaternion_xyzw(self) -> tuple[float, float, float, float]:
        half = float(self.xyyaw[2]) / 2.0
        return 0.0, 0.0, math.sin(half), math.cos(half)

    def as_read(self, notes: Counter[str]) -> Odometry:
        """By way of the quaternion that a message carries."""
        del notes
        x_m, y_m, _ = self.xyyaw.tolist()
        return Odometry(self.stamp_ns, planar(se3((x_m, y_m, 0.0), self.quaternion_xyzw)))


DriverMessage = DriverTurn | DriverDepth | DriverPose
