"""``slam check``: every kind of trouble is found, and only then."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from datasets.calibration_file import mounting
from datasets.carmen import CarmenRecording
from datasets.messages import Array, LaserScan, Message, Odometry
from datasets.open_recording import open_recording
from datasets.options import ReadOptions
from datasets.recording import Calibration, LidarCalibration
from datasets.se2 import se2
from datasets.trajectory import Trajectory
from slam.checks.check import CheckReport, check_recording, exit_code, print_report

SECOND = 1_000_000_000
INF, NAN = math.inf, math.nan


@dataclass
class Recorded:
    """A recording from a list."""

    messages: Sequence[Message]
    name: str = "made"
    notes: Counter[str] = field(default_factory=Counter)
    calibration: Calibration = field(
        default_factory=lambda: Calibration(
            {"/scan": LidarCalibration(mounting((0.1, 0.0, 0.5), (math.pi, 0.0, 0.5)))}
        )
    )

    def __iter__(self) -> Iterator[Message]:
        return iter(self.messages)

    def ground_truth(self) -> Trajectory | None:
        return None


def scan(time_s: float, ranges_m: Sequence[float] = (1.0, 2.0, 3.0, 4.0)) -> LaserScan:
    ranges: Array = np.array(ranges_m, dtype=np.float64)
    offsets = np.linspace(0.0, 0.1, ranges.size)
    bearings = np.linspace(-1.0, 1.0, ranges.size)
    return LaserScan(round(time_s * SECOND), "/scan", ranges, bearings, offsets, 0.1, 10.0)


def odometry(time_s: float, x_m: float | None = None) -> Odometry:
    x_m = 0.5 * time_s if x_m is None else x_m
    return Odometry(round(time_s * SECOND), se2(x_m, 0.0, 0.0))


def drive(seconds: float = 20.0) -> list[Message]:
    messages: list[Message] = [odometry(t) for t in np.arange(0.0, seconds, 0.05)]
    messages += [scan(t) for t in np.arange(0.02, seconds, 0.1)]
    return sorted(messages, key=lambda message: message.stamp_ns)


def check(messages: Sequence[Message], **notes: int) -> CheckReport:
    recorded = Recorded(messages)
    recorded.notes.update(notes)
    return check_recording(recorded)


def found(report: CheckReport, severity: str) -> list[str]:
    return [finding.what for finding in report.findings if finding.severity == severity]


def test_a_good_recording_has_no_findings_and_true_numbers() -> None:
    report = check(drive())
    assert not report.findings
    assert exit_code(report) == 0
    scans, poses = report.streams
    assert (scans.name, scans.count, scans.gaps) == ("scans of /scan", 200, 0)
    assert scans.rate_hz == pytest.approx(10.0)
    assert scans.duration_s == pytest.approx(19.9)
    assert poses.count == 400
    assert scans.beams is not None
    assert scans.beams.beam_times
    expected = (0.1, 0.0, 0.5, 180.0, 0.0, math.degrees(0.5))
    assert scans.beams.mounting_m_deg == pytest.approx(expected)


def test_shares_are_of_all_beams() -> None:
    report = check([scan(i / 10, [1.0, NAN, INF, -INF, INF]) for i in range(10)])
    beams = report.streams[0].beams
    assert beams is not None
    shares = (beams.invalid_share, beams.near_share, beams.no_return_share)
    assert shares == pytest.approx((0.2, 0.2, 0.4))


@pytest.mark.parametrize(
    "messages",
    [
        [],
        [odometry(t) for t in np.arange(0.0, 5.0, 0.1)],
        [m if isinstance(m, Odometry) else scan(m.stamp_ns / SECOND, [NAN, INF]) for m in drive()],
    ],
)
def test_no_run_can_come_from_nothing(messages: list[Message]) -> None:
    report = check(messages)
    assert exit_code(report) == 2
    assert report.findings[0].severity == "error"
    assert report.findings[0].remedy


@pytest.mark.parametrize(
    ("messages", "word"),
    [
        ([m for m in drive() if isinstance(m, LaserScan)], "no odometry"),
        ([m for m in drive() if not 5 * SECOND < m.stamp_ns < 8 * SECOND], "gaps in the scans"),
        ([m for m in drive() if not 5 * SECOND < m.stamp_ns < 8 * SECOND], "gaps in the odometry"),
        (drive(0.5), "only 5 scans"),
        ([*drive(), scan(20.1, [1.0])], "from 1 to 4 beams"),
        ([*drive(), *(scan(20 + i / 10, [NAN] * 9) for i in range(99))], "invalid"),
        ([*drive(), *(scan(20 + i / 100, [INF] * 30) for i in range(999))], "from nothing"),
        ([*drive(), *(odometry(20 + i / 20, 20.0 + i) for i in range(30))], "impossibly fast"),
        ([m if isinstance(m, LaserScan) else odometry(m.stamp_ns / SECOND, 0) for m in drive()],
         "never moves"),
        ([*drive(), *(scan(20 + i / 10) for i in range(40))], "away from any odometry"),
    ],
)  # fmt: skip
def test_trouble_is_a_warning(messages: list[Message], word: str) -> None:
    report = check(messages)
    assert exit_code(report) == 1
    assert any(word in what for what in found(report, "warning")), report.findings


def test_a_lidar_without_a_scan_and_one_that_is_tilted_are_told_of() -> None:
    recorded = Recorded(drive())
    tilted = mounting((0.1, 0.0, 0.5), (math.pi, math.radians(20.0), 0.5))
    recorded.calibration.lidars["/scan"] = LidarCalibration(tilted)
    recorded.calibration.lidars["/low"] = LidarCalibration(np.eye(4))
    report = check_recording(recorded)
    assert exit_code(report) == 1
    low, tilt = sorted(found(report, "warning"))
    assert low.startswith("/low has no scan")
    assert "/scan is mounted with a tilt of 20 deg" in tilt


def test_odometry_that_jumps_away_and_jitter_are_told_apart() -> None:
    jittering = [
        odometry(m.stamp_ns / SECOND + 0.0499 * (i % 2), 0.5 * m.stamp_ns / SECOND)
        if isinstance(m, Odometry)
        else m
        for i, m in enumerate(drive())
    ]
    report = check(sorted(jittering, key=lambda message: message.stamp_ns))
    assert exit_code(report) == 0
    assert "jitter" in found(report, "ok")[0]
    jumping = [
        odometry(m.stamp_ns / SECOND, 0.5 * m.stamp_ns / SECOND + 30.0 * (m.stamp_ns > 9 * SECOND))
        if isinstance(m, Odometry)
        else m
        for m in drive()
    ]
    (what,) = found(check(jumping), "warning")
    assert "impossibly fast" in what
    assert "first after 8." in what


def test_slightly_varying_counts_are_told_but_fine() -> None:
    messages = [m if isinstance(m, Odometry) else scan(m.stamp_ns / SECOND, [1.0] * (90 + i % 7))
                for i, m in enumerate(drive())]  # fmt: skip
    report = check(messages)
    assert exit_code(report) == 0
    assert "from 90 to 96 beams, 7 counts" in found(report, "ok")[0]


def test_notes_of_the_reader_are_findings() -> None:
    report = check(drive(), **{"range of 0 taken as no return": 7})
    assert exit_code(report) == 0
    assert found(report, "ok") == ["range of 0 taken as no return (7 times)"]
    report = check(drive(), **{"scan left out: stamp runs backwards": 3})
    assert exit_code(report) == 1
    (finding,) = report.findings
    assert "(3 times)" in finding.what
    assert "clock" in finding.remedy


def printed(report: CheckReport) -> str:
    out = io.StringIO()
    print_report(report, Console(file=out, width=100))
    return out.getvalue()


def test_a_report_is_printed_whole() -> None:
    text = printed(check(drive(), **{"[/scan] left out": 2}))
    for part in ("scans of /scan", "10.0", "180 0 29", "[/scan] left out (2 times)", "warnings"):
        assert part in text
    assert "No run can come from it" in printed(check([]))


def test_a_broken_log_is_found_out(tmp_path: Path) -> None:
    lines = [f"FLASER 2 1.5 2.5 0 0 0 {i / 50} 0 0 {100 + i / 10:.1f} h 0" for i in range(200)]
    lines[50] = lines[50].replace("105.0", "86505.0")
    lines[60] = lines[60].replace("FLASER 2", "FLASER 3")
    lines[70:130] = []
    path = tmp_path / "broken.log"
    path.write_text("\n".join(lines))
    report = check_recording(CarmenRecording([path], ReadOptions()))
    assert exit_code(report) == 1
    warnings = "\n".join(found(report, "warning"))
    assert "scan left out: stamp jumps ahead and back" in warnings
    assert "scan left out: wrong number of ranges" in warnings
    assert "gaps in the scans of front: 1, the longest 6.1 s" in warnings


@pytest.mark.parametrize(
    ("name", "code", "scans"),
    [("intel.log.gz", 1, 2947), ("guardian_controller_2.bag", 0, 2059)],
)
def test_real_recordings_are_usable(shared_data: Path, name: str, code: int, scans: int) -> None:
    recording = open_recording([shared_data / "recordings" / name], ReadOptions())
    report = check_recording(recording)
    assert exit_code(report) == code
    assert sum(stream.count for stream in report.streams if stream.beams is not None) == scans
