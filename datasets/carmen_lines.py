"""The grammar of single lines in a CARMEN log (see ``carmen.py`` for what they look like)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from datasets.bounds import FARTHEST_M, LARGEST_RAD, LONGEST_RANGE_M, within
from datasets.messages import Array

LASERS = {
    "FLASER": "front",
    "ROBOTLASER1": "front",
    "RAWLASER1": "front",
    "RLASER": "rear",
    "ROBOTLASER2": "rear",
    "RAWLASER2": "rear",
}
"""Kinds of laser line and their lidar; the first of a lidar is preferred."""

SICK_RANGE_MAX_M = (8.18, 16.36, 32.74, 81.8)
"""From here on a SICK LMS 2xx tells error codes, in its modes of 8, 16, 32 and 80 m."""

LATEST_S = 4_294_967_295
"""The last second of 32 bits, in 2106, as in ROS; what is later is no time."""

Pose = tuple[float, float, float]


class BadLineError(Exception):
    """A line that can't be used. kind : of what; reason : why, both in the words of the report."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(f"{kind}: {reason}")
        self.kind = kind
        self.reason = reason


@dataclass(frozen=True, slots=True)
class LaserLine:
    """One laser line. robot, lidar : x m, y m, yaw rad in the odometry frame, where there are."""

    stamp_ns: int
    ranges_m: Array
    bearings_rad: Array
    range_max_m: float | None
    robot: Pose | None
    lidar: Pose | None


def read_odometry_line(tokens: list[bytes]) -> tuple[int, Pose]:
    """Stamp and pose of an ODOM line. Raises BadLineError."""
    if len(tokens) != 10:
        raise BadLineError("odometry", "wrong number of values")
    return _stamp_ns(tokens[7], "odometry"), _pose(tokens[1:4], "odometry")


def read_laser_line(word: str, tokens: list[bytes]) -> LaserLine:
    """Read a line that begins with a word of LASERS. Raises BadLineError."""
    if word in ("FLASER", "RLASER"):
        return _old_laser_line(tokens)
    return _new_laser_line(tokens, with_poses=word.startswith("ROBOT"))


def _old_laser_line(tokens: list[bytes]) -> LaserLine:
    count = _count(tokens, 1)
    if count == 0 or len(tokens) != count + 11:
        raise BadLineError("scan", "wrong number of ranges")
    end = count + 2
    return LaserLine(
        stamp_ns=_stamp_ns(tokens[end + 6], "scan"),
        ranges_m=_floats(tokens[2:end]),
        bearings_rad=sick_bearings(count),
        range_max_m=None,
        robot=_pose(tokens[end + 3 : end + 6], "scan"),
        lidar=None,
    )


def _new_laser_line(tokens: list[bytes], *, with_poses: bool) -> LaserLine:
    count = _count(tokens, 8)
    end = count + 9
    tail = end + 1 + _count(tokens, end)
    poses = 11 if with_poses else 0
    if count == 0 or len(tokens) != tail + poses + 3:
        raise BadLineError("scan", "wrong number of ranges")
    start_rad, _, resolution_rad, range_max_m = map(float, _floats(tokens[2:6]))
    if not (math.isfinite(start_rad) and math.isfinite(resolution_rad)):
        raise BadLineError("scan", "angles are not finite")
    if not within((start_rad, start_rad + resolution_rad * count), LARGEST_RAD):
        raise BadLineError("scan", "angles are out of range")
    return LaserLine(
        stamp_ns=_stamp_ns(tokens[tail + poses], "scan"),
        ranges_m=_floats(tokens[9:end]),
        bearings_rad=_even_bearings(start_rad, resolution_rad, count),
        range_max_m=range_max_m if 0.0 < range_max_m <= LONGEST_RANGE_M else None,
        robot=_pose(tokens[tail + 3 : tail + 6], "scan") if with_poses else None,
        lidar=_pose(tokens[tail : tail + 3], "scan") if with_poses else None,
    )


@lru_cache(maxsize=64)
def sick_bearings(count: int) -> Array:
    """Bearings (count,) of an FLASER line, which doesn't tell them.

    As CARMEN's own readlog.c has it: from -90 degrees on, 1 degree apart for 180 and 181 ranges,
    0.5 for 360 and 361: a SICK sends one more than 180 degrees need, and the last may be missing.
    Other even counts are taken alike. 540 and 541 are 270 degrees.
    """
    field_deg = 270.0 if count in (540, 541) else 180.0
    step_deg = field_deg / max(1, count - count % 2)
    bearings: Array = np.radians(-0.5 * field_deg + step_deg * np.arange(count))
    return bearings


def sick_range_max_m(longest_m: float) -> float:
    """Where "no return" begins, from the longest range that occurs."""
    for limit_m in SICK_RANGE_MAX_M[:-1]:
        if limit_m <= longest_m <= 1.0015 * limit_m:
            return limit_m
    return SICK_RANGE_MAX_M[-1]


@lru_cache(maxsize=64)
def _even_bearings(start_rad: float, resolution_rad: float, count: int) -> Array:
    return start_rad + resolution_rad * np.arange(count, dtype=np.float64)


def _count(tokens: list[bytes], place: int) -> int:
    """The number of values at a place; its sanity is that the line is long enough for them."""
    token = tokens[place] if place < len(tokens) else b""
    if not token.isdigit() or len(token) > 6:
        raise BadLineError("scan", "wrong number of ranges")
    return int(token)


def _floats(tokens: list[bytes]) -> Array:
    try:
        return np.array(tokens, dtype=np.float64)
    except ValueError:
        raise BadLineError("scan", "a value is no number") from None


def _pose(tokens: list[bytes], kind: str) -> Pose:
    try:
        x_m, y_m, yaw_rad = map(float, tokens)
    except ValueError:
        raise BadLineError(kind, "a value is no number") from None
    if not (math.isfinite(x_m) and math.isfinite(y_m) and math.isfinite(yaw_rad)):
        raise BadLineError(kind, "pose is not finite")
    if not (within((x_m, y_m), FARTHEST_M) and within((yaw_rad,), LARGEST_RAD)):
        raise BadLineError(kind, "pose is out of range")
    return x_m, y_m, yaw_rad


def _stamp_ns(token: bytes, kind: str) -> int:
    """Decimal seconds as nanoseconds, digit by digit: a float has too few at 1e9 s."""
    whole, _, fraction = token.partition(b".")
    digits = fraction[:9].ljust(9, b"0")
    if not (whole.isdigit() and digits.isdigit() and len(whole) <= 10 and int(whole) <= LATEST_S):
        raise BadLineError(kind, "stamp is no time")
    return int(whole) * 1_000_000_000 + int(digits)
