"""Walking through bag files record by record, without the index that a killed recorder never wrote.

The formats: ROS bag 2.0 (wiki.ros.org/Bags/Format/2.0), MCAP (mcap.dev/spec) and rosbag2's SQLite
schema. What is cut off in the middle is read up to the cut, compressed chunks included.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

ROS1_MAGIC = b"#ROSBAG V2.0\n"
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"

_ROS1_MESSAGE, _ROS1_BAG, _ROS1_CHUNK, _ROS1_CONNECTION = 2, 3, 5, 7
_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK, _MCAP_DATA_END = 3, 4, 5, 6, 15
_MCAP_READ = (_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK)


class RawMessage(NamedTuple):
    """A message as it lies in the bag. encoding : "ros1" or "cdr"."""

    topic: str
    msgtype: str
    encoding: str
    bag_ns: int
    data: bytes


class Channel(NamedTuple):
    """What a stream of messages in a file is: msgtype as ROS 2 writes it, `pkg/msg/Name`."""

    topic: str
    msgtype: str
    encoding: str


Lost = Callable[[str], None]
"""Called with the words of a note when something in the file could not be read."""


def walk_ros1(path: Path, topics: Collection[str] | None, lost: Lost) -> Iterator[RawMessage]:
    """The messages of a ROS 1 bag in file order; topics None takes all."""
    channels: dict[int, Channel] = {}
    index_at = 0  # where the chunks end; a recorder writes it when it closes the bag
    with path.open("rb") as file:
        file.seek(len(ROS1_MAGIC))
        for op, header, data in _ros1_records(file, path.stat().st_size):
            if op == _ROS1_BAG:
                index_at = int.from_bytes(header.get("index_pos", b""), "little")
            if op == _ROS1_CHUNK:
                chunk = _decompress(header["compression"].decode(), data, lost)
                inner = _ros1_records_of(chunk)
            else:
                inner = iter([(op, header, data)])
            yield from _ros1_messages(inner, channels, topics)
        if not 0 < index_at <= file.tell():
            lost(_ends_early(path))


def _ends_early(path: Path) -> str:
    return f"{path.name} ends early: it is cut off or damaged, or its recorder was killed"


def _ros1_messages(
    records: Iterator[tuple[int, dict[str, bytes], bytes]],
    channels: dict[int, Channel],
    topics: Collection[str] | None,
) -> Iterator[RawMessage]:
    for op, header, data in records:
        if op == _ROS1_CONNECTION:
            number = int.from_bytes(header["conn"], "little")
            fields = _ros1_fields(data)
            package, _, name = fields["type"].decode().rpartition("/")
            topic = "/" + header["topic"].decode().strip("/")
            channels[number] = Channel(topic, f"{package.removesuffix('/msg')}/msg/{name}", "ros1")
        elif op == _ROS1_MESSAGE:
            channel = channels.get(int.from_bytes(header["conn"], "little"))
            if channel is not None and (topics is None or channel.topic in topics):
                sec, nanosec = struct.unpack("<II", header["time"])
                yield RawMessage(*channel, sec * 10**9 + nanosec, data)


def _ros1_fields(block: bytes) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    at = 0
    while at + 4 <= len(block):
        size = int.from_bytes(block[at : at + 4], "little")
        name, _, value = block[at + 4 : at + 4 + size].partition(b"=")
        fields[name.decode("ascii", "replace")] = value
        at += 4 + size
    return fields


def _ros1_records(file: BinaryIO, file_size: int) -> Iterator[tuple[int, dict[str, bytes], bytes]]:
    """Top-level records; the last chunk's data may be cut short, other cut records are dropped.

    Leaves the file where the first record that is not whole begins.
    """
    while True:
        at = file.tell()
        size = file.read(4)
        header = _ros1_fields(file.read(min(int.from_bytes(size, "little"), file_size)))
        size = file.read(4)
        if len(size) < 4 or not header.get("op"):
            break
        length = int.from_bytes(size, "little")
        op = header["op"][0]
        data = file.read(min(length, file_size))  # a broken length must not ask for gigabytes
        is_whole = len(data) == length
        if is_whole or op == _ROS1_CHUNK:
            yield op, header, data
        if not is_whole:
            break
    file.seek(at)


def _ros1_records_of(chunk: bytes) -> Iterator[tuple[int, dict[str, bytes], bytes]]:
    """Whole records in a chunk's decompressed bytes."""
    at = 0
    while at + 4 <= len(chunk):
        header_end = at + 4 + int.from_bytes(chunk[at : at + 4], "little")
        data_at = header_end + 4
        data_end = data_at + int.from_bytes(chunk[header_end:data_at], "little")
        if data_at > len(chunk) or data_end > len(chunk):
            return
        header = _ros1_fields(chunk[at + 4 : header_end])
        if not header.get("op"):
            return
        yield header["op"][0], header, chunk[data_at:data_end]
        at = data_end


def walk_mcap(path: Path, topics: Collection[str] | None, lost: Lost) -> Iterator[RawMessage]:
    """The messages of an MCAP file in file order; topics None takes all."""
    schemas: dict[int, str] = {}
    channels: dict[int, Channel] = {}
    file_size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(len(MCAP_MAGIC))
        while len(head := file.read(9)) == 9:
            op, length = struct.unpack("<BQ", head)
            if op == _MCAP_DATA_END:
                return
            if op not in _MCAP_READ:
                file.seek(min(length, file_size), 1)
                continue
            record = file.read(min(length, file_size))
            if op == _MCAP_CHUNK:
                inner = _mcap_records_of(_mcap_chunk(record, lost))
            elif len(record) < length:
                break
            else:
                inner = iter([(op, record)])
            yield from _mcap_messages(inner, schemas, channels, topics)
    lost(_ends_early(path))


def _mcap_messages(
    records: Iterator[tuple[int, bytes]],
    schemas: dict[int, str],
    channels: dict[int, Channel],
    topics: Collection[str] | None,
) -> Iterator[RawMessage]:
    for op, record in records:
        if op == _MCAP_SCHEMA:
            schemas[int.from_bytes(record[:2], "little")], _ = _mcap_string(record, 2)
        elif op == _MCAP_CHANNEL:
            number, schema = struct.unpack_from("<HH", record)
            topic, at = _mcap_string(record, 4)
            encoding, _ = _mcap_string(record, at)
            package, _, name = schemas.get(schema, "").rpartition("/")
            msgtype = f"{package.removesuffix('/msg')}/msg/{name}"
            channels[number] = Channel(topic, msgtype, encoding)
        elif op == _MCAP_MESSAGE:
            number, _, log_ns = struct.unpack_from("<HIQ", record)
            channel = channels.get(number)
            if channel is not None and (topics is None or channel.topic in topics):
                yield RawMessage(*channel, log_ns, record[22:])


def _mcap_string(record: bytes, at: int) -> tuple[str, int]:
    end = at + 4 + int.from_bytes(record[at : at + 4], "little")
    return record[at + 4 : end].decode("utf-8", "replace"), end


def _mcap_chunk(record: bytes, lost: Lost) -> bytes:
    """The bytes in a chunk record; a record that is cut off gives what it holds."""
    if len(record) < 40:
        return b""
    compression, at = _mcap_string(record, 28)
    return _decompress(compression, record[at + 8 :], lost)


def _mcap_records_of(chunk: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 9 <= len(chunk):
        op, length = struct.unpack_from("<BQ", chunk, at)
        end = at + 9 + length
        if end > len(chunk):
            return
        yield op, chunk[at + 9 : end]
        at = end


def _decompress(compression: str, data: bytes, lost: Lost) -> bytes:
    """All that a compressed block yields, up to where it is cut off or broken."""
    if compression in ("", "none"):
        return data
    decompressor = _decompressor(compression)
    if decompressor is None:
        lost(f"chunk left out: compression {compression!r} is not known")
        return b""
    out = bytearray()
    try:
        for at in range(0, len(data), 4096):
            out += decompressor(data[at : at + 4096])
    except Exception:  # each library has errors of its own, and what came before is good
        lost("chunk read only in part: its compressed data is damaged")
    return bytes(out)


def _decompressor(compression: str) -> Callable[[bytes], bytes] | None:
    if compression == "bz2":
        import bz2  # noqa: PLC0415

        return bz2.BZ2Decompressor().decompress
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped] # noqa: PLC0415

        lz4: Callable[[bytes], bytes] = LZ4FrameDecompressor().decompress
        return lz4
    if compression == "zstd":
        from backports.zstd import ZstdDecompressor  # noqa: PLC0415

        return ZstdDecompressor().decompress
    return None


def walk_sqlite(path: Path, topics: Collection[str] | None, lost: Lost) -> Iterator[RawMessage]:
    """The messages of a rosbag2 database in the order they were written; topics None takes all."""
    connection = _open_damaged(path)
    try:
        channels = {
            number: Channel(topic, msgtype, encoding)
            for number, topic, msgtype, encoding in connection.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            )
            if topics is None or topic in topics
        }
        for number, bag_ns, data in connection.execute(
            "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"
        ):
            if number in channels:
                yield RawMessage(*channels[number], bag_ns, data)
    except sqlite3.DatabaseError as error:
        lost(f"{path.name}: read up to where the database is damaged ({error})")
    finally:
        connection.close()
    if _is_shorter_than_said(path):
        lost(_ends_early(path))


def _is_shorter_than_said(path: Path) -> bool:
    """Whether pages are missing by the database's header (sqlite.org/fileformat.html, 1.3)."""
    with path.open("rb") as file:
        header = file.read(32)
    page_bytes = int.from_bytes(header[16:18], "big")
    pages = int.from_bytes(header[28:32], "big")
    return path.stat().st_size < pages * (65536 if page_bytes == 1 else page_bytes)


def _open_damaged(path: Path) -> sqlite3.Connection:
    """A read-only connection that bears a file shorter than its header says.

    A write-ahead log left beside the file is read too, where the folder lets SQLite do so.
    """
    for mode in ("mode=ro", "immutable=1"):
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)
        try:
            connection.execute("PRAGMA writable_schema=ON")
            connection.execute("SELECT count(*) FROM topics").fetchone()
        except sqlite3.OperationalError:
            connection.close()
            continue
        return connection
    raise sqlite3.OperationalError("not a rosbag2 database")
