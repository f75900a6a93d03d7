"""What kind of recording a path is, and what is said if it is none."""

from __future__ import annotations

import gzip
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from datasets.bags import BagRecording
from datasets.carmen import CarmenRecording
from datasets.errors import InputError
from datasets.open_recording import open_recording
from datasets.options import ReadOptions

FLASER = b"FLASER 2 1.5 2.5 0 0 0 0 0 0 1.0 host 1.0\n"

in_gzip = partial(gzip.compress, mtime=0)
"""Without the time of day: tests are named for what they are given."""


def opening(*paths: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        open_recording(paths, ReadOptions())
    assert caught.value.remedy
    return caught.value


@pytest.mark.parametrize("name", ["a.log", "a.clf", "a.txt", "noending"])
@pytest.mark.parametrize("packed", [False, True])
def test_a_carmen_log_is_known_by_its_content(tmp_path: Path, name: str, packed: bool) -> None:
    path = tmp_path / name
    path.write_bytes(in_gzip(FLASER) if packed else FLASER)
    recording = open_recording([path], ReadOptions())
    assert isinstance(recording, CarmenRecording)
    assert len(list(recording)) == 2


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "empty"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "a PNG picture"),
        (np.random.default_rng(1).bytes(100_000), "binary file"),
        (b"hello\nworld\n", "no line of a CARMEN log"),
        (b"\n\n", "no line of a CARMEN log"),
        (b"PK\x03\x04" + bytes(50), "packed with zip"),
        (in_gzip(b"#ROSBAG V2.0\n" + bytes(50)), "a bag that is packed with gzip"),
        (in_gzip(bytes(1000)), "binary file"),
        (b"\x1f\x8b\x08" + b"damaged" * 9, "nothing of it can be unpacked"),
        (in_gzip(b""), "no line of a CARMEN log"),
    ],
)
def test_other_files_are_named_for_what_they_are(tmp_path: Path, content: bytes, what: str) -> None:
    path = tmp_path / "recording.log"
    path.write_bytes(content)
    error = opening(path)
    assert what in error.what
    assert str(path) in error.where


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
@pytest.mark.parametrize("content", [b"", b"#ROSBAG V2.0\n", b"hello"])
def test_damaged_bags_get_a_message(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    assert str(path) in opening(path).where


def test_paths_that_lead_nowhere(tmp_path: Path) -> None:
    assert "no recording" in opening().what
    assert "no such file" in opening(tmp_path / "missing.bag").what
    assert "neither" in opening(Path("/dev/null")).what
    assert "folder is no ROS 2 bag" in opening(tmp_path).what
    (tmp_path / "run.log").write_bytes(FLASER)
    assert "run.log" in opening(tmp_path).remedy


def test_parts_must_be_of_one_kind(tmp_path: Path) -> None:
    log, bag = tmp_path / "a.log", tmp_path / "a.bag"
    log.write_bytes(FLASER)
    bag.write_bytes(b"#ROSBAG V2.0\n")
    assert "one recording" in opening(log, bag).what


def test_real_recordings_open(shared_data: Path) -> None:
    folder = shared_data / "recordings"
    assert isinstance(open_recording([folder / "intel.log.gz"], ReadOptions()), CarmenRecording)
    bag = open_recording([folder / "jarvis_2_static.bag"], ReadOptions())
    assert isinstance(bag, BagRecording)
    assert "no line of a CARMEN log" in opening(folder / "intel.relations").what
