"""The benchmark of maps as a whole: scans that are left, and which figures count."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from datasets.messages import LaserScan, Odometry
from datasets.open_recording import open_recording
from datasets.options import ReadOptions
from datasets.trajectory import Trajectory
from datasets.tum import write_tum
from slam.lab.bench import whole_maps
from slam.lab.bench.measure import Usage, Usages
from slam.lab.bench.session import MappedRecording, Session
from slam.lab.bench.subsampled import write_every_kth_scan

S = 1_000_000_000
SCANS = 200


def flaser(stamp_s: int) -> str:
    return f"FLASER 3 1.5 {1 + stamp_s}.5 2.5 0 0 0 0 0 0 {stamp_s}.25 host {stamp_s}.25\n"


def odom(stamp_s: int) -> str:
    return f"ODOM {stamp_s}.0 0 0 0 0 0 {stamp_s}.125 host {stamp_s}.125\n"


def write_log(path: Path, scans: int = SCANS) -> list[str]:
    lines = ["# a comment\n", "PARAM robot_frontlaser_offset 0.1\n"]
    lines += [line for k in range(scans) for line in (odom(1000 + k), flaser(1000 + k))]
    with gzip.open(path, "wt") as file:
        file.writelines(lines)
    return lines


@pytest.mark.parametrize(
    ("every", "offset", "left"), [(5, 0, 3), (5, 2, 2), (10, 4, 1), (1, 0, 12)]
)
def test_every_kth_scan_is_left_and_all_else(
    tmp_path: Path, every: int, offset: int, left: int
) -> None:
    lines = write_log(tmp_path / "whole.log.gz", 12)
    target = tmp_path / "left.log.gz"
    stamps_ns = write_every_kth_scan(tmp_path / "whole.log.gz", target, every, offset)
    with gzip.open(target, "rt") as file:
        found = file.readlines()
    kept = [flaser(1000 + k) for k in range(offset, 12, every)]
    assert len(kept) == left
    assert found == [line for line in lines if not line.startswith("FLASER") or line in kept]
    expected = [1000 * S + k * S + S // 4 for k in range(offset, 12, every)]
    assert stamps_ns.tolist() == expected


def test_the_stamps_are_those_the_reader_gives(shared_data: Path, tmp_path: Path) -> None:
    whole = shared_data / "recordings" / "fr079.log.gz"
    target = tmp_path / "left.log.gz"
    stamps_ns = write_every_kth_scan(whole, target, 10, 4)
    messages = list(open_recording([target], ReadOptions()))
    scans = [m.stamp_ns for m in messages if isinstance(m, LaserScan)]
    assert scans == stamps_ns.tolist()
    assert len(scans) == 479
    odometry = sum(isinstance(m, Odometry) for m in messages)
    before = list(open_recording([whole], ReadOptions()))
    assert odometry == sum(isinstance(m, Odometry) for m in before)


class Mapped(Session):
    """A session whose runs are two laps of 60 m, the second one displaced by a known length.

    It grows with the number of the run: 0.1 m, 0.2 m, ...
    """

    def map_recording(
        self, path: Path, *options: str, runs: int = 1, warm_up: bool = False
    ) -> MappedRecording:
        scans = [m.stamp_ns for m in open_recording([path], ReadOptions())]
        number = sum(folder.name.startswith("run") for folder in self.scratch.iterdir())
        folder = self.scratch / f"run-{number}"
        folder.mkdir()
        stamps_ns = np.array(sorted({stamp for stamp in scans if stamp % S == S // 4}))
        rows = circles().at(stamps_ns)
        second = stamps_ns > (1000 + SCANS // 2) * S
        rows[second, 0] += 0.1 * (number + 1)
        write_tum(folder / "trajectory.tum", Trajectory(stamps_ns, rows))
        usages = Usages.of([Usage(2.5 + number, 3.0, 100.0 + number, "")] * runs)
        return MappedRecording(folder, usages)


def circles() -> Trajectory:
    """Two laps of a circle of 60 m in 200 scans."""
    k = np.arange(SCANS)
    angle = 4.0 * np.pi * k / SCANS
    radius_m = 60.0 / (2.0 * np.pi)
    rows = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), angle])
    return Trajectory(1000 * S + S // 4 + S * k, rows)


@pytest.fixture
def session(tmp_path: Path) -> Session:
    recordings, scratch = tmp_path / "recordings", tmp_path / "scratch"
    for folder in (recordings, scratch):
        folder.mkdir()
    for name in ("fr079", "aces"):
        write_log(recordings / f"{name}.log.gz")
        write_tum(recordings / f"{name}.reference.tum", circles())
    return Mapped(recordings, scratch, 2)


def test_a_log_is_judged_by_its_bars(session: Session) -> None:
    part = next(part for part in whole_maps.PARTS if part.name == "whole-aces")
    measured = part.measure(session)
    off, p95, ate, cpu, peak = measured.values
    assert len(part.bars) == len(measured.values)
    assert off.value == 0.0
    assert p95.value == pytest.approx(0.1)
    assert ate.value == pytest.approx(0.05, rel=0.05)
    assert (cpu.value, peak.value) == (2.5, 100.0)
    assert part.bars[0].verdict(off) == "must reached"
    assert part.bars[1].verdict(p95) == "must reached, aim not"
    assert measured.brief == "0.0 % / 0.10 m / 2.5 s"
    row = measured.details.splitlines()[-1]
    assert row.startswith("| `aces` | ")
    assert " | 0.100 | " in row


def test_of_several_offsets_the_worst_counts(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first three runs are 0.1, 0.2 and 0.3 m off, the last three 1.0, 1.1 and 1.2 m."""
    part = next(part for part in whole_maps.PARTS if part.name == "whole-every-5")
    measured = part.measure(session)
    assert [value.value for value in measured.values] == pytest.approx([0.0, 0.3])
    assert "scans 4, 9, ..." in measured.values[1].how
    assert len(measured.details.splitlines()) == 5
    for _ in range(3):
        last = part.measure(session)
    off, p95 = last.values
    assert off.value > 50.0
    assert p95.value == pytest.approx(1.2)
    assert part.bars[0].verdict(off) == part.bars[1].verdict(p95) == "MISSED"
    assert ", 0 of them missing; `fr079`, scans" in off.how
