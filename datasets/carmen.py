"""CARMEN logs: text, one message a line, often gzipped.

    PARAM name value ipc_timestamp host logger_timestamp
    ODOM x y theta tv rv accel ipc_timestamp host logger_timestamp
    FLASER n range*n x y theta odom_x odom_y odom_theta ipc_timestamp host logger_timestamp
    ROBOTLASER1 type start fov resolution range_max accuracy remission_mode n range*n m remission*m
        laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv forward side turn_axis
        ipc_timestamp host logger_timestamp
    RAWLASER1 the same without what stands between the remissions and the time stamp

The front lidar is FLASER, ROBOTLASER1 or RAWLASER1 (the first of these that the log has), the rear
one RLASER, ROBOTLASER2 or RAWLASER2; they are named ``front`` and ``rear``. The stamp is the
ipc_timestamp: the logger's may count from the start of the log, and the published relations of
``intel`` and ``fr079`` are in ipc time.

Odometry comes twice. A laser line carries the odometry of its own moment; it is given at the very
stamp of the scan, just before it. ODOM lines are given as well: the logger stamps them when it
gets round to them, so that on ``intel`` 18 % of the steps between them would be faster than 2 m/s,
but they are all there is between scans. Over the relations that lie between scans there, the error
in length of the raw odometry is 0.042 m with them, 0.095 m without and 0.06 to 0.08 m with those
left out that would be too fast. Whoever wants a speed has to take it over longer than a step.
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np

from datasets.bounds import FARTHEST_MOUNTING_M
from datasets.calibration_file import mounting, read_calibration_file
from datasets.carmen_lines import (
    LASERS,
    BadLineError,
    LaserLine,
    read_laser_line,
    read_odometry_line,
    sick_range_max_m,
)
from datasets.errors import InputError, one_line
from datasets.messages import Array, LaserScan, Message, Odometry
from datasets.normalise import mask_beams, normalise_ranges
from datasets.options import ReadOptions
from datasets.recording import Calibration
from datasets.se2 import inverse, se2, xyyaw
from datasets.time_order import TimeOrder, cut
from datasets.trajectory import Trajectory
from datasets.unpack import Allowance, DamagedError

PEEK_LINES = 2000
"""So many lines are looked at beforehand, for parameters and for what kinds of line there are."""

LONGEST_LINE = 1 << 20
SPARE_TEXT_BYTES = 64 << 20
MOST_TEXT_RATIO = 100
"""What a gzipped log may unpack to, as in ``unpack.py``; digits of ranges shrink by 4 to 10."""

LONGEST_SICK_M = 82.0
NO_BEAM_TIMES = np.empty(0)
KEYWORDS = (b"PARAM", b"SYNC", b"ODOM", b"TRUEPOS", *(word.encode() for word in LASERS))


class CarmenRecording:
    """A CARMEN log, or several that follow each other, as a ``Recording``.

    paths : the parts in any order; their first stamps tell which comes first.

    Raises InputError if a file can't be opened, holds no CARMEN line, or if an option asks for
    what a CARMEN log doesn't have.
    """

    def __init__(self, paths: Sequence[Path], options: ReadOptions) -> None:
        self.name = paths[0].name.removesuffix(".gz").removesuffix(".log").removesuffix(".clf")
        self.notes: Counter[str] = Counter()
        self._paths = tuple(sorted(paths, key=_first_stamp_ns) if len(paths) > 1 else paths)
        self._options = options
        self._file = read_calibration_file(options.calibration)
        self.calibration = Calibration()
        self._parameters: dict[str, float] = {}
        self._words: dict[str, str] = {}  # the kind of line each lidar is read from
        self._peek()
        self._check_options()

    def ground_truth(self) -> Trajectory | None:
        """CARMEN logs have none."""
        return None

    def __iter__(self) -> Iterator[Message]:
        self.notes.clear()
        return cut(self._ordered(), self._options)

    def _ordered(self) -> Iterator[Message]:
        order: TimeOrder[Message] = TimeOrder(self.notes)
        for stream, message in self._messages():
            yield from order.push(stream, message)
        yield from order.flush()

    def _messages(self) -> Iterator[tuple[str, Message]]:
        """Messages as the lines have them, each with the name of its stream."""
        held: Odometry | None = None  # an ODOM line gives way to a laser line of the same stamp
        laser_stamp_ns = -1
        use_odometry = self._options.use_odometry
        for tokens in self._lines():
            word = tokens[0].decode("ascii", "replace")
            try:
                if word == "ODOM" and use_odometry:
                    if held is not None:
                        yield "odometry", held
                        held = None
                    stamp_ns, pose = read_odometry_line(tokens)
                    if stamp_ns != laser_stamp_ns:
                        held = Odometry(stamp_ns, se2(*pose))
                elif word in LASERS:
                    if not self._wanted(word):
                        continue
                    laser = read_laser_line(word, tokens)
                    laser_stamp_ns = laser.stamp_ns
                    keeps_its_place = laser.robot is None or (
                        held is not None and held.stamp_ns != laser.stamp_ns
                    )
                    if held is not None and keeps_its_place:
                        yield "odometry", held
                    held = None
                    if use_odometry and laser.robot is not None:
                        yield "odometry", Odometry(laser.stamp_ns, se2(*laser.robot))
                    scan = self._scan(LASERS[word], laser)
                    yield ("scan" if scan.lidar == "front" else "rear scan"), scan
                elif word == "PARAM":
                    self._read_parameter(tokens)
                elif not (_is_keyword(word) or word.startswith("#")):
                    raise BadLineError("line", "no CARMEN message")
            except (BadLineError, ValueError, ArithmeticError) as error:
                self._leave_out(error)
        if held is not None:
            yield "odometry", held

    def _leave_out(self, error: Exception) -> None:
        """A line that is damaged, or whose numbers no message can have, costs itself."""
        kind, reason = "line", one_line(str(error), 100)
        if isinstance(error, BadLineError):
            kind, reason = error.kind, error.reason
        self.notes[f"{kind} left out: {reason}"] += 1

    def _wanted(self, word: str) -> bool:
        lidar = LASERS[word]
        if self._options.lidars and lidar not in self._options.lidars:
            return False
        return self._words.setdefault(lidar, word) == word

    def _scan(self, lidar: str, laser: LaserLine) -> LaserScan:
        calibration = self.calibration.lidars.get(lidar)
        if calibration is None:
            calibration = self._file.lidar(lidar, self._mounting(lidar, laser))
            assert calibration is not None  # a CARMEN lidar always has a mounting
            self.calibration.lidars[lidar] = calibration
        range_max_m = self._range_max_m
        if laser.range_max_m is not None:  # a SICK of 81.92 m tells its error codes below that
            own_m = laser.range_max_m
            range_max_m = own_m if own_m > LONGEST_SICK_M else min(own_m, range_max_m)
        normalise_ranges(laser.ranges_m, 0.0, range_max_m, self.notes)
        if calibration.masks_rad:
            mask_beams(laser.ranges_m, laser.bearings_rad, calibration.masks_rad, self.notes)
        stamp_ns = laser.stamp_ns + self._file.clock_offset_ns(lidar)
        return LaserScan(
            stamp_ns, lidar, laser.ranges_m, laser.bearings_rad, NO_BEAM_TIMES, 0.0, range_max_m
        )

    def _mounting(self, lidar: str, laser: LaserLine) -> Array:
        """T_base_lidar from the parameters, else from the poses of a ROBOTLASER line."""
        stem = f"robot_{lidar}laser"
        x_m = self._parameters.get(f"{stem}_offset")
        if x_m is None and laser.lidar is not None and laser.robot is not None:
            x, y, yaw = xyyaw(inverse(se2(*laser.robot)) @ se2(*laser.lidar))
            if math.hypot(x, y) < 2.0:  # otherwise one of them is a pose corrected by SLAM
                return mounting((x, y, 0.0), (0.0, 0.0, yaw))
        y_m = self._parameters.get(f"{stem}_side_offset", 0.0)
        # CARMEN's rear lidar looks backwards unless something else is said.
        ahead_rad = 0.0 if lidar == "front" else math.pi
        yaw_rad = self._parameters.get(f"{stem}_angular_offset", ahead_rad)
        if x_m is None:
            self.notes[f"no PARAM {stem}_offset: lidar assumed at the base's centre"] += 1
        return mounting((x_m or 0.0, y_m, 0.0), (0.0, 0.0, yaw_rad))

    def _read_parameter(self, tokens: list[bytes]) -> None:
        name = tokens[1].decode("ascii", "replace") if len(tokens) > 2 else ""
        if name.startswith(("robot_frontlaser_", "robot_rearlaser_")) and "offset" in name:
            try:
                value = float(tokens[2])
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise BadLineError("parameter", f"{name} is no number")
            if abs(value) > FARTHEST_MOUNTING_M:
                raise BadLineError("parameter", f"{name} is out of range")
            if self._parameters.setdefault(name, value) != value:
                raise BadLineError("parameter", f"{name} changes; the first value holds")

    def _lines(self) -> Iterator[list[bytes]]:
        for path in self._paths:
            for line in _read_lines(path, self.notes):
                tokens = line.split()
                if tokens:
                    yield tokens

    def _peek(self) -> None:
        """Look at the first lines for parameters, kinds of laser line and the largest range."""
        kinds: set[str] = set()
        known, longest_m = 0, 0.0
        for count, tokens in enumerate(self._lines()):
            if count >= PEEK_LINES:
                break
            known += tokens[0] in KEYWORDS
            word = tokens[0].decode("ascii", "replace")
            try:
                if word == "PARAM":
                    self._read_parameter(tokens)
                elif word in LASERS:
                    laser = read_laser_line(word, tokens)
                    kinds.add(word)
                    finite = laser.ranges_m[np.isfinite(laser.ranges_m)]
                    longest_m = max(longest_m, finite.max(initial=0.0))
            except BadLineError:
                continue
        if not known:
            raise InputError(
                "no line of a CARMEN log is in it",
                where=str(self._paths[0]),
                remedy="Give a CARMEN log (FLASER, ODOM lines), a ROS 1 bag or a ROS 2 bag",
            )
        for word, lidar in LASERS.items():  # in the order of preference
            if word in kinds:
                self._words.setdefault(lidar, word)
        self._range_max_m = sick_range_max_m(longest_m)
        self.notes.clear()

    def _check_options(self) -> None:
        lidars = sorted(set(LASERS.values()))
        self._file.require_known(lidars)
        if self._options.use_cameras:
            self._file.require_known_cameras(())
        if self._options.cameras or not self._options.use_lidars:
            raise InputError(
                "a CARMEN log holds no depth camera",
                where=str(self._paths[0]),
                remedy="Leave the choice of cameras out",
            )
        for lidar in self._options.lidars:
            if lidar not in lidars:
                raise InputError(
                    f"there is no lidar {lidar} in a CARMEN log",
                    where=str(self._paths[0]),
                    remedy=f"Its lidars are called {' and '.join(lidars)}",
                )
        topics = {
            "odometry": self._options.odometry or self._file.odometry,
            "ground truth": self._options.ground_truth or self._file.ground_truth,
        }
        for what, topic in topics.items():
            if topic is not None:
                raise InputError(
                    f"a CARMEN log has no topics, so {topic} can't be its {what}",
                    where=str(self._paths[0]),
                    remedy=f"Leave the choice of {what} out",
                )


def _first_stamp_ns(path: Path) -> float:
    """The stamp of the first line that has one; a file without any comes last."""
    for line in islice(_read_lines(path, Counter()), PEEK_LINES):
        tokens = line.split()
        word = tokens[0].decode("ascii", "replace") if tokens else ""
        with suppress(BadLineError):
            if word == "ODOM":
                return read_odometry_line(tokens)[0]
            if word in LASERS:
                return read_laser_line(word, tokens).stamp_ns
    return math.inf


def _is_keyword(word: str) -> bool:
    return word.isascii() and word.isupper() and word.replace("_", "").isalnum()


def _read_lines(path: Path, notes: Counter[str]) -> Iterator[bytes]:
    """The lines of a file, gzipped or not; what stands before damage is read, and damage noted."""
    try:
        with path.open("rb") as raw:
            zipped = raw.read(2) == b"\x1f\x8b"
            raw.seek(0)
            stream = gzip.GzipFile(fileobj=raw) if zipped else raw
            allowance = Allowance(path.stat().st_size, SPARE_TEXT_BYTES, MOST_TEXT_RATIO)
            while line := stream.readline(LONGEST_LINE):
                allowance.take(len(line))
                yield line
    except DamagedError as error:
        notes[f"{path.name} is damaged, {error}: read up to there"] += 1
    except (EOFError, zlib.error, gzip.BadGzipFile):
        notes[f"{path.name} is cut off or damaged: read up to there"] += 1
    except OSError as error:
        raise InputError(
            f"it can't be read ({error.strerror})", where=str(path), remedy="Check path and rights"
        ) from error
