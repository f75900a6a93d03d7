"""``slam check`` on depth cameras: what they are, and what is wrong with them."""

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

from datasets.bags import BagRecording
from datasets.calibration_file import T_BODY_OPTICAL, mounting
from datasets.messages import Array, DepthImage, LaserScan, Message, Odometry
from datasets.options import ReadOptions
from datasets.recording import Calibration, CameraCalibration, LidarCalibration
from datasets.se2 import se2
from datasets.trajectory import Trajectory
from slam.checks.check import CheckReport, check_recording, exit_code, print_report
from tests.datasets.bag_factory import (
    T0_NS,
    Entry,
    S,
    camera_info_entry,
    image_entry,
    odometry_entry,
    scan_entry,
    tf_entry,
    write_bag,
)


@dataclass
class Recorded:
    """A recording from a list, with a camera that looks down by 10 degrees."""

    messages: Sequence[Message]
    T_base_camera: Array = field(
        default_factory=lambda: (
            mounting((0.3, 0.1, 0.25), (0.0, math.radians(10), 0.0)) @ T_BODY_OPTICAL
        )
    )
    name: str = "made"
    notes: Counter[str] = field(default_factory=Counter)

    @property
    def calibration(self) -> Calibration:
        return Calibration(
            {"/scan": LidarCalibration(np.eye(4))},
            {"/depth": CameraCalibration(self.T_base_camera, None)},
        )

    def __iter__(self) -> Iterator[Message]:
        return iter(sorted(self.messages, key=lambda message: message.stamp_ns))

    def ground_truth(self) -> Trajectory | None:
        return None


def image(time_s: float, *, holes: int = 12) -> DepthImage:
    depth = np.full((6, 8), 1.5, dtype=np.float32)
    depth.ravel()[:holes] = np.nan
    return DepthImage(round(time_s * S), "/depth", depth)


def others(seconds: float = 20.0) -> list[Message]:
    ranges, bearings = np.ones(9), np.linspace(-1, 1, 9)
    scans: list[Message] = [
        LaserScan(round(t * S), "/scan", ranges, bearings, np.linspace(0, 0.1, 9), 0.1, 10.0)
        for t in np.arange(0.0, seconds, 0.1)
    ]
    poses = [Odometry(round(t * S), se2(0.5 * t, 0, 0)) for t in np.arange(0, seconds, 0.1)]
    return [*scans, *poses]


def images(from_s: float = 0.0, to_s: float = 20.0, *, holes: int = 12) -> list[Message]:
    return [image(t, holes=holes) for t in np.arange(from_s, to_s, 0.2)]


def warnings(report: CheckReport) -> list[str]:
    return [finding.what for finding in report.findings if finding.severity == "warning"]


def printed(report: CheckReport) -> str:
    out = io.StringIO()
    print_report(report, Console(file=out, width=160))
    return out.getvalue()


def test_a_good_camera_is_a_stream_without_findings() -> None:
    report = check_recording(Recorded([*others(), *images()]))
    assert not report.findings
    stream = next(stream for stream in report.streams if stream.images is not None)
    assert (stream.name, stream.count, stream.gaps) == ("images of /depth", 100, 0)
    assert stream.rate_hz == pytest.approx(5.0)
    assert stream.images is not None
    assert (stream.images.width_px, stream.images.height_px) == (8, 6)
    assert stream.images.hole_share == pytest.approx(0.25)
    assert stream.images.mounting_m_deg == pytest.approx((0.3, 0.1, 0.25, 0, 10, 0), abs=1e-9)
    text = printed(report)
    for part in ("images of /depth", "8 x 6", "25.0%", "0.30 0.10 0.25, 0 10 0"):
        assert part in text


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        (images(0, 9), "end 11.1 s before the scans"),
        (images(5, 20), "begin 5.0 s after the scans"),
        (images(0, 5) + images(9, 20), "gaps in the images of /depth: 1"),
        (images(0, 1), "only 5 images of /depth"),
        (images(holes=48), "not one pixel of the images of /depth"),
        (images(holes=40), "83% of the pixels of /depth are holes"),
        (images() + images(23, 25), "10 of 110 images of /depth are more than 1 s away"),
        ([], "/depth has no image in this part"),
    ],
)
def test_trouble_is_a_warning(messages: list[Message], words: str) -> None:
    report = check_recording(Recorded([*others(), *messages]))
    assert exit_code(report) == 1
    assert any(words in what for what in warnings(report)), report.findings


@pytest.mark.parametrize(
    ("T_base_camera", "words"),
    [(np.eye(4), "/depth looks 90 deg up"), (np.diag([1.0, -1, -1, 1]), "looks 90 deg down")],
)
def test_a_camera_that_looks_at_the_ceiling(T_base_camera: Array, words: str) -> None:
    (what,) = warnings(check_recording(Recorded([*others(), *images()], T_base_camera)))
    assert words in what


def test_cameras_alone_are_something_to_see_unless_they_are_blind() -> None:
    poses = [message for message in others() if isinstance(message, Odometry)]
    report = check_recording(Recorded([*poses, *images()]))
    assert exit_code(report) == 1
    assert "there is no scan of a lidar" in warnings(report)
    assert exit_code(check_recording(Recorded([*poses, *images(holes=48)]))) == 2


def bag(folder: Path, *entries: Entry, z_m: float = 0.3, info: bool = True) -> CheckReport:
    optical = (-0.5, 0.5, -0.5, 0.5)
    frames = [
        ("base_footprint", "laser", (0, 0, 0.9), (0, 0, 0, 1)),
        ("base_footprint", "camera_depth_optical_frame", (0.2, 0, z_m), optical),
    ]
    entries = (*entries, tf_entry(T0_NS, *frames, topic="/tf_static"))
    if info:
        entries = (*entries, camera_info_entry(T0_NS))
    pixels = np.full((6, 8), 1500, dtype=np.uint16)
    for k in range(20):
        at_ns = T0_NS + k * S // 10
        entries = (
            *entries,
            scan_entry(at_ns, time_increment=1e-3),
            odometry_entry(at_ns, 0.1 * k, child="base_footprint"),
            image_entry(at_ns, pixels),
        )
    path = write_bag(folder, "mcap", sorted(entries, key=lambda entry: entry.bag_ns))
    return check_recording(BagRecording([path], ReadOptions()))


def test_what_the_reader_says_of_a_camera_is_told(tmp_path: Path) -> None:
    for name in ("good", "twin", "blind", "low"):
        (tmp_path / name).mkdir()
    assert exit_code(bag(tmp_path / "good")) == 0
    raw = image_entry(T0_NS, np.ones((6, 8), np.uint16), topic="/camera/depth/image_raw")
    assert exit_code(bag(tmp_path / "twin", raw)) == 0
    (what,) = warnings(bag(tmp_path / "blind", info=False))
    assert "left out: no CameraInfo" in what
    assert "--calibration" in what
    (what,) = warnings(bag(tmp_path / "low", z_m=-0.2))
    assert "underground by its mounting, at a height of -0.20 m" in what
