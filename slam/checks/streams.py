"""One stream of a recording: what ``slam check`` measures and finds in it."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from datasets.messages import Array, LaserScan, Odometry
from datasets.se2 import xyyaw

Severity = Literal["ok", "warning", "error"]

LONG_GAP_S = 1.0
LONG_GAP_INTERVALS = 10.0
"""A gap is longer than both: this time, and so many usual intervals."""

MOST_INVALID = 0.3
MOST_NO_RETURN = 0.9
FEW_SCANS = 10
MOST_TILT_DEG = 5.0

FASTEST_M_S = 5.0
FASTEST_RAD_S = 2.0 * np.pi
"""What no robot indoors does."""

SPEED_OVER_S = 1.0
"""Speeds are taken over at least this time, since stamps jitter."""

ODOMETRY_REACH_S = 1.0
"""A scan further than this from any odometry is without it."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was found, and what can be done about it ("" where nothing need be)."""

    severity: Severity
    what: str
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class BeamReport:
    """The beams of a lidar. The shares are of all its beams.

    fewest, most   : in one scan.
    mounting_m_deg : on the base, x y z in m, roll pitch yaw in degrees.
    """

    fewest: int
    most: int
    invalid_share: float
    near_share: float
    no_return_share: float
    beam_times: bool
    mounting_m_deg: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ImageReport:
    """The images of a depth camera.

    hole_share     : of all pixels.
    mounting_m_deg : of its body (x looking ahead) on the base, x y z in m, roll pitch yaw in
                     degrees; positive pitch looks down.
    """

    width_px: int
    height_px: int
    hole_share: float
    mounting_m_deg: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class StreamReport:
    """One stream of messages, as it is after reading.

    rate_hz is 1 / the median interval; gaps are those longer than LONG_GAP_*.
    """

    name: str
    count: int
    start_ns: int
    duration_s: float
    rate_hz: float
    longest_gap_s: float
    gaps: int
    beams: BeamReport | None = None
    images: ImageReport | None = None


@dataclass(slots=True)
class LidarCheck:
    """Takes the scans of one lidar, one by one."""

    name: str
    T_base_lidar: Array
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    counts: set[int] = field(default_factory=set)
    beams: int = 0
    invalid: int = 0
    near: int = 0
    no_return: int = 0
    timed: bool = True

    def add(self, scan: LaserScan) -> None:
        ranges_m = scan.ranges_m
        self.stamps_ns.append(scan.stamp_ns)
        self.counts.add(ranges_m.size)
        self.beams += ranges_m.size
        self.timed = self.timed and scan.beam_offsets_s.size > 0
        not_measured = ~np.isfinite(ranges_m)
        if not_measured.any():
            self.invalid += int(np.count_nonzero(np.isnan(ranges_m)))
            self.no_return += int(np.count_nonzero(ranges_m == np.inf))
            self.near += int(np.count_nonzero(ranges_m == -np.inf))

    @property
    def blind(self) -> bool:
        """Whether not one beam measured anything."""
        return self.invalid + self.near + self.no_return == self.beams

    def report(self) -> StreamReport:
        beams = BeamReport(
            fewest=min(self.counts),
            most=max(self.counts),
            invalid_share=self.invalid / self.beams,
            near_share=self.near / self.beams,
            no_return_share=self.no_return / self.beams,
            beam_times=self.timed,
            mounting_m_deg=xyz_rpy_deg(self.T_base_lidar),
        )
        return StreamReport(
            f"scans of {self.name}", len(self.stamps_ns), *timing(self.stamps_ns), beams
        )

    def findings(self) -> list[Finding]:
        report = self.report()
        found = timing_findings(report)
        if report.count < FEW_SCANS:
            found.append(
                Finding("warning", f"only {report.count} {report.name}", "Record for longer")
            )
        low, high = min(self.counts), max(self.counts)
        if low < 0.5 * high:
            found.append(
                Finding(
                    "warning",
                    f"{report.name} have from {low} to {high} beams",
                    "Scans with few beams may be parts of a turn: check the driver",
                )
            )
        elif low < high:
            what = f"{report.name} have from {low} to {high} beams, {len(self.counts)} counts"
            found.append(Finding("ok", f"{what}: each is read with its own angles"))
        tilt_deg = float(np.degrees(np.arccos(np.clip(abs(self.T_base_lidar[2, 2]), 0.0, 1.0))))
        if tilt_deg > MOST_TILT_DEG:
            found.append(
                Finding(
                    "warning",
                    f"{self.name} is mounted with a tilt of {tilt_deg:.0f} deg",
                    "Its beams meet floor and ceiling, which are taken for walls: check its "
                    "mounting, or leave it out with --lidar",
                )
            )
        if not self.timed:
            found.append(Finding("ok", f"{report.name} tell no beam times: they are not de-skewed"))
        if self.invalid > MOST_INVALID * self.beams:
            found.append(
                Finding(
                    "warning",
                    f"{self.invalid / self.beams:.0%} of the beams of {self.name} are invalid",
                    "Clean the lidar's window; look for glass, or a mask that is too wide",
                )
            )
        if self.no_return > MOST_NO_RETURN * self.beams and not self.blind:
            found.append(
                Finding(
                    "warning",
                    f"{self.no_return / self.beams:.0%} of the beams of {self.name} "
                    "come back from nothing",
                    "The place may be too wide for this lidar: expect a weak map",
                )
            )
        return found


@dataclass(slots=True)
class OdometryCheck:
    """Takes the odometry, one by one."""

    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    poses: array[float] = field(default_factory=lambda: array("d"))

    def add(self, odometry: Odometry) -> None:
        self.stamps_ns.append(odometry.stamp_ns)
        self.poses.extend(xyyaw(odometry.T_odom_base))

    def report(self) -> StreamReport:
        return StreamReport("odometry", len(self.stamps_ns), *timing(self.stamps_ns))

    def findings(self, lidars: Sequence[LidarCheck]) -> list[Finding]:
        if not self.stamps_ns:
            return [
                Finding(
                    "warning",
                    "there is no odometry",
                    "The run has to match scans alone; choose a topic with --odometry if there is "
                    "one",
                )
            ]
        found = timing_findings(self.report())
        stamps_ns = np.frombuffer(self.stamps_ns, dtype=np.int64)
        poses = np.frombuffer(self.poses, dtype=np.float64).reshape(-1, 3)
        if stamps_ns.size > 1:
            found.extend(_motion_findings(stamps_ns, poses))
        for lidar in lidars:
            scans_ns = np.frombuffer(lidar.stamps_ns, dtype=np.int64)
            lost = np.count_nonzero(distance_s(scans_ns, stamps_ns) > ODOMETRY_REACH_S)
            if lost:
                found.append(
                    Finding(
                        "warning",
                        f"{lost} of {scans_ns.size} scans of {lidar.name} are more than "
                        f"{ODOMETRY_REACH_S:g} s away from any odometry",
                        "If the clocks differ by a constant, give clock_offset_s in --calibration",
                    )
                )
        return found


def timing(stamps_ns: Sequence[int]) -> tuple[int, float, float, float, int]:
    """start_ns, duration_s, rate_hz, longest_gap_s and the number of gaps."""
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    if stamps.size < 2:
        return int(stamps[0]), 0.0, 0.0, 0.0, 0
    intervals_s = np.diff(stamps) * 1e-9
    usual_s = float(np.median(intervals_s))
    gaps = int(np.count_nonzero(intervals_s > max(LONG_GAP_S, LONG_GAP_INTERVALS * usual_s)))
    duration_s = float(stamps[-1] - stamps[0]) * 1e-9
    return int(stamps[0]), duration_s, 1.0 / usual_s, float(intervals_s.max()), gaps


def timing_findings(report: StreamReport) -> list[Finding]:
    if not report.gaps:
        return []
    remedy = "In between odometry is interpolated, which is rough where the robot turned"
    if report.beams is not None:
        remedy = "They are bridged by odometry; without it the run may lose its place there"
    elif report.images is not None:
        remedy = "In between there is only what the lidars see"
    what = f"gaps in the {report.name}: {report.gaps}, the longest {report.longest_gap_s:.1f} s"
    return [Finding("warning", what, remedy)]


def xyz_rpy_deg(T_base_lidar: Array) -> tuple[float, ...]:
    R = T_base_lidar
    roll = np.arctan2(R[2, 1], R[2, 2])
    pitch = np.arctan2(-R[2, 0], np.hypot(R[2, 1], R[2, 2]))
    yaw = np.arctan2(R[1, 0], R[0, 0])
    return (*map(float, R[:3, 3]), *map(float, np.degrees([roll, pitch, yaw])))


def _motion_findings(
    stamps_ns: npt.NDArray[np.int64], poses: npt.NDArray[np.float64]
) -> list[Finding]:
    """poses : (N, 3) x m, y m, yaw rad."""
    found = []
    speed_m_s, turn_rad_s = _speeds(stamps_ns, poses, SPEED_OVER_S)
    impossible = (speed_m_s > FASTEST_M_S) | (turn_rad_s > FASTEST_RAD_S)
    if impossible.any():
        first = int(np.argmax(impossible))
        after_s = (stamps_ns[first] - stamps_ns[0]) * 1e-9
        found.append(
            Finding(
                "warning",
                f"odometry moves impossibly fast {np.count_nonzero(impossible)} times, up to "
                f"{speed_m_s.max():.1f} m/s and {turn_rad_s.max():.1f} rad/s; first after "
                f"{after_s:.1f} s",
                "If the robot was carried or its odometry reset there, cut with --start and "
                "--duration, or use --no-odometry",
            )
        )
    else:
        steps_m_s, steps_rad_s = _speeds(stamps_ns, poses, 0.0)
        share = float(np.mean((steps_m_s > FASTEST_M_S) | (steps_rad_s > FASTEST_RAD_S)))
        if share > 0.01:
            found.append(
                Finding(
                    "ok",
                    f"the stamps of the odometry jitter: {share:.0%} of its steps are impossibly "
                    f"fast, but over {SPEED_OVER_S:g} s it moves as it should",
                )
            )
    if np.ptp(poses[:, :2], axis=0).max() < 1e-3 and np.ptp(np.unwrap(poses[:, 2])) < 1e-3:
        found.append(
            Finding(
                "warning",
                "the odometry never moves",
                "If the robot did, its odometry was not running: use --no-odometry",
            )
        )
    return found


def _speeds(
    stamps_ns: npt.NDArray[np.int64], poses: npt.NDArray[np.float64], over_s: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Speeds (m/s, rad/s) from each pose to the first that is later by more than ``over_s``."""
    later = np.searchsorted(stamps_ns, stamps_ns + max(1, round(over_s * 1e9)))
    now = np.arange(stamps_ns.size)[later < stamps_ns.size]
    if now.size == 0:
        return np.zeros(1), np.zeros(1)
    later = later[now]
    seconds = (stamps_ns[later] - stamps_ns[now]) * 1e-9
    way_m = np.hypot(*(poses[later, :2] - poses[now, :2]).T)
    turn_rad = np.abs((poses[later, 2] - poses[now, 2] + np.pi) % (2.0 * np.pi) - np.pi)
    return way_m / seconds, turn_rad / seconds


def distance_s(
    stamps_ns: npt.NDArray[np.int64], others_ns: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64]:
    """Seconds from each stamp to the nearest of others (sorted, at least one)."""
    after = np.clip(np.searchsorted(others_ns, stamps_ns), 0, others_ns.size - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.minimum(
        np.abs(stamps_ns - others_ns[before]), np.abs(stamps_ns - others_ns[after])
    )
    seconds: npt.NDArray[np.float64] = nearest * 1e-9
    return seconds
