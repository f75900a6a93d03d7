"""Walking through bag files record by record, without the index that a killed recorder never wrote.

What is cut off in the middle is read up to the cut, compressed chunks included.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import BinaryIO

from datasets.bag_records import (
    MCAP_CHANNEL,
    MCAP_CHUNK,
    MCAP_CHUNK_BYTES,
    MCAP_DATA_END,
    MCAP_MAGIC,
    MCAP_MESSAGE,
    MCAP_SCHEMA,
    ROS1_BAG,
    ROS1_CHUNK,
    ROS1_INDEX,
    ROS1_MAGIC,
    Channel,
    Entry,
    RawMessage,
    Ros1Record,
    mcap_entries,
    mcap_records,
    mcap_string,
    ros1_entries,
    ros1_fields,
    ros1_records,
)
from datasets.bag_sqlite import Database, is_shorter_than_said
from datasets.unpack import Allowance, DamagedError, unpack_part

_MCAP_READ = (MCAP_SCHEMA, MCAP_CHANNEL, MCAP_MESSAGE, MCAP_CHUNK)

Lost = Callable[[str], None]
"""Called with the words of a note when something in the file could not be read."""


def walk_ros1(path: Path, topics: Collection[str] | None, lost: Lost) -> Iterator[RawMessage]:
    """The messages of a ROS 1 bag in file order; topics None takes all."""
    channels: dict[int, Channel] = {}
    index_at = 0  # where the chunks end; a recorder writes it when it closes the bag
    allowance = Allowance(path.stat().st_size)
    with path.open("rb") as file:
        file.seek(len(ROS1_MAGIC))
        for op, header, data in _ros1_top(file, path.stat().st_size):
            if op == ROS1_BAG:
                index_at = int.from_bytes(header.get("index_pos", b""), "little")
            if op == ROS1_CHUNK:
                compression = header.get("compression", b"").decode("ascii", "replace")
                size = int.from_bytes(header.get("size", b""), "little")
                chunk = _unpacked(compression, data, size, allowance, lost)
                entries = ros1_entries(allowance.counting(ros1_records(chunk)), channels)
            else:
                entries = ros1_entries(iter([(op, header, data)]), channels)
            yield from _named(entries, channels, topics, lost)
        if not 0 < index_at <= file.tell():
            lost(_ends_early(path))


def _ends_early(path: Path) -> str:
    return f"{path.name} ends early: it is cut off or damaged, or its recorder was killed"


def _named(
    entries: Iterator[Entry],
    channels: dict[int, Channel],
    topics: Collection[str] | None,
    lost: Lost,
) -> Iterator[RawMessage]:
    """The messages of topics, up to where the records are damaged."""
    try:
        for number, bag_ns, data in entries:
            channel = channels.get(number)
            if channel is not None and (topics is None or channel.topic in topics):
                yield RawMessage(*channel, bag_ns, data)
    except DamagedError as error:
        lost(f"chunk read only in part: {error}")


def _unpacked(compression: str, data: bytes, size: int, allowance: Allowance, lost: Lost) -> bytes:
    out, fault = unpack_part(compression, data, size, allowance)
    if fault is not None:
        lost(f"chunk {'read only in part' if out else 'left out'}: {fault}")
    return out


def _ros1_top(file: BinaryIO, file_size: int) -> Iterator[Ros1Record]:
    """Top-level records; the last chunk's data may be cut short, other cut records are dropped.

    Leaves the file where the first record that is not whole begins.
    """
    while True:
        at = file.tell()
        size = file.read(4)
        header = ros1_fields(file.read(min(int.from_bytes(size, "little"), file_size)))
        size = file.read(4)
        if len(size) < 4 or not header.get("op"):
            break
        op = header["op"][0]
        length = int.from_bytes(size, "little")
        if op == ROS1_INDEX:
            length = index_bytes(file, header, length, file_size)
        data = file.read(min(length, file_size))  # a broken length must not ask for gigabytes
        is_whole = len(data) == length
        if is_whole or op == ROS1_CHUNK:
            yield op, header, data
        if not is_whole:
            break
    file.seek(at)


def index_bytes(file: BinaryIO, header: dict[str, bytes], said: int, file_size: int) -> int:
    """How many bytes the data of an index record really are; the file stays where they begin.

    Early recorders wrote 20 bytes an entry into the record's length and 12 into the file: where
    a record follows so many bytes on, the length is wrong.
    """
    entries = 12 * int.from_bytes(header.get("count", b""), "little")
    at = file.tell()
    if entries == said or at + entries > file_size:
        return said
    file.seek(at + entries)
    size = file.read(4)
    follows = ros1_fields(file.read(min(int.from_bytes(size, "little"), 1 << 12)))
    is_end = not size
    file.seek(at)
    return entries if is_end or len(follows.get("op", b"")) == 1 else said


def walk_mcap(path: Path, topics: Collection[str] | None, lost: Lost) -> Iterator[RawMessage]:
    """The messages of an MCAP file in file order; topics None takes all."""
    schemas: dict[int, str] = {}
    channels: dict[int, Channel] = {}
    file_size = path.stat().st_size
    allowance = Allowance(file_size)
    with path.open("rb") as file:
        file.seek(len(MCAP_MAGIC))
        while len(head := file.read(9)) == 9:
            op, length = struct.unpack("<BQ", head)
            if op == MCAP_DATA_END:
                return
            if op not in _MCAP_READ:
                file.seek(min(length, file_size), 1)
                continue
            record = file.read(min(length, file_size))
            if op == MCAP_CHUNK:
                chunk = _mcap_chunk(record, allowance, lost)
                inner = allowance.counting(mcap_records(chunk))
            elif len(record) < length:
                break
            else:
                inner = iter([(op, record)])
            entries = mcap_entries(inner, schemas, channels)
            yield from _named(entries, channels, topics, lost)
    lost(_ends_early(path))


def _mcap_chunk(record: bytes, allowance: Allowance, lost: Lost) -> bytes:
    """The bytes in a chunk record; a record that is cut off gives what it holds."""
    if len(record) < MCAP_CHUNK_BYTES:
        return b""
    compression, at = mcap_string(record, 28)
    size = int.from_bytes(record[16:24], "little")
    return _unpacked(compression, record[at + 8 :], size, allowance, lost)


def walk_sqlite(path: Path, topics: Collection[str] | None, lost: Lost) -> Iterator[RawMessage]:
    """The messages of a rosbag2 database in the order they were written; topics None takes all."""
    database = Database(path, salvage=True)
    try:
        channels = {
            number: channel
            for number, channel in database.channels().items()
            if topics is None or channel.topic in topics
        }
        for number, bag_ns, data in database.entries(channels.keys()):
            yield RawMessage(*channels[number], bag_ns, data)
    except DamagedError as error:
        lost(f"{path.name}: read up to where the database is damaged ({error})")
    finally:
        database.close()
    if database.unreadable:
        lost(f"{path.name}: {database.unreadable} rows are no messages")
    if is_shorter_than_said(path):
        lost(_ends_early(path))
