"""Bags made to cost memory and time, or to trip a reader up: what is good in them is read."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import tracemalloc
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from backports import zstd

from datasets.bag_depth import BadImageError, depth_format
from datasets.bag_messages import RosMessage
from datasets.bag_records import RawMessage
from datasets.bag_source import BagSource
from datasets.bags import BagRecording
from datasets.errors import InputError
from datasets.options import ReadOptions
from datasets.unpack import SPARE_BYTES, Allowance, DamagedError, unpack, unpack_part
from tests.datasets.bag_factory import (
    T0_NS,
    Entry,
    S,
    camera_info_entry,
    compressed_entry,
    odometry_entry,
    png,
    scan_entry,
    storage_file,
    string_entry,
    tf_entry,
    write_bag,
)

MB = 1 << 20


def drive(scans: int = 30) -> list[Entry]:
    mounting = ("base_link", "laser", (0.2, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))
    entries = [tf_entry(T0_NS, mounting, topic="/tf_static")]
    for k in range(scans):
        entries.append(scan_entry(T0_NS + k * S // 10, ranges=[1.0 + k, 2.0, 3.0]))
        entries.append(odometry_entry(T0_NS + k * S // 10 + 1, 0.1 * k))
    return entries


def messages(path: Path, *, salvage: bool = False) -> tuple[list[RawMessage], Counter[str]]:
    notes: Counter[str] = Counter()
    with BagSource((path,), salvage=salvage, notes=notes) as source:
        return list(source.messages(source.topics)), notes


def bomb(compression: str, megabytes: int) -> bytes:
    """Zeros in one frame, made without ever holding them."""
    zeros = bytes(MB)
    if compression == "bz2":
        packer = bz2.BZ2Compressor()
        return b"".join(packer.compress(zeros) for _ in range(megabytes)) + packer.flush()
    if compression == "lz4":
        lz4_packer = lz4.frame.LZ4FrameCompressor()
        parts = [lz4_packer.begin(), *(lz4_packer.compress(zeros) for _ in range(megabytes))]
        return b"".join(parts) + lz4_packer.flush()
    zstd_packer = zstd.ZstdCompressor()
    return b"".join(zstd_packer.compress(zeros) for _ in range(megabytes)) + zstd_packer.flush()


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
@pytest.mark.parametrize("declared", [1000, 1 << 40, None])
def test_a_bomb_unpacks_to_what_is_declared_and_allowed(
    compression: str, declared: int | None
) -> None:
    packed = bomb(compression, 300)
    allowance = Allowance(len(packed))
    allowance.bytes = 20 * MB
    tracemalloc.start()
    try:
        out, fault = unpack_part(compression, packed, declared, allowance)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert out == b""
    assert fault is not None
    assert ("than is declared" if declared == 1000 else "far more than it can hold") in fault
    assert peak < 60 * MB


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
def test_a_block_comes_whole_in_one_frame_or_in_several(compression: str) -> None:
    content = np.random.default_rng(1).bytes(300_000)
    pack: Callable[[bytes], bytes] = {
        "bz2": bz2.compress,
        "lz4": lz4.frame.compress,
        "zstd": zstd.compress,
    }[compression]
    one, two = pack(content), pack(content[:1000]) + pack(content[1000:])
    for packed in (one, two):
        assert unpack(compression, packed, len(content), Allowance(MB)) == content
    with pytest.raises(DamagedError, match="damaged"):
        unpack(compression, one, len(content) + 1, Allowance(MB))
    with pytest.raises(DamagedError, match="damaged"):
        unpack(compression, one[:-9], len(content), Allowance(MB))
    with pytest.raises(DamagedError, match="than is declared"):
        unpack(compression, one, len(content) - 1, Allowance(MB))


def mcap(*records: tuple[int, bytes]) -> bytes:
    whole = [(1, b"\4\0\0\0ros2\0\0\0\0"), *records, (15, bytes(4)), (2, bytes(20))]
    body = b"".join(struct.pack("<BQ", op, len(data)) + data for op, data in whole)
    return b"\x89MCAP0\r\n" + body + b"\x89MCAP0\r\n"


def text(*words: str) -> bytes:
    return b"".join(struct.pack("<I", len(w.encode())) + w.encode() for w in words)


SCHEMA = (3, b"\1\0" + text("std_msgs/msg/String", "ros2msg", "string data"))


def channel(topic: str = "/chatter") -> tuple[int, bytes]:
    return 4, b"\0\0\1\0" + text(topic, "cdr") + bytes(4)


def message(log_ns: int, data: bytes = b"\0\1\0\0\1\0\0\0\0") -> tuple[int, bytes]:
    return 5, struct.pack("<HIQQ", 0, 0, log_ns, log_ns) + data


def chunk(packed: bytes, declared: int) -> tuple[int, bytes]:
    head = struct.pack("<QQQI", 0, 0, declared, 0) + text("zstd")
    return 6, head + struct.pack("<Q", len(packed)) + packed


@pytest.mark.parametrize("salvage", [False, True])
@pytest.mark.parametrize("declared", [1 << 20, 3000 * MB])
def test_a_bag_of_a_bomb_is_called_damaged(tmp_path: Path, salvage: bool, declared: int) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(mcap(SCHEMA, channel(), chunk(bomb("zstd", 3000), declared)))
    assert path.stat().st_size < 1_000_000
    with pytest.raises(InputError, match=r"than is declared|far more than it can hold") as caught:
        messages(path, salvage=salvage)
    assert "empty" not in str(caught.value)


def test_a_chunk_of_millions_of_tiny_records_is_not_read_to_its_end(tmp_path: Path) -> None:
    tiny = struct.pack("<BQ", 0x80, 0) * (SPARE_BYTES // 10)
    path = tmp_path / "tiny.mcap"
    packed = zstd.compress(tiny)
    path.write_bytes(mcap(SCHEMA, channel(), chunk(packed, len(tiny)), message(T0_NS)))
    with pytest.raises(InputError, match="more records than its size allows"):
        messages(path)
    read, notes = messages(path, salvage=True)
    assert len(read) == 1
    assert notes["chunk read only in part: it holds far more records than its size allows"] == 1


def test_a_bag_time_that_is_none_costs_the_message(tmp_path: Path) -> None:
    path = tmp_path / "late.mcap"
    path.write_bytes(mcap(SCHEMA, channel(), message(T0_NS), message(2**64 - 1)))
    read, notes = messages(path)
    assert [m.bag_ns for m in read] == [T0_NS]
    assert notes == {"message of /chatter left out: its bag time is none": 1}


def test_a_name_reaches_nobody_raw(tmp_path: Path) -> None:
    path = tmp_path / "name.mcap"
    path.write_bytes(mcap(SCHEMA, channel("/a\x1b[31m\nb"), message(T0_NS)))
    read, _ = messages(path)
    assert [m.topic for m in read] == ["/a\\x1b[31m b"]
    with pytest.raises(InputError) as caught:
        BagRecording([path], ReadOptions())
    assert str(caught.value).isprintable()


def test_two_types_under_one_name_are_one_topic(tmp_path: Path) -> None:
    other = (3, b"\2\0" + text("tf2_msgs/msg/TFMessage", "ros2msg", ""))
    second = (4, b"\1\0\2\0" + text("/chatter", "cdr") + bytes(4))
    foreign = (5, struct.pack("<HIQQ", 1, 0, T0_NS, 0) + bytes(8))
    path = tmp_path / "two.mcap"
    path.write_bytes(mcap(SCHEMA, other, channel(), second, message(T0_NS), foreign))
    read, notes = messages(path)
    assert [m.msgtype for m in read] == ["std_msgs/msg/String"]
    assert notes == {"message of /chatter left out: it is of another type": 1}


def test_index_records_of_an_early_recorder_are_read(tmp_path: Path) -> None:
    """They say 20 bytes an entry and hold 12."""
    whole = write_bag(tmp_path, "ros1", drive(), chunk_bytes=1000)
    content = bytearray(whole.read_bytes())
    at, changed = 0, 0
    while (at := content.find(b"count=", at)) >= 0:
        (count,) = struct.unpack_from("<I", content, at + 6)
        length_at = content.find(struct.pack("<I", 12 * count), at + 10, at + 60)
        if length_at >= 0 and b"op=\4" in content[at - 40 : length_at]:
            struct.pack_into("<I", content, length_at, 20 * count)
            changed += 1
        at += 10
    assert changed > 10
    old = tmp_path / "old.bag"
    old.write_bytes(content)
    expected, _ = messages(whole)
    assert len(expected) == 61
    for salvage in (False, True):
        read, notes = messages(old, salvage=salvage)
        assert sorted(read) == sorted(expected)
        assert not notes
    assert messages(old)[0] == expected


def database(folder: Path, change: Callable[[sqlite3.Connection], object]) -> Path:
    path = storage_file(write_bag(folder, "sqlite3", [*drive(), string_entry(T0_NS, "hello")]))
    connection = sqlite3.connect(path)
    with connection:
        change(connection)
    connection.close()
    return path


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
NOT_TABLES = {
    "an endless view": f"""
        ALTER TABLE messages RENAME TO hidden;
        CREATE VIEW messages AS {ENDLESS} SELECT i AS id, 1 AS topic_id, i AS timestamp,
            zeroblob(100) AS data FROM n;""",
    "a view in capitals": f"""
        ALTER TABLE topics RENAME TO hidden;
        CREATE VIEW TOPICS AS {ENDLESS} SELECT i AS id, 'a' AS name, 'b' AS type,
            'cdr' AS serialization_format FROM n;""",
    "a generated column": """
        ALTER TABLE messages RENAME TO hidden;
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
            data BLOB AS (zeroblob(900000000)));
        INSERT INTO messages(topic_id, timestamp) SELECT topic_id, timestamp FROM hidden;""",
    "a virtual table": """
        ALTER TABLE messages RENAME TO hidden;
        CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data);""",
}


@pytest.mark.parametrize("salvage", [False, True])
@pytest.mark.parametrize("script", NOT_TABLES.values(), ids=NOT_TABLES)
def test_a_database_that_computes_its_rows_is_refused(
    tmp_path: Path, script: str, salvage: bool
) -> None:
    path = database(tmp_path, lambda connection: connection.executescript(script))
    with pytest.raises(InputError, match="are no plain table"):
        messages(path, salvage=salvage)


def test_rows_of_other_types_cost_themselves(tmp_path: Path) -> None:
    def change(connection: sqlite3.Connection) -> None:
        connection.execute("UPDATE messages SET data = 'text' WHERE id = 5")
        connection.execute("UPDATE messages SET timestamp = 'noon' WHERE id = 6")
        connection.execute("UPDATE messages SET timestamp = -5 WHERE id = 7")

    path = database(tmp_path, change)
    for salvage in (False, True):
        read, notes = messages(path, salvage=salvage)
        assert len(read) == 62 - 3
        assert any("no messages" in note for note in notes)
        assert any("its bag time is none" in note for note in notes)


def test_a_topic_without_a_name_is_damage(tmp_path: Path) -> None:
    def change(connection: sqlite3.Connection) -> None:
        connection.executescript("""
            CREATE TABLE t AS SELECT * FROM topics; DROP TABLE topics;
            ALTER TABLE t RENAME TO topics; UPDATE topics SET name = NULL WHERE id = 2;""")

    path = database(tmp_path, change)
    with pytest.raises(InputError, match="no name or no type"):
        messages(path)
    read, _ = messages(path, salvage=True)
    assert len(read) == 62 - 30


def test_messages_compressed_one_by_one_are_read_without_their_metadata(tmp_path: Path) -> None:
    folder = write_bag(tmp_path, "sqlite3", drive(), compression="message")
    expected, _ = messages(write_bag(tmp_path, "sqlite3", drive(), name="plain"))
    for path in (folder, storage_file(folder)):
        for salvage in (False, True):
            read, notes = messages(path, salvage=salvage)
            assert sorted(read) == sorted(expected)
            assert not notes


@pytest.mark.parametrize(
    "metadata",
    [
        "a: &a [1]\nb: &b {<<: [*a, *a]}\n",
        "[" * 10_000,
        "rosbag2_bagfile_information: {relative_file_paths: {a: 1}}\n",
        "rosbag2_bagfile_information: [2020-01-01]\n",
        "rosbag2_bagfile_information: {relative_file_paths: [gone.mcap]}\n",
        "rosbag2_bagfile_information: {relative_file_paths: ['..', /etc/passwd, \"a\\0b\"]}\n",
        "x" * 2_000_000,
    ],
    ids=lambda text: text[:40],
)
def test_a_folder_with_hostile_metadata_is_read_by_its_files(tmp_path: Path, metadata: str) -> None:
    folder = write_bag(tmp_path, "mcap", drive())
    expected, _ = messages(folder)
    (folder / "metadata.yaml").write_text(metadata)
    read, notes = messages(folder)
    assert read == expected
    assert len(notes) == 1
    assert next(iter(notes)).startswith("drive: read file by file, ")


def test_a_picture_of_too_many_pixels_is_called_damaged() -> None:
    header = struct.pack(">IIBBBBB", 7071, 7071, 16, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + header + bytes(40)

    class Compressed:
        format = "16UC1; compressedDepth png"
        data = np.frombuffer(bytes(12) + png, dtype=np.uint8)

    image: RosMessage = Compressed()
    with pytest.raises(BadImageError, match="more than 10 million pixels"):
        depth_format(image)


def test_a_database_whose_column_has_no_name_that_is_text(tmp_path: Path) -> None:
    path = database(tmp_path, lambda connection: None)
    content = path.read_bytes()
    assert content.count(b"timestamp INTEGER") == 1
    path.write_bytes(content.replace(b"timestamp INTEGER", b"times\xff\xfemp INTEGER"))
    for salvage in (False, True):
        with pytest.raises(InputError) as caught:
            messages(path, salvage=salvage)
        assert str(caught.value).isprintable()


def scans_of(topics: int) -> list[Entry]:
    return [scan_entry(T0_NS + k * S, topic=f"/scan_{k}") for k in range(topics)]


def test_topics_of_lidars_beyond_count_are_to_be_chosen_from(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", scans_of(31))
    with pytest.raises(InputError, match="there are 31 topics of lidars"):
        BagRecording([path], ReadOptions())
    assert len(list(BagRecording([path], ReadOptions(lidars=("/scan_7",))))) == 1


def test_a_chain_of_frames_without_end_is_followed_so_far(tmp_path: Path) -> None:
    links = [(f"f{k}", f"f{k + 1}", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)) for k in range(9000)]
    entries = [tf_entry(T0_NS, *links, topic="/tf_static"), scan_entry(T0_NS, frame="f4999")]
    path = write_bag(tmp_path, "mcap", entries)
    recording = BagRecording([path], ReadOptions())
    assert len(list(recording)) == 1
    assert recording.notes["transform of /tf_static left out: there are more than 5000 frames"]


def test_images_that_unpack_twice_are_decoded_as_far_as_a_file_may_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("datasets.bags.SPARE_PIXELS", 10 * 48 + 47)
    camera = ("base_link", "camera_depth_optical_frame", (0.1, 0, 0.2), (-0.5, 0.5, -0.5, 0.5))
    entries = [tf_entry(T0_NS, camera, topic="/tf_static"), camera_info_entry(T0_NS)]
    depth = np.full((6, 8), 1000, np.uint16)
    entries += [compressed_entry(T0_NS + k * S, bytes(12) + png(depth)) for k in range(15)]
    recording = BagRecording([write_bag(tmp_path, "mcap", entries)], ReadOptions())
    assert len(list(recording)) == 10
    told = [note for note in recording.notes if "far more pixels" in note]
    assert [recording.notes[note] for note in told] == [5]
