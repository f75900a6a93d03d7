"""What a recording gives to a calibration: depth images with the walls a lidar saw meanwhile."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from datasets.errors import InputError
from datasets.messages import Array, DepthImage, LaserScan, Odometry
from datasets.recording import Calibration, Intrinsics, LidarCalibration, Recording
from datasets.se2 import inverse, se2
from datasets.section import Section
from datasets.trajectory import Trajectory
from fusion.calibration.blocks import DepthBlocks, DepthNoise, depth_blocks
from fusion.calibration.segments import Segments, wall_segments
from fusion.lidar_only import BeamLimits

LEVEL = 0.98
"""Cosine between a lidar's axis and the vertical: only level lidars show walls as they are."""

LEAST_BLOCKS = 40
"""An image with fewer shows nothing."""


class ViewLimits(Section):
    """Which images and scans take part."""

    images: int = Field(100, ge=4, le=2000, description="spread over the recording")
    apart_s: float = Field(0.25, gt=0.0, le=5.0, description="between an image and a scan")
    scans: int = Field(2, ge=1, le=20, description="of each lidar, the nearest to an image")
    noise: DepthNoise = DepthNoise()
    beams: BeamLimits = BeamLimits()


@dataclass(frozen=True, slots=True)
class View:
    """One depth image, and the walls that the lidars saw around its time.

    blocks        : of the image, optical frame.
    walls         : in the base frame of the image's moment.
    points_base   : (P, 2) m, the lidar points behind them.
    velocity_base : (3,) m/s, m/s, rad/s of the base at that moment; NaN without odometry.
    """

    stamp_ns: int
    blocks: DepthBlocks
    walls: Segments
    points_base: Array
    velocity_base: Array


@dataclass(frozen=True, slots=True)
class _Pending:
    stamp_ns: int
    blocks: DepthBlocks
    scans: tuple[LaserScan, ...]


def views(
    recording: Recording, camera: str | None, limits: ViewLimits, notes: Counter[str]
) -> tuple[str, list[View]]:
    """The camera that was meant, and its views, spread over the recording.

    camera : its name, or None for the only one.
    notes  : counts, in the words of the report, what could not be used.

    Images beyond four times ``limits.images`` are thinned out while reading, so memory is bounded.
    Raises InputError where the recording has no such camera, no lidar that is level, no pinhole.
    """
    pending: list[_Pending] = []
    waiting: list[tuple[int, DepthBlocks]] = []
    recent: list[LaserScan] = []
    stamps: list[int] = []
    odometry: list[Array] = []
    every, seen, lidar_seen = 1, 0, False
    reach_ns = round(limits.apart_s * 1e9)

    def settle(until_ns: int | None) -> None:
        """Give the images whose scans have all come their scans."""
        while waiting and (until_ns is None or waiting[0][0] + reach_ns < until_ns):
            stamp_ns, blocks = waiting.pop(0)
            if scans := _nearest(recent, stamp_ns, reach_ns, limits.scans):
                pending.append(_Pending(stamp_ns, blocks, scans))
            else:
                notes["depth image left out: no scan near in time"] += 1

    for message in recording:
        settle(message.stamp_ns - reach_ns)
        match message:
            case Odometry():
                if not stamps or message.stamp_ns > stamps[-1]:
                    stamps.append(message.stamp_ns)
                    odometry.append(message.T_odom_base)
            case LaserScan():
                lidar_seen = True
                if _level(recording.calibration.lidars[message.lidar]):
                    recent.append(message)
                    oldest_ns = min((w[0] for w in waiting), default=message.stamp_ns)
                    recent = [s for s in recent if s.stamp_ns > oldest_ns - 4 * reach_ns]
            case DepthImage():
                camera = _meant(camera, message.camera, recording)
                if message.camera != camera:
                    continue
                seen += 1
                if seen % every:
                    continue
                pinhole = _pinhole(recording.calibration, camera, recording.name)
                if (blocks := _blocks(message, pinhole, limits.noise, notes)) is not None:
                    waiting.append((message.stamp_ns, blocks))
                if len(pending) > 4 * limits.images:
                    del pending[::2]
                    every *= 2
    settle(None)
    _require(recording, camera, lidar_seen=lidar_seen)
    assert camera is not None
    track = Trajectory.from_matrices(stamps, odometry) if len(stamps) > 1 else None
    if track is None:
        notes["no odometry: the motion between images and scans is not taken out"] = 1
    found = [_view(item, track, recording.calibration, limits.beams) for item in pending]
    return camera, _stillest(found, limits.images)


def _meant(camera: str | None, name: str, recording: Recording) -> str:
    """The camera that was asked for; else the only one."""
    if camera is not None:
        return camera
    if len(recording.calibration.cameras) > 1:
        raise InputError(
            "the recording has several depth cameras",
            where=recording.name,
            remedy=f"Choose with --camera: {', '.join(sorted(recording.calibration.cameras))}",
        )
    return name


def _require(recording: Recording, camera: str | None, *, lidar_seen: bool) -> None:
    known = ", ".join(sorted(recording.calibration.cameras)) or "none"
    if camera is None or camera not in recording.calibration.cameras:
        raise InputError(
            "there is no depth image" if camera is None else f"there is no camera {camera}",
            where=recording.name,
            remedy=f"Record depth images with their camera_info; cameras in it: {known}",
        )
    if not lidar_seen or not any(map(_level, recording.calibration.lidars.values())):
        raise InputError(
            "there is no lidar that is mounted level",
            where=recording.name,
            remedy="The camera's place is found from walls that a level lidar sees as well",
        )


def _pinhole(calibration: Calibration, camera: str, where: str) -> Intrinsics:
    known = calibration.cameras.get(camera)
    if known is None or known.intrinsics is None:
        raise InputError(
            f"the pinhole of {camera} is not known",
            where=where,
            remedy="Record its camera_info, or give `intrinsics` with --calibration",
        )
    return known.intrinsics


def _blocks(
    image: DepthImage, pinhole: Intrinsics, noise: DepthNoise, notes: Counter[str]
) -> DepthBlocks | None:
    if image.depth_m.shape != (pinhole.height_px, pinhole.width_px):
        notes["depth image left out: its size is not that of the intrinsics"] += 1
        return None
    blocks = depth_blocks(image.depth_m, pinhole, noise)
    if len(blocks) < LEAST_BLOCKS:
        notes["depth image left out: it shows no surface"] += 1
        return None
    return blocks


def level_lidar(calibration: Calibration) -> LidarCalibration:
    """The first lidar that is mounted level; there must be one."""
    return next(lidar for lidar in calibration.lidars.values() if _level(lidar))


def _level(lidar: LidarCalibration) -> bool:
    return bool(abs(lidar.T_base_lidar[2, 2]) > LEVEL)


def _nearest(
    scans: list[LaserScan], stamp_ns: int, reach_ns: int, count: int
) -> tuple[LaserScan, ...]:
    """Of each lidar the scans whose middles are nearest to a stamp."""

    def away_ns(scan: LaserScan) -> float:
        half_s = float(scan.beam_offsets_s[-1]) / 2.0 if scan.beam_offsets_s.size else 0.0
        return abs(scan.stamp_ns + half_s * 1e9 - stamp_ns)

    near: list[LaserScan] = []
    for lidar in sorted({scan.lidar for scan in scans}):
        own = sorted((s for s in scans if s.lidar == lidar), key=away_ns)
        near += [scan for scan in own[:count] if away_ns(scan) <= reach_ns]
    return tuple(near)


def _view(
    item: _Pending, track: Trajectory | None, calibration: Calibration, limits: BeamLimits
) -> View:
    segments, points, velocity = [], [], np.full(3, np.nan)
    if track is not None:
        velocity = _velocity(track, item.stamp_ns)
    for scan in item.scans:
        T_base_lidar = calibration.lidars[scan.lidar].T_base_lidar
        points_base, sigma_m = _as_of(scan, T_base_lidar, item.stamp_ns, track, limits)
        points.append(points_base)
        segments.append(wall_segments(points_base, sigma_m, T_base_lidar[:2, 3]))
    return View(
        item.stamp_ns, item.blocks, Segments.joined(segments), np.concatenate(points), velocity
    )


def _as_of(
    scan: LaserScan,
    T_base_lidar: Array,
    stamp_ns: int,
    track: Trajectory | None,
    limits: BeamLimits,
) -> tuple[Array, Array]:
    """Points (N, 2) and their sigma (N,) m, in the base frame of another moment."""
    nearest_m = max(limits.min_range_m, scan.range_min_m)
    with np.errstate(invalid="ignore"):
        kept = (scan.ranges_m >= nearest_m) & (scan.ranges_m <= limits.max_range_m)
    ranges, bearings = scan.ranges_m[kept], scan.bearings_rad[kept]
    rays = np.column_stack([np.cos(bearings), np.sin(bearings)])
    points = (ranges[:, None] * rays) @ T_base_lidar[:2, :2].T + T_base_lidar[:2, 3]
    sigma_m = limits.noise_m + limits.noise_per_m * ranges
    if track is None:
        return points, sigma_m
    offsets_s = scan.beam_offsets_s[kept] if scan.beam_offsets_s.size else np.zeros(len(points))
    x, y, yaw = track.at(scan.stamp_ns + np.rint(offsets_s * 1e9).astype(np.int64)).T
    c, s = np.cos(yaw), np.sin(yaw)
    points_odom = np.column_stack(
        [c * points[:, 0] - s * points[:, 1] + x, s * points[:, 0] + c * points[:, 1] + y]
    )
    T_base_odom = inverse(se2(*track.at(np.array([stamp_ns]))[0]))
    moved: Array = points_odom @ T_base_odom[:2, :2].T + T_base_odom[:2, 2]
    return moved, sigma_m


def _velocity(track: Trajectory, stamp_ns: int, over_s: float = 0.1) -> Array:
    """(3,) m/s, m/s, rad/s in the base's own axes, around a stamp."""
    half_ns = round(over_s / 2.0 * 1e9)
    before, middle, after = track.at(np.array([stamp_ns - half_ns, stamp_ns, stamp_ns + half_ns]))
    step = (after - before) / over_s
    c, s = np.cos(middle[2]), np.sin(middle[2])
    turn = np.arctan2(np.sin(after[2] - before[2]), np.cos(after[2] - before[2])) / over_s
    return np.array([c * step[0] + s * step[1], -s * step[0] + c * step[1], turn])


def _stillest(found: list[View], count: int) -> list[View]:
    """So many views in even parts of the time, of each part the one with the least turning."""
    if len(found) <= count:
        return found
    parts = np.array_split(np.arange(len(found)), count)

    def turning(index: int) -> float:
        rate = abs(float(found[index].velocity_base[2]))
        return 0.0 if np.isnan(rate) else rate

    return [found[min(part.tolist(), key=turning)] for part in parts]
