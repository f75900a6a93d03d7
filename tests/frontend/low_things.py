"""Low things that a lidar passes over, and what a camera below it sees of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from datasets.messages import Array
from datasets.se2 import inverse
from fusion.scan import CAMERA, CAMERA_LAYER, FusedScan
from tests.frontend.drives import Drive
from tests.frontend.rooms import cast

CAMERA_FOV_RAD = 1.5
CAMERA_REACH_M = 3.5
CAMERA_ORIGIN = np.array([0.15, 0.0])


def depth_sigma_m(ranges_m: Array) -> Array:
    """Of a stereo camera with 424 px and 50 mm, whose columns of 240 rows agree somewhat."""
    sigma: Array = 0.5 * 0.08 * ranges_m**2 / (424 * 0.05)
    return sigma


def with_low(
    scan: FusedScan,
    low: Array,
    T_world_base: Array,
    *,
    random: np.random.Generator | None = None,
    range_scale: float = 1.0,
    columns: int = 240,
) -> FusedScan:
    """A scan with what a camera that looks ahead sees of low walls (S, 4), in layer 1."""
    directions = (np.arange(columns) + 0.5) / columns * CAMERA_FOV_RAD - 0.5 * CAMERA_FOV_RAD
    yaw = math.atan2(T_world_base[1, 0], T_world_base[0, 0])
    eye = T_world_base[:2, :2] @ CAMERA_ORIGIN + T_world_base[:2, 2]
    ranges = cast(np.tile(eye, (columns, 1)), directions + yaw, low)
    seen = (ranges > 0.3) & (ranges < CAMERA_REACH_M)
    ranges, directions = ranges[seen], directions[seen]
    sigma = depth_sigma_m(ranges)
    measured = range_scale * ranges
    if random is not None:
        measured = measured + sigma * random.standard_normal(ranges.size)
    rays = np.column_stack([np.cos(directions), np.sin(directions)])
    points = CAMERA_ORIGIN + measured[:, None] * rays
    away = points - scan.origin_base
    order = np.argsort(np.arctan2(away[:, 1], away[:, 0]), kind="stable")
    points, count = points[order], len(order)
    late = np.full(count, scan.offsets_s.mean()) if scan.offsets_s.size else np.empty(0)
    return replace(
        scan,
        points_base=np.concatenate([scan.points_base, points]),
        offsets_s=np.concatenate([scan.offsets_s, late]),
        source=np.concatenate([scan.source, np.full(count, CAMERA, dtype=np.uint8)]),
        layer=np.concatenate([scan.layer, np.full(count, CAMERA_LAYER, dtype=np.uint8)]),
        variance_m2=np.concatenate([scan.variance_m2, sigma[order] ** 2]),
        lidar_range_m=np.concatenate([scan.lidar_range_m, np.full(count, np.nan)]),
        camera_range_m=np.concatenate([scan.camera_range_m, measured[order]]),
    )


def drive_past(
    drive: Drive, low: Array, *, seed: int = 0, range_scale: float = 1.0, noise: bool = True
) -> Drive:
    """The same drive with a camera."""
    random = np.random.default_rng(seed) if noise else None
    scans = [
        with_low(scan, low, T, random=random, range_scale=range_scale)
        for scan, T in zip(drive.scans, drive.T_world_base, strict=True)
    ]
    return replace(drive, scans=scans)


def along_errors(T_world_base: list[Array], T_odom_base: list[Array]) -> Array:
    """(N,) m, how far each pose is ahead of the truth, in the axes of the first true pose."""
    to_first = inverse(T_world_base[0])
    to_odom = inverse(T_odom_base[0])
    ahead = [
        (to_odom @ found)[0, 2] - (to_first @ true)[0, 2]
        for true, found in zip(T_world_base, T_odom_base, strict=True)
    ]
    return np.array(ahead)
