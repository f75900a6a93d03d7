"""What is in a recording and what is wrong with it: ``slam check``.

Findings come from the messages, and from what the reader had to change or leave out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from datasets.messages import DepthImage, LaserScan, Odometry
from datasets.recording import Recording
from slam.checks.cameras import CameraCheck
from slam.checks.streams import (
    BeamReport,
    Finding,
    ImageReport,
    LidarCheck,
    OdometryCheck,
    Severity,
    StreamReport,
)

if TYPE_CHECKING:
    from rich.console import Console

EXIT_CODES: dict[Severity, int] = {"ok": 0, "warning": 1, "error": 2}

VERDICTS: dict[Severity, str] = {
    "ok": "Ready for a run.",
    "warning": "A run can come from it; see the warnings.",
    "error": "No run can come from it.",
}

HARMLESS_NOTES = ("range ", "negative range", "beam left out: masked")
"""How a note begins of what the reader normalises as a matter of course,"""

HARMLESS_WORDS = ("it repeats the images of", "by its name it is no depth image", "for its frame")
"""and what stands in one of what it chooses as a matter of course."""


@dataclass(frozen=True, slots=True)
class CheckReport:
    """ground_truth_poses: how many there are, 0 without ground truth.

    notes: what the reader changed or left out, with how often.
    """

    name: str
    streams: tuple[StreamReport, ...]
    findings: tuple[Finding, ...]
    ground_truth_poses: int
    notes: tuple[tuple[str, int], ...]

    @property
    def severity(self) -> Severity:
        """That of the worst finding."""
        return max((f.severity for f in self.findings), key=EXIT_CODES.__getitem__, default="ok")


def exit_code(report: CheckReport) -> int:
    """0: nothing wrong. 1: usable, with warnings. 2: no run can come from it."""
    return EXIT_CODES[report.severity]


def check_recording(recording: Recording) -> CheckReport:
    """Read a recording once, as a stream, and say what is in it.

    Memory: 32 bytes a message. Raises InputError where the reader does.
    """
    lidars: dict[str, LidarCheck] = {}
    cameras: dict[str, CameraCheck] = {}
    odometry = OdometryCheck()
    for message in recording:
        if isinstance(message, LaserScan):
            name = message.lidar
            if name not in lidars:
                lidars[name] = LidarCheck(name, recording.calibration.lidars[name].T_base_lidar)
            lidars[name].add(message)
        elif isinstance(message, DepthImage):
            name = message.camera
            if name not in cameras:
                T_base_camera = recording.calibration.cameras[name].T_base_camera
                assert T_base_camera is not None  # a reader gives images of known cameras only
                cameras[name] = CameraCheck(name, T_base_camera)
            cameras[name].add(message)
        elif isinstance(message, Odometry):
            odometry.add(message)
    notes = tuple(sorted(recording.notes.items()))
    findings: list[Finding] = []
    for lidar in lidars.values():
        findings.extend(lidar.findings())
    stamps_ns = chain.from_iterable(lidar.stamps_ns for lidar in lidars.values())
    scans_ns = np.sort(np.fromiter(stamps_ns, dtype=np.int64))
    for camera in cameras.values():
        findings.extend(camera.findings(scans_ns))
    sensors: list[LidarCheck | CameraCheck] = [*lidars.values(), *cameras.values()]
    if all(sensor.blind for sensor in sensors):
        findings.insert(0, _nothing_to_see(bool(lidars)))
    elif all(lidar.blind for lidar in lidars.values()):
        findings.insert(0, _cameras_only(bool(lidars)))
    findings.extend(
        Finding(
            "warning",
            f"{name} has no {kind} in this part",
            "If it should have, its clock is off: check without --start and --duration",
        )
        for kind, known, seen in (
            ("scan", recording.calibration.lidars, lidars),
            ("image", recording.calibration.cameras, cameras),
        )
        for name in known
        if sensors and name not in seen
    )
    findings.extend(odometry.findings(list(lidars.values())))
    findings.extend(_finding_of_note(note, count) for note, count in notes)
    streams = [lidar.report() for _, lidar in sorted(lidars.items())]
    streams += [camera.report() for _, camera in sorted(cameras.items())]
    if odometry.stamps_ns:
        streams.append(odometry.report())
    findings.sort(key=lambda finding: -EXIT_CODES[finding.severity])
    truth = recording.ground_truth()
    poses = 0 if truth is None else len(truth)
    return CheckReport(recording.name, tuple(streams), tuple(findings), poses, notes)


def print_report(report: CheckReport, console: Console) -> None:
    """Show a report: tables of streams, then the findings, the worst first, then a verdict."""
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    def show(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        table = Table(header_style="")
        for heading in headings:
            table.add_column(heading, justify="left" if heading == headings[0] else "right")
        for row in rows:
            table.add_row(*map(escape, row))
        if rows:
            console.print(table)

    console.print(f"[bold]{escape(report.name)}[/]")
    start_ns = min((stream.start_ns for stream in report.streams), default=0)
    times = ("stream", "messages", "rate Hz", "from s", "to s", "longest gap s")
    show(times, [_timing_row(stream, start_ns) for stream in report.streams])
    beams = ("beams", "number", "invalid", "too near", "no return", "x y z m, roll pitch yaw deg")
    show(beams, [_beam_row(s.name, s.beams) for s in report.streams if s.beams is not None])
    images = ("images", "size px", "holes", "x y z m, roll pitch yaw deg")
    show(images, [_image_row(s.name, s.images) for s in report.streams if s.images is not None])
    if report.ground_truth_poses:
        console.print(f"ground truth: {report.ground_truth_poses} poses")
    styles = {"ok": "dim", "warning": "yellow", "error": "bold red"}
    for finding in report.findings:
        line = f"[{styles[finding.severity]}]{finding.severity:>7}[/]  {escape(finding.what)}"
        console.print(line + (f". [dim]{escape(finding.remedy)}.[/]" if finding.remedy else ""))
    console.print(VERDICTS[report.severity])


def _timing_row(stream: StreamReport, start_ns: int) -> list[str]:
    from_s = (stream.start_ns - start_ns) * 1e-9
    to_s = from_s + stream.duration_s
    numbers = (f"{stream.rate_hz:.1f}", f"{from_s:.1f}", f"{to_s:.1f}")
    return [stream.name, f"{stream.count}", *numbers, f"{stream.longest_gap_s:.2f}"]


def _beam_row(name: str, beams: BeamReport) -> list[str]:
    count = f"{beams.most}" if beams.fewest == beams.most else f"{beams.fewest}-{beams.most}"
    shares = (beams.invalid_share, beams.near_share, beams.no_return_share)
    return [name, count, *(f"{share:.1%}" for share in shares), _mounting(beams.mounting_m_deg)]


def _image_row(name: str, images: ImageReport) -> list[str]:
    size = f"{images.width_px} x {images.height_px}"
    return [name, size, f"{images.hole_share:.1%}", _mounting(images.mounting_m_deg)]


def _mounting(mounting_m_deg: Sequence[float]) -> str:
    x, y, z, *angles_deg = mounting_m_deg
    angles = " ".join(f"{round(angle_deg)}" for angle_deg in angles_deg)
    return f"{x:.2f} {y:.2f} {z:.2f}, {angles}"


def _nothing_to_see(has_scans: bool) -> Finding:
    if has_scans:
        return Finding(
            "error",
            "not one beam of any scan has a range",
            "Check the lidar, its range_min and range_max, and the masks of --calibration",
        )
    return Finding(
        "error",
        "there is no scan that can be used",
        "Record the lidar as well; if scans were left out, the warnings below say why",
    )


def _cameras_only(has_scans: bool) -> Finding:
    what = "not one beam of any scan has a range" if has_scans else "there is no scan of a lidar"
    return Finding("warning", what, "Only what the depth cameras see can be mapped")


def _finding_of_note(note: str, count: int) -> Finding:
    """What a reader's note means for a run."""
    if note.startswith(HARMLESS_NOTES) or any(words in note for words in HARMLESS_WORDS):
        return Finding("ok", f"{note} ({count} times)")
    remedies = {
        "clock set back": "Stamps in the results are moved as well; mend the robot's clock",
        "gap of more than an hour": "If its parts don't belong together, cut with --start",
        "stamp": "The rest is used; if there are many, mend the clock of the sensor or its driver",
        "its recorder was killed": "All before is read; if the original is whole, copy it again",
        "damaged": "Copy it again; for a bag, --salvage reads what is readable",
        "its intrinsics are for": "Record the CameraInfo of the same mode, or give `intrinsics` "
        "with --calibration",
        "without one measurement": "Look for what covered the camera, or stood too near to it",
        "its lens": "Record rectified images",
        "taken as that of the body": "Give the mounting with --calibration if that is wrong",
        "mounting": "Give the mounting with --calibration",
        "assumed": "Give it with --calibration",
        "taken as the base": "Give the mounting with --calibration if that is wrong",
        "odometry taken from": "",
        "no odometry": "Choose a topic with --odometry if there is one",
    }
    remedy = next((text for word, text in remedies.items() if word in note), "")
    return Finding("warning", f"{note} ({count} times)" if count > 1 else note, remedy)
