"""``slam simulate``: bags that this project reads, and mistakes that cost nothing but a message."""

from __future__ import annotations

import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from datasets.bags import BagRecording
from datasets.messages import LaserScan, Odometry
from datasets.options import ReadOptions
from datasets.simulation.depth_camera import MODES
from datasets.simulation.robot import ROBOTS
from slam.commands.simulate import simulate
from tests.slam.conftest import Command

PLACE = """\
floor: marble
walls:
  - name: room
    ring: [[-2, -2], [3, -2], [3, 2], [-2, 2], [-2, -2]]
    height_m: 2.5
boxes:
  - {name: crate, at_m: [2, 1], size_m: [0.6, 0.4, 0.3]}
drives:
  there: {way_points_m: [[0, 0], [0.5, 0]]}
  round: {way_points_m: [[0, 0], [0.5, 0], [0.5, 0.5]], closed: true, robot: gyro}
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    path = tmp_path / "place.yaml"
    path.write_text(PLACE)
    return path


def bag_of(path: Path) -> BagRecording:
    return BagRecording([path], ReadOptions())


def test_a_bag_is_written_told_of_and_read(slam: Command, place: Path, tmp_path: Path) -> None:
    out = tmp_path / "a drive.mcap"
    done = slam("simulate", place, "-o", out, "--depth-rate", 2)
    assert done.code == 0
    size, seconds = re.findall(r"about ([\d.]+) MB, written in about (\d+) s", done.err)[0]
    assert "place, drive there, robot paper, seed 1: 2 s, 0 m" in done.err
    assert float(size) == pytest.approx(out.stat().st_size / 1e6, rel=0.3)
    assert int(seconds) >= 1
    lines = done.out.splitlines()
    assert lines[0].startswith(f"{out}: ")
    assert any(line.split()[:2] == ["/scan", "15"] for line in lines)
    assert lines[-2:] == [
        f"  slam run '{out}' -o run",
        f"  slam evaluate run --ground-truth '{out}'",
    ]
    recording = bag_of(out)
    assert recording.ground_truth() is not None
    assert sum(isinstance(message, LaserScan) for message in recording) == 15
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a drive.mcap", "place.yaml"]

    again = slam("simulate", place, "-o", out)
    assert again.code == 2
    assert "exists already" in again.err
    quiet = slam("simulate", place, "-o", out, "--force", "--quiet", "--no-depth", "--seed", 5)
    assert quiet == (0, f"{out}\n", "")


def test_wishes_are_heard(slam: Command, place: Path, tmp_path: Path) -> None:
    short = "--no-depth", "--quiet"
    for name, words in {
        "plain.bag": ("--drive", "round"),
        "laps.bag": ("--drive", "round", "--laps", 2),
        "paper.bag": ("--drive", "round", "--robot", "paper"),
        "slip.bag": ("--drive", "round", "--robot", "paper", "--slip"),
        "blind.bag": ("--no-odometry",),
        "two.bag": ("--robot", "two-lidars"),
    }.items():
        assert slam("simulate", place, "-o", tmp_path / name, *short, *words).code == 0
    read = {path.name: list(bag_of(path)) for path in sorted(tmp_path.glob("*.bag"))}
    counts = {name: len(messages) for name, messages in read.items()}
    assert counts["laps.bag"] > 1.5 * counts["plain.bag"]
    assert {m.lidar for m in read["two.bag"] if isinstance(m, LaserScan)} == {"/scan", "/scan_low"}
    ends = {
        name: next(m.T_odom_base for m in reversed(messages) if isinstance(m, Odometry)).tolist()
        for name, messages in read.items()
        if name != "blind.bag"
    }
    assert not any(isinstance(message, Odometry) for message in read["blind.bag"])
    assert ends["plain.bag"] != ends["paper.bag"], "the drive asks for a gyro"
    assert ends["slip.bag"] != ends["paper.bag"]


def test_a_drive_may_come_from_a_file(slam: Command, place: Path, tmp_path: Path) -> None:
    drive = tmp_path / "mine.yaml"
    drive.write_text("way_points_m: [[0, 0], [0, 0.6]]\nstand_s: 1\n")
    done = slam("simulate", place, "--drive", drive, "-o", tmp_path / "d.bag", "--no-depth")
    assert done.code == 0
    drive.write_text("way_points_m: [[0, 0], [9, 0]]\n")
    done = slam("simulate", place, "--drive", drive, "-o", tmp_path / "e.bag")
    assert done.code == 2
    assert f"{drive}, line 1, key way_points_m.1: the point (9, 0) lies outside" in done.err


def changed(before: str, after: str) -> str:
    assert PLACE.count(before) == 1
    return PLACE.replace(before, after)


@pytest.mark.parametrize(
    ("text", "words", "said"),
    [
        (changed("boxes:", "boxs:"), (), r"line 6, key boxs: no such key.*Known here"),
        (changed("[-2, 2], [-2, -2]]", "[-2, 2], [-2, -1]]"), (), r"line 4, key .*ring.* open"),
        (
            changed(", size_m: [0.6, 0.4, 0.3]", ""),
            (),
            r"line 7, key .*size_m: this key is missing",
        ),
        (changed("[[0, 0], [0.5, 0]]}", "[[0, 0], [2, 1]]}"), (), r"line 9, key .*way_points_m\.1"),
        (changed("[[0, 0], [0.5, 0]]}", "[[0, 0], [3.1, 0]]}"), (), r"line 9, key .*way_points_m"),
        (changed("robot: gyro", "robot: giro"), (), r"line 10, key drives\.round\.robot.*'gyro'"),
        (PLACE, ("--drive", "back"), "no such drive: back. Its drives are: there, round"),
        (PLACE, ("--robot", "r2d2"), "no such robot: r2d2. There are: paper"),
        (PLACE, ("--depth", "4k"), "no such mode: 4k. There are: 1280x720"),
        (PLACE, ("--robot", "two-lidars", "--depth", "640x480"), "has no depth camera"),
        (PLACE, ("--laps", 3), "3 laps of a drive that is not closed.*close it"),
        (PLACE, ("--laps", 0), "--laps"),
        (PLACE, ("--seed", -1), "--seed"),
        (PLACE.partition("drives:")[0], (), "no drive leads through this place"),
        (changed("[[0, 0], [0.5, 0]]}", "[[0, 0]]}"), (), "over after 0.0 s.*stand_s"),
    ],
)
def test_what_no_bag_can_come_from_is_told_and_leaves_none(
    slam: Command, tmp_path: Path, text: str, words: tuple[object, ...], said: str
) -> None:
    place = tmp_path / "place.yaml"
    place.write_text(text)
    done = slam("simulate", place, "-o", tmp_path / "out.mcap", *words)
    assert done.code == 2
    assert re.search(said, re.sub(r"\x1b\[[\d;]*m", "", done.err)), done.err
    assert list(tmp_path.iterdir()) == [place]


def test_places_and_paths_that_are_not_there(slam: Command, tmp_path: Path) -> None:
    assert "room, ring-corridor" in slam("simulate", "rom", "-o", tmp_path / "o.mcap").err
    nowhere = slam("simulate", "room", "-o", tmp_path / "no" / "o.mcap")
    assert nowhere.code == 2
    assert "no such folder" in nowhere.err
    ending = slam("simulate", "room", "-o", tmp_path / "o.zip")
    assert ending.code == 2
    assert ".mcap (ROS 2), .bag (ROS 1)" in ending.err
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk(
    slam: Command, place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "drive.mcap"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        done = slam("simulate", place, "-o", out, "--no-depth")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert done.code == 2
    assert re.search(r"drive\.mcap: the bag can't be written .*Make room", done.err)
    assert list(tmp_path.iterdir()) == [place]

    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr("datasets.simulation.bag_writer.shutil.disk_usage", lambda path: usage)
    done = slam("simulate", place, "-o", out, "--no-depth")
    assert done.code == 2
    assert "the bag needs about" in done.err
    assert list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_broken_off_there_is_nothing(tmp_path: Path, number: int, code: int) -> None:
    words = ("simulate", "ring-corridor", "-o", str(tmp_path / "d.mcap"), "--no-depth")
    program = "import sys; from slam.cli import main; sys.exit(main())"
    process = subprocess.Popen([sys.executable, "-c", program, *words], stderr=subprocess.PIPE)
    try:
        deadline = time.monotonic() + 60.0
        while not list(tmp_path.glob(".*/*/*.mcap")) and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == code
    assert b"nothing was written" in err
    assert list(tmp_path.iterdir()) == []


def test_the_help_names_all_robots_and_modes(slam: Command) -> None:
    words = (
        slam("simulate", "--help").out.replace("│", " ").replace(",", " ").replace(";", " ").split()
    )
    assert simulate.__name__ in words
    assert {*ROBOTS, *MODES} <= set(words)
