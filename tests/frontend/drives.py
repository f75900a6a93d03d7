"""Drives through known places: scans and odometry with the errors of a base, and the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.messages import Array, Odometry
from datasets.se2 import inverse, se2
from frontend.local_slam import LocalResult, LocalSlam
from frontend.motion import MotionConfig, MotionModel
from frontend.nodes import NodeConfig, NodeKeeper
from frontend.tracker import ScanMatchingTracker, TrackerConfig
from fusion.scan import FusedScan
from tests.frontend.rooms import Line, fused, way_through

STEP_NS = 100_000_000
ROUND_THE_ROOM: Line = (
    *((1.2, 1.0), (5.0, 1.0), (8.5, 1.2), (8.5, 3.2), (4.5, 4.0), (4.0, 1.2), (1.2, 1.0)),
)


@dataclass(frozen=True)
class Drive:
    """A scan and an odometry message for each true pose T_world_base, ten a second."""

    T_world_base: list[Array]
    scans: list[FusedScan]
    odometry: list[Odometry]


def drive(
    segments: Array,
    corners: Line,
    *,
    seed: int = 0,
    step_m: float = 0.1,
    noise_m: float = 0.01,
    bias_rad_per_m: float = 0.04,
    beams: int = 240,
    max_range_m: float = 12.0,
    start_ns: int = 0,
    wheel_scale: float = 1.015,
) -> Drive:
    """Along straight legs, at 1 m/s; the wheels run 1.5 % long and turn by a bias."""
    random = np.random.default_rng(seed)
    poses = way_through(corners, step_m)
    stamps = [start_ns + k * STEP_NS for k in range(len(poses))]
    scans = [
        fused(
            segments,
            T,
            beams=beams,
            noise_m=noise_m,
            random=random,
            max_range_m=max_range_m,
            stamp_ns=stamp_ns,
        )
        for T, stamp_ns in zip(poses, stamps, strict=True)
    ]
    T_wheel = se2(3.0, -2.0, 1.0)
    odometry = [Odometry(stamps[0], T_wheel)]
    for before, after, stamp_ns in zip(poses[:-1], poses[1:], stamps[1:], strict=True):
        step = inverse(before) @ after
        way = float(step[0, 2])
        turn = float(np.arctan2(step[1, 0], step[0, 0]))
        wheels = se2(
            wheel_scale * way + 0.002 * random.standard_normal(),
            float(step[1, 2]),
            turn + bias_rad_per_m * way + 0.02 * abs(turn) * random.standard_normal(),
        )
        T_wheel = T_wheel @ wheels
        odometry.append(Odometry(stamp_ns, T_wheel))
    return Drive(poses, scans, odometry)


def local_slam(**tracker: float) -> LocalSlam:
    return LocalSlam(
        MotionModel(MotionConfig()),
        ScanMatchingTracker(TrackerConfig(**tracker)),
        NodeKeeper(NodeConfig()),
    )


def run(slam: LocalSlam, drive: Drive, *, odometry: bool = True) -> list[LocalResult]:
    results = []
    for scan, message in zip(drive.scans, drive.odometry, strict=True):
        if odometry:
            assert slam.add_odometry(message)
        results.append(slam.add_scan(scan))
    return results


def poses_of(results: list[LocalResult]) -> list[Array]:
    """T_odom_base of each scan."""
    return [result.tracked.T_odom_base for result in results]


def errors(T_world_base: list[Array], T_odom_base: list[Array]) -> Array:
    """(N, 2) how far (m, rad) each pose is off, the first ones laid on each other."""
    T_world_odom = T_world_base[0] @ inverse(T_odom_base[0])
    off = inverse_all(np.array(T_world_base)) @ T_world_odom @ np.array(T_odom_base)
    return np.column_stack(
        [np.hypot(off[:, 0, 2], off[:, 1, 2]), np.abs(np.arctan2(off[:, 1, 0], off[:, 0, 0]))]
    )


def inverse_all(matrices: Array) -> Array:
    """(N, 3, 3) inverses."""
    return np.array([inverse(T) for T in matrices])
