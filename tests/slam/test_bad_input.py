"""Recordings and wishes that no run can come from, and those that only cost what is bad."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slam.runs.run_folder import read_run
from tests.datasets.bag_factory import T0_NS, odometry_entry, scan_entry, string_entry, write_bag
from tests.slam.conftest import Command
from tests.slam.ring_log import DemoFiles, measure


def carmen(stamp_s: float, ranges: str, count: int = 181, pose: str = "0 0 0") -> str:
    """One FLASER line; ``ranges`` is repeated for each beam."""
    beams = " ".join([ranges] * count)
    return f"FLASER {count} {beams} {pose} {pose} {stamp_s:.6f} host {stamp_s:.6f}\n"


def text(content: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / "bad.log"
        path.write_text(content)
        return path

    return make


def raw(name: str, content: bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(content)
        return path

    return make


def missing(folder: Path) -> Path:
    return folder / "nowhere.log"


def a_folder(folder: Path) -> Path:
    (folder / "notes").mkdir()
    return folder / "notes"


def bag(*entries: object) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        return write_bag(folder, "ros1", entries)

    return make


def cut_gzip(folder: Path) -> Path:
    path = folder / "cut.log.gz"
    path.write_bytes(gzip.compress(carmen(1.0, "2.5").encode() * 400)[:9])
    return path


NOTHING = {
    "missing": (missing, "no such file"),
    "empty file": (raw("empty.log", b""), "empty"),
    "empty bag": (raw("empty.bag", b""), "empty"),
    "a letter": (text("Dear Sir or Madam,\nno robot drove here.\n"), "CARMEN"),
    "a picture": (raw("map.png", b"\x89PNG\r\n\x1a\n" + bytes(500)), "PNG"),
    "noise": (raw("noise.log", bytes(range(256)) * 8), "binary"),
    "cut gzip header": (cut_gzip, "cut.log.gz"),
    "a folder of something else": (a_folder, "folder"),
    "only odometry": (text("ODOM 0 0 0 0 0 0 1.0 host 1.0\n" * 3), "no scan"),
    "only NaN": (text("".join(carmen(t, "nan") for t in range(1, 9))), "beam"),
    "no return at all": (text("".join(carmen(t, "81.83") for t in range(1, 9))), "beam"),
    "every scan cut short": (text("FLASER 181 1.0 2.0 3.0\n" * 9), "no scan"),
    "no lidar in the bag": (bag(string_entry(T0_NS, "hello")), "LaserScan"),
    "a bag cut in its header": (raw("cut.bag", b"#ROSBAG V2.0\nE\0\0\0"), "cut.bag"),
    "stamps of the year 2286": (
        text("".join(carmen(9999999990 + t, "2.5") for t in range(1, 9))),
        "stamp is no time: 8",
    ),
    "poses that are no numbers": (
        text("".join(carmen(t, "2.5", pose="nan 0 0") for t in range(1, 9))),
        "pose is not finite: 8",
    ),
}


@pytest.mark.parametrize("name", NOTHING)
def test_no_run_comes_from(name: str, slam: Command, tmp_path: Path) -> None:
    make, said = NOTHING[name]
    recording = make(tmp_path)
    before = sorted(tmp_path.iterdir())
    done = slam("run", recording, "-o", tmp_path / "out")
    assert done.code == 2
    message = done.err.strip().splitlines()[-1]
    assert message.startswith("error: ")
    assert str(recording) in message, "it names the file"
    assert said in message
    assert len(message.split(". ")) >= 2, "it says what to do"
    assert "Traceback" not in done.err
    assert done.out == ""
    assert sorted(tmp_path.iterdir()) == before, "no folder, nothing left over"


def test_what_is_bad_costs_itself_only(slam: Command, tmp_path: Path) -> None:
    """Among 40 good scans: another count, NaN ranges, a stamp a day ahead, half a line, odometry
    that is a kilometre off."""
    poses = np.array([(8.0 + 0.05 * k, 1.1, 0.0) for k in range(40)])
    lines = []
    for k, row in enumerate(measure(poses, np.random.default_rng(4))):
        beams = [f"{r:.3f}" if r < 15.9 else "81.83" for r in row[90 : 135 if k == 30 else 270]]
        beams = ["nan"] * 180 if k == 20 else beams
        pose = f"{poses[k, 0] + (1000.0 if k == 35 else 0.0):.3f} 0 0"
        stamp_s = 100.0 + 0.2 * k + (86_400 if k == 25 else 0)
        end = f"{pose} {pose} {stamp_s:.6f} host {stamp_s:.6f}\n"
        lines.append(f"FLASER {len(beams)} {' '.join(beams)} {end}")
    lines[10] = lines[10][:200] + "\n"
    log = tmp_path / "bumpy.log"
    log.write_text("".join(lines))
    done = slam("run", log, "-o", tmp_path / "out", "--quiet")
    assert done.code == 0, done.err
    run = read_run(tmp_path / "out")
    assert run.metrics["scans"] == 38  # a scan without ranges keeps its place on the way
    notes = run.metrics["reader_notes"]
    assert notes["scan left out: wrong number of ranges"] == 1
    assert sum(count for note, count in notes.items() if "jumps ahead" in note) == 2
    (not_believed,) = (n for why, n in run.metrics["left_out"].items() if "not believed" in why)
    assert not_believed == 2  # there and back
    assert len(run.trajectory) == 38
    assert 1.7 < run.metrics["way_m"] < 2.1


def test_a_file_that_ends_early_is_mapped_so_far(
    slam: Command, demo: DemoFiles, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.log.gz"
    cut.write_bytes(demo.recording.read_bytes()[: demo.recording.stat().st_size // 6])
    done = slam("run", cut, "-o", tmp_path / "out")
    assert done.code == 0
    run = read_run(tmp_path / "out")
    assert 60 < run.metrics["scans"] < 200
    assert not run.partial, "nobody interrupted it"
    assert any("damaged" in note for note in run.metrics["reader_notes"]), done.out
    assert "damaged" in done.out


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["--set", "map.resolutoin_m=0.1"], "map.resolutoin_m: no such key"),
        (["--set", "map.resolution_m=wide"], "map.resolution_m"),
        (["--set", "map.resolution_m=-1"], "map.resolution_m"),
        (["--set", "map.resolution_m=[1"], "not a value"),
        (["--set", "map.resolution_m=2020-99-99"], "map.resolution_m"),
        (["--set", "map"], "section.key=value"),
        (["--set", "map=3"], "map"),
        (["--set", "map.resolution_m.deep=3"], "map"),
        (["--config", "nowhere.yaml"], "nowhere.yaml"),
        (["--calibration", "nowhere.yaml"], "nowhere.yaml"),
        (["--lidar", "rear"], "rear"),
        (["--odometry", "/odom"], "odom"),
        (["--start", "5000"], "--start"),
        (["--start", "-1"], "--start"),
        (["--start", "inf"], "--start"),
        (["--duration", "soon"], "--duration"),
        (["--duration", "inf"], "--duration"),
        (["--frontend", "magic"], "--frontend"),
        (["--fast"], "--fast"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_impossible_wishes(
    settings: list[str], said: str, slam: Command, demo: DemoFiles, tmp_path: Path
) -> None:
    done = slam("run", demo.recording, "-o", tmp_path / "out", *settings)
    assert done.code == 2
    assert said in done.err
    assert "Traceback" not in done.err
    assert list(tmp_path.iterdir()) == []


def test_masks_that_leave_no_beam_are_named(slam: Command, demo: DemoFiles, tmp_path: Path) -> None:
    calibration = tmp_path / "robot.yaml"
    calibration.write_text("lidars: {front: {mask_deg: [[-180, 0], [0, 180]]}}")
    done = slam("run", demo.recording, "-o", tmp_path / "out", "--calibration", calibration)
    assert done.code == 2
    assert f"Try without the masks of {calibration}" in done.err


def test_targets_are_refused_before_the_work(
    slam: Command, demo: DemoFiles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def must_not_open(*_: object) -> None:
        raise AssertionError("the recording was opened")

    monkeypatch.setattr("slam.runs.run.open_recording", must_not_open)
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "thesis.tex").write_text("years of work")
    for extra in ((), ("--force",)):
        done = slam("run", demo.recording, "-o", taken, *extra)
        assert done.code == 2
        assert str(taken) in done.err
    assert (taken / "thesis.tex").read_text() == "years of work"
    done = slam("run", demo.recording, "-o", tmp_path / "taken" / "thesis.tex" / "out")
    assert done.code == 2
    assert "error: " in done.err


def test_a_recording_of_two_kinds_is_refused(
    slam: Command, demo: DemoFiles, tmp_path: Path
) -> None:
    other = write_bag(tmp_path, "ros1", [scan_entry(T0_NS), odometry_entry(T0_NS, 0.0)])
    done = slam("run", demo.recording, other, "-o", tmp_path / "out")
    assert done.code == 2
    assert "one kind" in done.err


@pytest.mark.parametrize("command", ["check", "export", "evaluate"])
def test_other_commands_name_what_is_missing(command: str, slam: Command, tmp_path: Path) -> None:
    done = slam(command, tmp_path / "nowhere")
    assert done.code == 2
    assert str(tmp_path / "nowhere") in done.err
    assert "Traceback" not in done.err
