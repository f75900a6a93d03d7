"""Bags whose recorder was killed, copies that broke off, and bytes that changed."""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datasets.bag_records import RawMessage
from datasets.bag_source import BagSource
from datasets.bags import BagRecording
from datasets.errors import InputError
from datasets.options import ReadOptions
from tests.datasets.bag_factory import (
    T0_NS,
    Entry,
    Format,
    S,
    odometry_entry,
    scan_entry,
    storage_file,
    string_entry,
    tf_entry,
    write_bag,
)

KINDS: list[tuple[Format, str]] = [
    ("ros1", ""),
    ("ros1", "bz2"),
    ("ros1", "lz4"),
    ("mcap", ""),
    ("mcap", "storage"),
    ("sqlite3", ""),
]


def drive(scans: int = 60, beams: int = 300) -> list[Entry]:
    mounting = ("base_link", "laser", (0.2, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))
    entries = [tf_entry(T0_NS, mounting, topic="/tf_static")]
    rng = np.random.default_rng(7)
    for k in range(scans):
        at_ns = T0_NS + k * S // 10
        ranges = list(rng.uniform(1.0, 9.0, beams))
        entries.append(scan_entry(at_ns, ranges=ranges, angle_increment=0.01))
        entries.append(odometry_entry(at_ns + 1, 0.1 * k))
        entries.append(string_entry(at_ns + 2, f"{k}"))
    return entries


@pytest.fixture(scope="module", params=KINDS, ids="-".join)
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good bag of each kind, one file."""
    kind, compression = request.param
    folder = tmp_path_factory.mktemp("whole")
    # rosbags' MCAP chunks are of 1 MB; zstd has blocks of 128 kB, which come whole or not at all.
    entries = drive(beams=2000 if compression == "storage" else 300)
    return storage_file(
        write_bag(folder, kind, entries, compression=compression, chunk_bytes=20_000)
    )


def raw_messages(path: Path, notes: Counter[str] | None = None) -> list[RawMessage]:
    notes = Counter() if notes is None else notes
    with BagSource((path,), salvage=True, notes=notes) as source:
        return list(source.messages(source.topics))


def is_subsequence(some: list[int], of: list[int]) -> bool:
    rest = iter(of)
    return all(value in rest for value in some)


def record(path: Path, *, salvage: bool) -> BagRecording:
    return BagRecording([path], ReadOptions(salvage=salvage))


def copy_of(whole: Path, folder: Path, content: bytes) -> Path:
    path = folder / f"copy{whole.suffix}"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("share", [0.35, 0.7, 0.95])
def test_a_truncated_bag_is_named_as_such_and_salvaged(
    whole: Path, tmp_path: Path, share: float
) -> None:
    content = whole.read_bytes()
    path = copy_of(whole, tmp_path, content[: int(share * len(content))])
    with pytest.raises(InputError) as caught:
        record(path, salvage=False)
    assert "truncated" in str(caught.value)
    assert "--salvage" in str(caught.value)
    assert str(path) in str(caught.value)
    recording = record(path, salvage=True)
    salvaged = [m.stamp_ns for m in recording]
    expected = [m.stamp_ns for m in record(whole, salvage=False)]
    assert is_subsequence(salvaged, expected)
    told = [note for note in recording.notes if "ends early" in note or "damaged" in note]
    assert any(path.name in note for note in told) or len(salvaged) == len(expected)
    # The end of the file is index, and a chunk or a page that is cut may be lost whole.
    assert len(salvaged) >= (0.9 * share - 0.15) * len(expected)


def test_salvaging_a_whole_bag_tells_of_no_loss(whole: Path) -> None:
    notes: Counter[str] = Counter()
    assert len(raw_messages(whole, notes)) == 181
    assert not notes


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0))
def test_wherever_a_bag_breaks_off_what_came_before_is_read(
    whole: Path, tmp_path: Path, share: float
) -> None:
    content = whole.read_bytes()
    path = copy_of(whole, tmp_path, content[: int(share * len(content))])
    expected = raw_messages(whole)
    assert len(expected) == 181
    with suppress(InputError):  # nothing is left but a few bytes
        salvaged = raw_messages(path, notes := Counter())
        assert len(salvaged) == len(expected) or notes
        if whole.suffix == ".db3":
            # Pages aren't in the order of rows, and SQLite fills the one that is cut with zeros.
            good = [message for message in salvaged if message in expected]
            assert is_subsequence([m.bag_ns for m in good], [m.bag_ns for m in expected])
            assert len(salvaged) - len(good) <= 1
        else:
            assert salvaged == expected[: len(salvaged)]


@settings(max_examples=60, deadline=None, suppress_health_check=[*HealthCheck])
@given(
    share=st.floats(0.0, 1.0, exclude_max=True),
    patch=st.binary(min_size=1, max_size=12),
    salvage=st.booleans(),
)
def test_changed_bytes_cost_messages_or_give_an_input_error(
    whole: Path, tmp_path: Path, share: float, patch: bytes, salvage: bool
) -> None:
    content = bytearray(whole.read_bytes())
    at = int(share * len(content))
    content[at : at + len(patch)] = patch
    path = copy_of(whole, tmp_path, bytes(content[: whole.stat().st_size]))
    with suppress(InputError):
        recording = record(path, salvage=salvage)
        stamps = [message.stamp_ns for message in recording]
        assert stamps == sorted(stamps)


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
def test_a_ros1_bag_that_was_never_indexed(tmp_path: Path, compression: str) -> None:
    """As a killed `rosbag record` leaves it, .active: index_pos 0, no connections at the end."""
    whole = write_bag(tmp_path, "ros1", drive(), compression=compression, chunk_bytes=20_000)
    content = bytearray(whole.read_bytes())
    field = content.index(b"index_pos=") + len(b"index_pos=")
    (index_pos,) = struct.unpack_from("<Q", content, field)
    content[field : field + 8] = bytes(8)
    path = tmp_path / "killed.bag.active"
    path.write_bytes(content[:index_pos])
    with pytest.raises(InputError, match=r"not indexed.*--salvage"):
        record(path, salvage=False)
    salvaged = record(path, salvage=True)
    expected = list(record(whole, salvage=False))
    assert [m.stamp_ns for m in salvaged] == [m.stamp_ns for m in expected]


def test_a_damaged_chunk_ends_an_indexed_bag_and_not_a_salvaged_one(tmp_path: Path) -> None:
    whole = write_bag(tmp_path, "ros1", drive(), compression="bz2", chunk_bytes=20_000)
    content = bytearray(whole.read_bytes())
    middle = content.index(b"BZh9", len(content) // 2) + 200
    content[middle : middle + 50] = bytes(50)
    path = copy_of(whole, tmp_path, bytes(content))
    plain, salvaged = record(path, salvage=False), record(path, salvage=True)
    few, more = list(plain), list(salvaged)
    assert 0 < len(few) < len(more) < len(list(record(whole, salvage=False)))
    assert any("ends early" in note and "--salvage" in note for note in plain.notes)
    assert salvaged.notes["chunk left out: its compressed data is damaged"] == 1


def test_a_database_killed_with_its_write_ahead_log(tmp_path: Path) -> None:
    """What is in the log only is read too: rosbags alone would not see it."""
    path = storage_file(write_bag(tmp_path, "sqlite3", drive()))
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA journal_mode=WAL")
    last = connection.execute("SELECT topic_id, timestamp, data FROM messages").fetchall()[-3:]
    later = [(topic, at_ns + S, data) for topic, at_ns, data in last]
    with connection:
        connection.executemany(
            "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", later
        )
    copy = tmp_path / "killed.db3"
    copy.write_bytes(path.read_bytes())
    copy.with_name("killed.db3-wal").write_bytes(path.with_name(path.name + "-wal").read_bytes())
    connection.close()
    assert len(raw_messages(copy)) == 181 + 3


def test_a_folder_with_one_broken_file_keeps_the_others(tmp_path: Path) -> None:
    entries = drive()
    folder = write_bag(tmp_path, "mcap", entries[:100])
    first = storage_file(folder)
    second = storage_file(write_bag(tmp_path, "mcap", entries[100:], name="second"))
    (folder / "metadata.yaml").unlink()
    second = second.rename(folder / "drive_1.mcap")
    first.write_bytes(first.read_bytes()[:-50])
    with pytest.raises(InputError, match=r"drive\.mcap.*--salvage"):
        record(folder, salvage=False)
    salvaged = record(folder, salvage=True)
    assert len(list(salvaged)) == 120


@pytest.mark.parametrize("salvage", [False, True])
@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("empty.bag", b"", "empty"),
        ("note.mcap", b"dear diary", "not a bag"),
        ("old.bag", b"#ROSBAG V1.2\n" + bytes(100), "not a bag"),
        ("data.db3", b"SQLite format 3\x00" + bytes(5000), "truncated|no message"),
        ("short.mcap", b"\x89MCAP0\r\n", "truncated|no message"),
        ("short.bag", b"#ROSBAG V2.0\n", "truncated|no message"),
    ],
)
def test_what_is_no_bag_gets_an_input_error(
    tmp_path: Path, name: str, content: bytes, what: str, salvage: bool
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=what) as caught:
        record(path, salvage=salvage)
    assert str(path) in str(caught.value)


def test_missing_files_and_empty_folders_get_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        record(tmp_path / "nowhere.bag", salvage=False)
    with pytest.raises(InputError, match="not a ROS 2 bag"):
        record(tmp_path, salvage=False)
    with pytest.raises(InputError, match="at least one"):
        BagRecording([], ReadOptions())


def test_a_bag_without_messages_is_empty(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the bag is empty"):
        record(write_bag(tmp_path, "ros1", []), salvage=False)


def test_an_mcap_without_chunks_and_order_is_read_all_the_same(tmp_path: Path) -> None:
    """As a logger writes it that flushes topic by topic; rosbags would stop at the disorder."""
    whole = storage_file(write_bag(tmp_path, "mcap", drive()))
    content = whole.read_bytes()
    header_end = 8 + 9 + struct.unpack_from("<Q", content, 9)[0]
    chunk_size = struct.unpack_from("<Q", content, header_end + 1)[0]
    records = content[header_end + 9 + 40 : header_end + 9 + chunk_size]
    messages, others = [], []
    while records:
        op, size = struct.unpack_from("<BQ", records)
        (messages if op == 5 else others).append(records[: 9 + size])
        records = records[9 + size :]
    data_end, footer = (
        b"\x0f" + struct.pack("<QI", 4, 0),
        b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0),
    )
    body = [content[:header_end], *others, *messages[1::2], *messages[::2], data_end, footer]
    path = copy_of(whole, tmp_path, b"".join(body) + content[:8])
    expected = sorted(raw_messages(whole), key=lambda m: (m.bag_ns, m.topic))
    with BagSource((path,), salvage=False, notes=(notes := Counter())) as source:
        found = sorted(source.messages(source.topics), key=lambda m: (m.bag_ns, m.topic))
    assert found == expected
    assert not notes


def test_an_mcap_of_another_profile_is_read_all_the_same(tmp_path: Path) -> None:
    """rosbags insists on the profile ros2; other writers leave it empty."""
    whole = storage_file(write_bag(tmp_path, "mcap", drive()))
    content = whole.read_bytes()
    path = copy_of(whole, tmp_path, content.replace(b"\x04\x00\x00\x00ros2", b"\x04\0\0\0cdr!", 1))
    assert path.read_bytes() != content
    assert [m.stamp_ns for m in record(path, salvage=False)] == [
        m.stamp_ns for m in record(whole, salvage=False)
    ]
