"""The poses that a simulated base gives all the while: its odometry, and the truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from datasets.messages import Array
from datasets.simulation.drive import Drive
from datasets.simulation.driver_messages import ODOMETRY, TRUTH, DriverPose
from datasets.simulation.robot import Robot
from datasets.simulation.trouble import HandledDrive
from datasets.simulation.wheels import Gyro, WheelOdometry

TRUTH_RATE_HZ = 50.0

PIECE = 4096
"""So many poses are computed at once: what is in memory doesn't grow with the drive."""


def true_poses(drive: Drive | HandledDrive, start_ns: int) -> Iterator[DriverPose]:
    """T_map_base at ``TRUTH_RATE_HZ``, from 0 s to the end of the drive."""
    for times_s in _pieces(drive, TRUTH_RATE_HZ):
        yield from _poses(TRUTH, start_ns, times_s, drive.pose(times_s), drive.velocity(times_s))


def odometry(
    drive: Drive | HandledDrive, robot: Robot, seed: int, start_ns: int
) -> Iterator[DriverPose]:
    """T_odom_base at the robot's rate; it begins at the origin. Nothing without wheels.

    With a gyro, its integral is the heading, less the bias it showed while the base stood before
    it set out (as drivers of such bases do it); how far it went, the wheels say all the same.
    """
    if robot.wheels is None:
        return
    wheels = WheelOdometry(drive.rolled, robot.wheels, seed)
    gyro = None if robot.gyro is None else Gyro(drive, robot.gyro, seed)
    last, turned_last, bias_rad_s = np.zeros((1, 3)), np.zeros((1, 3)), None
    last_s, last_rad_s = np.zeros(1), np.zeros(1)
    for times_s in _pieces(drive, robot.odometry_rate_hz):
        seen = wheels.advance(times_s)
        known, known_s = np.vstack([last, seen]), np.concatenate([last_s, times_s])
        turned = seen
        if gyro is not None:
            readings = gyro.advance(times_s)
            if bias_rad_s is None:
                standing = drive.travelled(times_s).sum(axis=1) == 0.0
                bias_rad_s = float(readings[standing].mean()) if standing.sum() > 1 else 0.0
                last_rad_s = readings[:1] - bias_rad_s
            rates = np.concatenate([last_rad_s, readings - bias_rad_s])
            turned = _turned(known, known_s, rates, turned_last)
            last_rad_s = rates[-1:]
        yield from _poses(
            ODOMETRY,
            start_ns,
            times_s,
            turned,
            _velocity(np.vstack([turned_last, turned]), known_s),
        )
        last, turned_last, last_s = seen[-1:], turned[-1:], times_s[-1:]


def _turned(seen: Array, times_s: Array, rates_rad_s: Array, start: Array) -> Array:
    """The wheels' steps between poses (N + 1, 3) laid out along a gyro's heading, (N, 3).

    rates_rad_s : (N + 1,) of the gyro. start : (1, 3), the pose before the first step.
    """
    turn = np.diff(times_s) * (rates_rad_s[:-1] + rates_rad_s[1:]) / 2.0
    yaw = np.cumsum(np.concatenate([start[0, 2:], turn]))
    middle, wheels_middle = (yaw[1:] + yaw[:-1]) / 2.0, (seen[1:, 2] + seen[:-1, 2]) / 2.0
    steps = np.diff(seen[:, 0] + 1j * seen[:, 1]) * np.exp(1j * (middle - wheels_middle))
    place = np.cumsum(np.concatenate([start[0, :1] + 1j * start[0, 1:2], steps]))[1:]
    return np.column_stack([place.real, place.imag, yaw[1:]])


def _velocity(poses: Array, times_s: Array) -> Array:
    """(N, 2) m/s and rad/s by the differences of (N + 1, 3) poses; 0 over no time."""
    since_s, steps = np.diff(times_s), np.diff(poses, axis=0)
    per_s = np.divide(1.0, since_s, out=np.zeros_like(since_s), where=since_s > 0.0)
    heading = poses[:-1, 2] + steps[:, 2] / 2.0
    ahead_m = steps[:, 0] * np.cos(heading) + steps[:, 1] * np.sin(heading)
    return np.column_stack([ahead_m * per_s, steps[:, 2] * per_s])


def _pieces(drive: Drive | HandledDrive, rate_hz: float) -> Iterator[Array]:
    """The times from 0 to the end of the drive."""
    count = int(drive.duration_s * rate_hz) + 1
    for begin in range(0, count, PIECE):
        yield np.arange(begin, min(begin + PIECE, count)) / rate_hz


def _poses(
    topic: str, start_ns: int, times_s: Array, xyyaw: Array, velocity: Array
) -> Iterator[DriverPose]:
    for time_s, pose, (speed, turn_rate) in zip(
        times_s.tolist(), xyyaw, velocity.tolist(), strict=True
    ):
        yield DriverPose(start_ns + round(time_s * 1e9), topic, pose, speed, turn_rate)
