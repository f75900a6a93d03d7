"""A turning 2D lidar on the moving robot, as its driver gives it to ROS.

Every beam leaves from where the lidar is at the beam's own time. The sampling clock is exact, the
motor is not, so turns have different counts of beams. No return is 0. The first beam looks
backwards (bearing pi of the lidar); a clockwise lidar gives falling angles from there. All angles
and times of a turn are float32 numbers, as the message carries them, and the beams are cast with
these very numbers: a scan of a bag and a scan taken without a file are the same.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from datasets.messages import Array, LaserScan
from datasets.normalise import laser_scan
from datasets.section import Section

Float32s = npt.NDArray[np.float32]
PoseAt = Callable[[Array], Array]
"""Times (N,) s to T_map_base as (N, 3) x m, y m, yaw rad: ``Drive.pose``."""

SLICE_S = 0.02
"""Movers stand still for so long within a turn: someone walking is 3 cm further after it."""

EDGE_M = 0.05
"""A step between surfaces of more than this, seen within one beam, is an edge."""


class LidarHits(Protocol):
    @property
    def distance_m(self) -> Float32s:
        """(N,), inf where there is none."""


class LidarScene(Protocol):
    """What a lidar needs of a scene: the first thing on each ray that it can see."""

    def cast(
        self,
        origins: Float32s,
        directions: Float32s,
        sensor: Literal["lidar", "depth"],
        time_s: float,
    ) -> LidarHits:
        """origins, directions : (N, 3), map frame, directions of unit length."""


class LidarModel(Section):
    """A turning lidar; the defaults are those of a YDLIDAR G4 at 7 Hz."""

    sample_rate_hz: float = Field(9000.0, gt=0.0, le=1e6)
    turn_rate_hz: float = Field(7.0, ge=1.0, le=100.0)
    turn_rate_spread: float = Field(
        0.003, ge=0.0, le=0.05, description="one sigma, as a share, from turn to turn"
    )
    clockwise: bool = True
    range_min_m: float = Field(0.28, ge=0.0)
    range_max_m: float = Field(16.0, gt=0.0)
    noise_m: float = Field(0.010, ge=0.0, description="white, one sigma at 0 m")
    noise_per_m: float = Field(0.003, ge=0.0, description="and growing with the range")
    scale_error_max: float = Field(0.002, ge=0.0, lt=0.1, description="fixed for a drive")
    beam_width_rad: float = Field(
        0.0, ge=0.0, lt=0.1, description="an edge within it gives a mixed range; 0: it never does"
    )

    @model_validator(mode="after")
    def _consistent(self) -> LidarModel:
        if self.range_min_m >= self.range_max_m:
            raise ValueError("range_min_m must be below range_max_m")
        if self.sample_rate_hz < 4.0 * self.turn_rate_hz:
            raise ValueError("a turn must have four beams or more")
        return self


G4 = LidarModel()


@dataclass(frozen=True, slots=True)
class LidarTurn:
    """One turn as a driver writes it: the fields of a sensor_msgs/LaserScan, none corrected.

    stamp_s  : of the first beam, seconds since the drive began; beam i is time_increment_s i later.
    ranges_m : (N,) float32; 0 where there is no return.
    angle_min_rad, angle_increment_rad : of the first beam and to the next, counter-clockwise from
               the lidar's x axis: a clockwise lidar begins at pi and has a negative increment.
    scan_time_s : how long the turn lasts; the next one begins then.
    """

    stamp_s: float
    ranges_m: Float32s
    angle_min_rad: float
    angle_max_rad: float
    angle_increment_rad: float
    time_increment_s: float
    scan_time_s: float
    range_min_m: float
    range_max_m: float

    def normalised(
        self,
        *,
        start_ns: int,
        lidar: str,
        notes: Counter[str],
        masks_rad: Sequence[tuple[float, float]] = (),
    ) -> LaserScan:
        """The scan that a reader makes of this turn.

        start_ns  : stamp of the beginning of the drive.
        masks_rad : see ``LidarCalibration.masks_rad``.
        """
        scan = laser_scan(
            stamp_ns=start_ns + round(self.stamp_s * 1e9),
            lidar=lidar,
            ranges=self.ranges_m,
            angle_min_rad=self.angle_min_rad,
            angle_max_rad=self.angle_max_rad,
            angle_increment_rad=self.angle_increment_rad,
            time_increment_s=self.time_increment_s,
            range_min_m=self.range_min_m,
            range_max_m=self.range_max_m,
            masks_rad=masks_rad,
            notes=notes,
        )
        assert scan is not None, "a turn has beams, and finite angles"
        return scan


def simulate_turns(
    scene: LidarScene,
    pose: PoseAt,
    T_base_lidar: Array,
    model: LidarModel,
    random: np.random.Generator,
    *,
    start_s: float = 0.0,
    end_s: float,
) -> Iterator[LidarTurn]:
    """One turn after the other, as long as they end by ``end_s``; the scale error is drawn first.

    The arguments are those of ``simulate_turn``.
    """
    scale_error = float(random.uniform(-model.scale_error_max, model.scale_error_max))
    stamp_s = start_s
    while True:
        turn = simulate_turn(
            scene, pose, T_base_lidar, model, stamp_s, random, scale_error=scale_error
        )
        stamp_s += turn.scan_time_s
        if stamp_s > end_s:
            return
        yield turn


def simulate_turn(
    scene: LidarScene,
    pose: PoseAt,
    T_base_lidar: Array,
    model: LidarModel,
    stamp_s: float,
    random: np.random.Generator,
    *,
    scale_error: float = 0.0,
) -> LidarTurn:
    """One turn of the lidar, its first beam at ``stamp_s`` seconds of the drive.

    T_base_lidar : (4, 4), any mounting: tilted, upside down, away from the base's axis.
    scale_error  : the share by which ranges are too long, before the noise.
    """
    turn_s = 1.0 / (model.turn_rate_hz * (1.0 + _spread(model.turn_rate_spread, random)))
    count = round(model.sample_rate_hz * turn_s)
    side = -1.0 if model.clockwise else 1.0
    angle_min, increment = _float32(-side * math.pi), _float32(side * 2.0 * math.pi / count)
    time_increment_s = _float32(1.0 / model.sample_rate_hz)
    steps = np.arange(count, dtype=np.float64)
    bearings, times_s = angle_min + increment * steps, stamp_s + time_increment_s * steps
    beams = _Beams.at(pose(times_s), T_base_lidar)

    true_m = _cast(scene, beams, bearings, times_s)
    sigma_m = model.noise_m + model.noise_per_m * np.where(np.isfinite(true_m), true_m, 0.0)
    noise_m = sigma_m * random.standard_normal(count)
    if model.beam_width_rad > 0.0:
        half = model.beam_width_rad / 2.0
        left_m = _cast(scene, beams, bearings + half, times_s)
        right_m = _cast(scene, beams, bearings - half, times_s)
        true_m = _mixed(true_m, left_m, right_m, random.random(count))
    ranges_m = (true_m * (1.0 + scale_error) + noise_m).astype(np.float32)
    ranges_m[(ranges_m < model.range_min_m) | (ranges_m >= model.range_max_m)] = 0.0
    return LidarTurn(
        stamp_s=stamp_s,
        ranges_m=ranges_m,
        angle_min_rad=angle_min,
        angle_max_rad=_float32(angle_min + increment * (count - 1)),
        angle_increment_rad=increment,
        time_increment_s=time_increment_s,
        scan_time_s=_float32(count / model.sample_rate_hz),
        range_min_m=_float32(model.range_min_m),
        range_max_m=_float32(model.range_max_m),
    )


@dataclass(frozen=True, slots=True)
class _Beams:
    """The lidar at the time of each beam, map frame.

    origins : (N, 3) m. x_axes, y_axes : (N, 3), of the lidar; its beams lie between them.
    """

    origins: Array
    x_axes: Array
    y_axes: Array

    @classmethod
    def at(cls, poses: Array, T_base_lidar: Array) -> _Beams:
        """poses : (N, 3) x, y, yaw of the base."""
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])

        def turned(vector: Array) -> Array:
            x, y, z = vector
            return np.column_stack([c * x - s * y, s * x + c * y, np.full_like(c, z)])

        origins = turned(T_base_lidar[:3, 3])
        origins[:, :2] += poses[:, :2]
        return cls(origins, turned(T_base_lidar[:3, 0]), turned(T_base_lidar[:3, 1]))


def _cast(scene: LidarScene, beams: _Beams, bearings: Array, times_s: Array) -> Array:
    """True ranges (N,) m along bearings (N,), inf where there is none."""
    directions = np.cos(bearings)[:, None] * beams.x_axes + np.sin(bearings)[:, None] * beams.y_axes
    rays = beams.origins.astype(np.float32), directions.astype(np.float32)
    slices = min(times_s.size, math.ceil((times_s[-1] - times_s[0]) / SLICE_S))
    edges = [round(index * times_s.size / slices) for index in range(slices + 1)]
    ranges_m = np.empty(times_s.size)
    for begin, end in pairwise(edges):
        middle_s = float(times_s[(begin + end) // 2])
        hits = scene.cast(rays[0][begin:end], rays[1][begin:end], "lidar", middle_s)
        ranges_m[begin:end] = hits.distance_m
    return ranges_m


def _mixed(middle_m: Array, left_m: Array, right_m: Array, share: Array) -> Array:
    """Ranges (N,) of beams with a width: on an edge, a share (0..1) of what either side sees.

    On a plane, however grazing, the inverse range in the middle is the mean of those at the sides
    (but for the square of the width); what it misses by tells edges.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        middle = 1.0 / middle_m
        off = np.abs(middle - (1.0 / left_m + 1.0 / right_m) / 2.0)
        step_m = 2.0 * off / middle**2
        between_m = share * left_m + (1.0 - share) * right_m
    edge = (step_m > EDGE_M) & np.isfinite(between_m) & np.isfinite(middle_m)
    return np.where(edge, between_m, middle_m)


def _spread(sigma: float, random: np.random.Generator) -> float:
    """Normal, cut off at three sigma."""
    return sigma * max(-3.0, min(3.0, float(random.standard_normal())))


def _float32(value: float) -> float:
    return float(np.float32(value))
