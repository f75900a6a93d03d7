"""Bags of every format hold the same recording, and what drivers do in them does no harm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from datasets.bags import BagRecording, read_trajectory
from datasets.errors import InputError
from datasets.messages import LaserScan, Message, Odometry
from datasets.options import ReadOptions
from datasets.se2 import xyyaw
from tests.datasets.bag_factory import (
    FORMATS,
    T0_NS,
    Entry,
    Format,
    S,
    odometry_entry,
    pose_entry,
    scan_entry,
    storage_file,
    string_entry,
    tf_entry,
    write_bag,
)

MS = 1_000_000
MOUNTING = tf_entry(
    T0_NS, ("base_link", "laser", (0.2, 0.0, 0.3), (0, 0, 0, 1)), topic="/tf_static"
)


def drive(turns: int = 20) -> list[Entry]:
    """Scans at 10 Hz, odometry at 20 Hz, and a topic whose definition nobody can read."""
    entries = [MOUNTING]
    for k in range(2 * turns):
        at_ns = T0_NS + k * 50 * MS
        entries.append(odometry_entry(at_ns, 0.1 * k, 0.01 * k, 0.02 * k, bag_ns=at_ns + 2 * MS))
        entries.append(Entry("/odd", "odd_msgs/msg/Odd", at_ns + 3 * MS, b"\x01\x02\x03"))
        if k % 2 == 0:
            ranges = [1.0 + 0.01 * k, 2.0, 0.0, 40.0, np.nan, 0.05, np.inf]
            scan = scan_entry(at_ns, ranges=ranges, time_increment=1e-3, bag_ns=at_ns + 60 * MS)
            entries.append(scan)
            entries.append(pose_entry(at_ns, 1.0 + 0.1 * k, 2.0, 0.02 * k))
    return sorted(entries, key=lambda entry: entry.bag_ns)


def read(path: Path | Sequence[Path], **options: object) -> tuple[BagRecording, list[Message]]:
    paths = [path] if isinstance(path, Path) else path
    recording = BagRecording(paths, ReadOptions(**options))  # type: ignore[arg-type]
    return recording, list(recording)


def scans(messages: Sequence[Message]) -> list[LaserScan]:
    return [message for message in messages if isinstance(message, LaserScan)]


def odometry(messages: Sequence[Message]) -> list[Odometry]:
    return [message for message in messages if isinstance(message, Odometry)]


def assert_same(one: Sequence[Message], other: Sequence[Message]) -> None:
    assert [type(m) for m in one] == [type(m) for m in other]
    assert [m.stamp_ns for m in one] == [m.stamp_ns for m in other]
    for a, b in zip(scans(one), scans(other), strict=True):
        assert a.lidar == b.lidar
        for name in ("ranges_m", "bearings_rad", "beam_offsets_s"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    for c, d in zip(odometry(one), odometry(other), strict=True):
        np.testing.assert_array_equal(c.T_odom_base, d.T_odom_base)


@pytest.mark.parametrize(
    ("kind", "compression", "bare"),
    [
        ("ros1", "", False),
        ("ros1", "bz2", False),
        ("ros1", "lz4", False),
        ("sqlite3", "", False),
        ("sqlite3", "", True),
        ("sqlite3", "file", False),
        ("sqlite3", "message", False),
        ("mcap", "", False),
        ("mcap", "", True),
        ("mcap", "storage", True),
    ],
)
@pytest.mark.parametrize("salvage", [False, True])
def test_every_format_gives_the_same_stream(
    tmp_path: Path, kind: Format, compression: str, bare: bool, salvage: bool
) -> None:
    path = write_bag(tmp_path, kind, drive(), compression=compression)
    (tmp_path / "reference").mkdir()
    reference, expected = read(write_bag(tmp_path / "reference", "ros1", drive()))
    recording, messages = read(storage_file(path) if bare else path, salvage=salvage)
    assert_same(messages, expected)
    assert recording.notes == reference.notes
    assert recording.layout.lidars.keys() == {"/scan"}
    assert recording.calibration.lidars["/scan"].T_base_lidar[:3, 3] == pytest.approx([0.2, 0, 0.3])
    truth, expected_truth = recording.ground_truth(), reference.ground_truth()
    assert truth is not None
    assert expected_truth is not None
    np.testing.assert_array_equal(truth.xyyaw, expected_truth.xyyaw)
    np.testing.assert_array_equal(truth.stamps_ns, expected_truth.stamps_ns)


def test_the_stream_is_what_was_written(tmp_path: Path) -> None:
    recording, messages = read(write_bag(tmp_path, "mcap", drive()))
    stamps = [message.stamp_ns for message in messages]
    assert stamps == sorted(stamps)  # the scans were recorded 60 ms late
    assert [m.stamp_ns for m in scans(messages)] == [T0_NS + k * 100 * MS for k in range(20)]
    for k, message in enumerate(odometry(messages)):
        assert xyyaw(message.T_odom_base) == pytest.approx((0.1 * k, 0.01 * k, 0.02 * k))
    first = scans(messages)[0]
    np.testing.assert_allclose(first.ranges_m, [1.0, 2.0, np.inf, np.inf, np.nan, -np.inf, np.inf])
    np.testing.assert_allclose(first.bearings_rad, -1.5 + 0.5 * np.arange(7))
    np.testing.assert_allclose(first.beam_offsets_s, 1e-3 * np.arange(7), rtol=1e-6)
    assert recording.name == "drive"
    assert_same(list(recording), messages)  # a second time from the beginning
    assert recording.notes["range of 0 taken as no return"] == 20


@pytest.mark.parametrize("kind", FORMATS)
def test_a_split_bag_is_one_recording_in_any_order_of_its_files(
    tmp_path: Path, kind: Format
) -> None:
    entries = drive()
    _, expected = read(write_bag(tmp_path, kind, entries))
    parts = [entries[:30], entries[30:61], entries[61:]]
    files = [
        storage_file(write_bag(tmp_path, kind, part, name=f"part_{k}"))
        for k, part in enumerate(parts)
    ]
    recording, messages = read([files[2], files[0], files[1]])
    assert_same(messages, expected)
    truth = recording.ground_truth()
    assert truth is not None
    assert len(truth) == 20


def test_a_folder_without_metadata_is_read_file_by_file(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "sqlite3", drive())
    _, expected = read(path)
    (path / "metadata.yaml").unlink()
    recording, messages = read(path)
    assert_same(messages, expected)
    assert any("no metadata.yaml" in note for note in recording.notes)


def test_start_and_duration_count_from_the_first_message(tmp_path: Path) -> None:
    _, messages = read(write_bag(tmp_path, "ros1", drive()), start_s=0.5, duration_s=1.0)
    stamps = [m.stamp_ns for m in scans(messages)]
    assert stamps == [T0_NS + k * 100 * MS for k in range(5, 16)]


def test_without_odometry_the_lidar_stands_where_it_stood(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", drive())
    recording, messages = read(path, use_odometry=False)
    assert not odometry(messages)
    assert len(scans(messages)) == 20
    with_odometry, _ = read(path)
    assert recording.layout.base_frame == with_odometry.layout.base_frame == "base_link"


def test_a_message_without_a_stamp_has_the_time_of_recording(tmp_path: Path) -> None:
    entries = [MOUNTING, *(scan_entry(0, bag_ns=T0_NS + k * S) for k in range(3))]
    recording, messages = read(write_bag(tmp_path, "mcap", entries))
    assert [m.stamp_ns for m in messages] == [T0_NS + k * S for k in range(3)]
    assert recording.notes["message without a stamp: the time of recording taken"] == 3


@pytest.mark.parametrize("kind", FORMATS)
def test_a_corrupt_message_costs_itself_only(tmp_path: Path, kind: Format) -> None:
    entries = drive()
    broken = [k for k, entry in enumerate(entries) if entry.topic == "/scan"][3:5]
    for k in broken:
        entries[k] = Entry("/scan", "sensor_msgs/msg/LaserScan", entries[k].bag_ns, b"\x00\x01\xff")
    recording, messages = read(write_bag(tmp_path, kind, entries))
    assert len(scans(messages)) == 18
    assert recording.notes["message of /scan left out: it can't be decoded"] == 2


def test_beam_times_come_from_the_time_increment_alone(tmp_path: Path) -> None:
    """scan_time without time_increment is a simulator's period, not a turning mirror."""
    entries = [scan_entry(T0_NS + k * S // 10, scan_time=0.1) for k in range(3)]
    _, messages = read(write_bag(tmp_path, "ros1", entries))
    assert all(m.beam_offsets_s.size == 0 for m in scans(messages))


def test_a_clockwise_scanner_and_counts_that_vary(tmp_path: Path) -> None:
    entries = [
        scan_entry(
            T0_NS + k * S // 10, ranges=[2.0] * (6 + k), angle_min=3.0, angle_increment=-0.25
        )
        for k in range(3)
    ]
    _, messages = read(write_bag(tmp_path, "ros1", entries))
    assert [m.ranges_m.size for m in scans(messages)] == [6, 7, 8]
    for message in scans(messages):
        np.testing.assert_allclose(
            message.bearings_rad, 3.0 - 0.25 * np.arange(message.ranges_m.size), atol=1e-6
        )


def test_repeated_stamps_and_broken_quaternions_are_left_out_and_counted(tmp_path: Path) -> None:
    entries = drive()
    entries += [
        odometry_entry(T0_NS + 50 * MS, 7.0, bag_ns=T0_NS + 53 * MS),
        odometry_entry(T0_NS + 75 * MS, float("nan"), bag_ns=T0_NS + 77 * MS),
    ]
    entries.sort(key=lambda entry: entry.bag_ns)
    recording, messages = read(write_bag(tmp_path, "mcap", entries))
    assert len(odometry(messages)) == 40
    assert recording.notes["odometry of /odom left out: stamp repeated"] == 1
    assert recording.notes["odometry of /odom left out: a transform must be finite"] == 1


def test_a_trajectory_is_read_by_its_topic_or_found_by_its_name(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", [*drive(), pose_entry(T0_NS, 9.0, 9.0, 0.0, topic="/goal")])
    truth = read_trajectory(path, None)
    assert truth.xyyaw[:, 0] == pytest.approx(1.0 + 0.2 * np.arange(20))
    assert truth.xyyaw[:, 2] == pytest.approx(0.04 * np.arange(20))
    assert len(read_trajectory(path, "goal")) == 1
    assert len(read_trajectory(path, "/odom")) == 40
    with pytest.raises(InputError, match=r"no such topic.*/goal, /ground_truth, /odom"):
        read_trajectory(path, "/nowhere")
    with pytest.raises(InputError, match="type sensor_msgs/msg/LaserScan"):
        read_trajectory(path, "/scan")


def test_no_ground_truth_is_none_and_an_error_where_it_was_asked_for(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", [MOUNTING, scan_entry(T0_NS), string_entry(T0_NS)])
    recording, _ = read(path)
    assert recording.ground_truth() is None
    with pytest.raises(InputError, match="no topic is called ground truth"):
        read_trajectory(path, None)
