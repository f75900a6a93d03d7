"""The records of bag files: ROS bag 2.0 (wiki.ros.org/Bags/Format/2.0) and MCAP (mcap.dev/spec)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

from datasets.unpack import DamagedError

ROS1_MAGIC: Final = b"#ROSBAG V2.0\n"
MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
SQLITE_MAGIC: Final = b"SQLite format 3\x00"

ROS1_MESSAGE, ROS1_BAG, ROS1_INDEX, ROS1_CHUNK, ROS1_CHUNK_INFO, ROS1_CONNECTION = 2, 3, 4, 5, 6, 7
MCAP_HEADER, MCAP_FOOTER, MCAP_SCHEMA, MCAP_CHANNEL, MCAP_MESSAGE, MCAP_CHUNK = 1, 2, 3, 4, 5, 6
MCAP_MESSAGE_INDEX, MCAP_DATA_END = 7, 15

MCAP_CHUNK_BYTES: Final = 40
"""The fixed part of a chunk record, without the name of its compression."""


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


class Entry(NamedTuple):
    """A message among the records: its channel's number, its bag time, its bytes."""

    channel: int
    bag_ns: int
    data: bytes


Ros1Record = tuple[int, dict[str, bytes], bytes]


def ros1_fields(block: bytes) -> dict[str, bytes]:
    """The fields of a record's header; what follows damage in them is missing."""
    fields: dict[str, bytes] = {}
    at = 0
    while at + 4 <= len(block):
        size = int.from_bytes(block[at : at + 4], "little")
        name, _, value = block[at + 4 : at + 4 + size].partition(b"=")
        fields[name.decode("ascii", "replace")] = value
        at += 4 + size
    return fields


def ros1_records(block: bytes) -> Iterator[Ros1Record]:
    """The records in a chunk's bytes: op, header, data. Raises DamagedError where one is cut."""
    at = 0
    while at < len(block):
        header_end = at + 4 + int.from_bytes(block[at : at + 4], "little")
        data_at = header_end + 4
        data_end = data_at + int.from_bytes(block[header_end:data_at], "little")
        if data_at > len(block) or data_end > len(block):
            raise DamagedError("a record is cut off")
        header = ros1_fields(block[at + 4 : header_end])
        if not header.get("op"):
            raise DamagedError("a record is of no kind")
        yield header["op"][0], header, block[data_at:data_end]
        at = data_end


def ros1_entries(records: Iterator[Ros1Record], channels: dict[int, Channel]) -> Iterator[Entry]:
    """The messages among records; connections are put into ``channels``. Raises DamagedError."""
    for op, header, data in records:
        try:
            if op == ROS1_CONNECTION:
                number, channel = ros1_connection(header, data)
                channels[number] = channel
            elif op == ROS1_MESSAGE:
                sec, nanosec = struct.unpack("<II", header["time"])
                number = int.from_bytes(header["conn"], "little")
                yield Entry(number, sec * 10**9 + nanosec, data)
        except (KeyError, struct.error) as error:
            raise DamagedError("a record's header is damaged") from error


def ros1_connection(header: dict[str, bytes], data: bytes) -> tuple[int, Channel]:
    """A connection record: its number, and what it is of. Raises DamagedError."""
    fields = ros1_fields(data)
    if "type" not in fields or not {"topic", "conn"} <= header.keys():
        raise DamagedError("a connection in it is damaged")
    name = fields["type"].decode("utf-8", "replace")
    topic = header["topic"].decode("utf-8", "replace").strip("/")
    topic = "/" + "/".join(part for part in topic.split("/") if part)
    return int.from_bytes(header["conn"], "little"), Channel(topic, ros2_name(name), "ros1")


def ros2_name(name: str) -> str:
    """`pkg/msg/Name` of a type that may be written `pkg/Name`."""
    package, _, base = name.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{base}"


McapRecord = tuple[int, bytes]


def mcap_records(block: bytes) -> Iterator[McapRecord]:
    """The records in a chunk's bytes: op, content. Raises DamagedError where one is cut."""
    at = 0
    while at < len(block):
        if at + 9 > len(block):
            raise DamagedError("a record is cut off")
        op, length = struct.unpack_from("<BQ", block, at)
        end = at + 9 + length
        if end > len(block):
            raise DamagedError("a record is cut off")
        if op == 0:
            raise DamagedError("a record is of no kind")
        yield op, block[at + 9 : end]
        at = end


def mcap_entries(
    records: Iterator[McapRecord], schemas: dict[int, str], channels: dict[int, Channel]
) -> Iterator[Entry]:
    """The messages among records; schemas and channels are put into the dicts.

    Raises DamagedError.
    """
    for op, record in records:
        try:
            if op == MCAP_SCHEMA:
                schemas[int.from_bytes(record[:2], "little")], _ = mcap_string(record, 2)
            elif op == MCAP_CHANNEL:
                number, schema = struct.unpack_from("<HH", record)
                topic, at = mcap_string(record, 4)
                encoding, _ = mcap_string(record, at)
                channels[number] = Channel(topic, ros2_name(schemas.get(schema, "")), encoding)
            elif op == MCAP_MESSAGE:
                number, _, log_ns, _ = struct.unpack_from("<HIQQ", record)
                yield Entry(number, log_ns, record[22:])
        except struct.error as error:
            raise DamagedError("a record is too short") from error


def mcap_string(record: bytes, at: int) -> tuple[str, int]:
    """A string with its length before it, and where it ends."""
    end = at + 4 + int.from_bytes(record[at : at + 4], "little")
    return record[at + 4 : end].decode("utf-8", "replace"), end
