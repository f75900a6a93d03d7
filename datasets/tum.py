"""Trajectories in the form of the TUM RGB-D benchmark: ``timestamp tx ty tz qx qy qz qw``.

Stamps are kept to the nanosecond both ways: they go between text and integers directly, since a
float64 of seconds since 1970 is good to 240 ns only.
"""

from __future__ import annotations

import math
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from datasets.bounds import FARTHEST_M, within
from datasets.errors import InputError, reading
from datasets.messages import Array
from datasets.trajectory import Trajectory
from datasets.whole_file import write_whole

_NS = 1_000_000_000
_MOST_DIGITS = 30
_REMEDY = "Each line must read: timestamp tx ty tz qx qy qz qw."


def parse_stamp_ns(text: str) -> int:
    """Nanoseconds of a decimal number of seconds, exactly; finer digits are rounded.

    Raises ValueError if the text is not a finite number, or too large for 64 bits.
    """
    try:
        seconds = Decimal(text)
        if seconds and abs(seconds.adjusted()) > _MOST_DIGITS:  # 1e999999 has a million digits
            seconds = Decimal(0) if seconds.adjusted() < 0 else Decimal("nan")
        stamp_ns = int((seconds * _NS).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise ValueError(f"{text!r} is not a time in seconds") from error
    if abs(stamp_ns) >= 2**63:
        raise ValueError(f"{text!r} is too large for a time in nanoseconds")
    return stamp_ns


def format_stamp(stamp_ns: int) -> str:
    """Seconds with nine decimals, exactly."""
    sign, size_ns = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    return f"{sign}{size_ns // _NS}.{size_ns % _NS:09d}"


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a planar trajectory: z, qx and qy are 0, every float64 in the shortest exact form.

    The file appears whole or not at all; the same trajectory gives the same bytes.
    """
    lines = [
        f"{format_stamp(int(stamp_ns))} {float(x)!r} {float(y)!r} 0.0 "
        f"0.0 0.0 {math.sin(yaw / 2)!r} {math.cos(yaw / 2)!r}\n"
        for stamp_ns, (x, y, yaw) in zip(trajectory.stamps_ns, trajectory.xyyaw, strict=True)
    ]
    text = "# timestamp tx ty tz qx qy qz qw\n" + "".join(lines)
    write_whole(path, text.encode("ascii"))


def read_tum(path: Path) -> Trajectory:
    """The planar part (x, y and the heading of the x axis) of a trajectory of 3D poses.

    Blank lines and lines that begin with ``#`` are passed over. Raises InputError that names the
    line if one cannot be read or the stamps do not increase, and for a file without poses.
    """
    stamps_ns: list[int] = []
    rows: list[tuple[float, float, float]] = []
    for number, line in enumerate(text_lines(path, "trajectory", "in TUM form"), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{path}, line {number}"
        try:
            stamp_ns, row = _pose(line.split())
        except ValueError as error:
            raise InputError(str(error), where=where, remedy=_REMEDY) from error
        if stamps_ns and stamp_ns <= stamps_ns[-1]:
            raise InputError(
                f"the stamp {format_stamp(stamp_ns)} does not come after the one before it",
                where=where,
                remedy="Sort the file by time and leave out repeated stamps.",
            )
        stamps_ns.append(stamp_ns)
        rows.append(row)
    if not rows:
        raise InputError("there is no pose in this file", where=str(path), remedy=_REMEDY)
    return Trajectory(np.array(stamps_ns, dtype=np.int64), _array(rows))


def _array(rows: list[tuple[float, float, float]]) -> Array:
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def text_lines(path: Path, what: str, form: str) -> list[str]:
    """The lines of a text file. Raises InputError in these words if it can't be read."""
    with reading(f"cannot read the {what}", where=str(path), remedy=f"Give a text file {form}."):
        return path.read_text(encoding="utf-8").splitlines()


def _pose(words: list[str]) -> tuple[int, tuple[float, float, float]]:
    """(stamp ns, (x m, y m, yaw rad)) of one line. Raises ValueError that says what is wrong."""
    if len(words) != 8:
        raise ValueError(f"{len(words)} values where 8 are needed")
    x_m, y_m, z_m, qx, qy, qz, qw = (float(word) for word in words[1:])
    if not all(map(math.isfinite, (x_m, y_m, z_m, qx, qy, qz, qw))):
        raise ValueError("a value is not finite")
    if not within((x_m, y_m, z_m, qx, qy, qz, qw), FARTHEST_M):
        raise ValueError(f"a value is larger than {FARTHEST_M:g}")
    if math.hypot(qx, qy, qz, qw) < 1e-6:
        raise ValueError("the quaternion is zero")
    yaw = math.atan2(2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
    return parse_stamp_ns(words[0]), (x_m, y_m, yaw)
