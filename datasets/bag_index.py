"""Whole ROS 1 and MCAP files: what is in them by their top-level records, in order of bag time.

The chunks are found by walking from record to record, which takes a few bytes of each; what a
file's own index says of places is not needed. A file whose records don't end where they should is
damaged, and for ``bag_salvage.py``.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from datasets.bag_records import (
    MCAP_CHANNEL,
    MCAP_CHUNK,
    MCAP_CHUNK_BYTES,
    MCAP_DATA_END,
    MCAP_FOOTER,
    MCAP_MAGIC,
    MCAP_MESSAGE,
    MCAP_MESSAGE_INDEX,
    MCAP_SCHEMA,
    ROS1_BAG,
    ROS1_CHUNK,
    ROS1_CHUNK_INFO,
    ROS1_CONNECTION,
    ROS1_INDEX,
    ROS1_MAGIC,
    ROS1_MESSAGE,
    Channel,
    Entry,
    mcap_entries,
    mcap_records,
    mcap_string,
    ros1_connection,
    ros1_entries,
    ros1_fields,
    ros1_records,
)
from datasets.bag_salvage import index_bytes
from datasets.unpack import Allowance, DamagedError, unpack

_LOOSE_BYTES: Final = 4 << 20
"""Messages outside chunks are read so many bytes at once."""
_MOST_SMALL_BYTES: Final = 16 << 20
"""Headers, channels and schemas are no longer than that."""
_LATEST_NS: Final = 2**64


@dataclass(slots=True)
class Block:
    """A stretch of the file that is read at once: a chunk's content, or messages outside chunks.

    at, size  : where its bytes lie in the file.
    start_ns  : the earliest bag time in it.
    counts    : messages by channel; None where only reading it tells.
    declared  : its size unpacked; None where it is not packed.
    checksum  : CRC-32 of what is unpacked, 0 for none.
    """

    at: int
    size: int
    start_ns: int
    counts: Counter[int] | None = None
    compression: str = ""
    declared: int | None = None
    checksum: int = 0


@dataclass(slots=True)
class Contents:
    """What a file holds: its blocks in the file's order, its channels by number."""

    blocks: list[Block] = field(default_factory=list)
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, str] = field(default_factory=dict)

    def counts(self) -> Counter[int]:
        """Messages by channel."""
        counts: Counter[int] = Counter()
        for block in self.blocks:
            counts.update(block.counts or {})
        return counts


class _Placed(NamedTuple):
    """A message by what orders it: its time, its channel's rank, its place."""

    bag_ns: int
    rank: int
    at: int
    number: int
    entry: Entry


class IndexedFile:
    """A whole ROS 1 or MCAP file. Raises DamagedError if it is not whole, OSError."""

    def __init__(self, path: Path, magic: bytes) -> None:
        self._path = path
        self._size = path.stat().st_size
        self._is_ros1 = magic == ROS1_MAGIC
        with path.open("rb") as file:
            scan = _scan_ros1 if self._is_ros1 else _scan_mcap
            self._contents = scan(file, self._size)
            self._complete(file)
        self.channels = self._contents.channels
        self.counts = self._contents.counts()

    def entries(self, channels: Collection[int]) -> Iterator[Entry]:
        """The messages of some channels by bag time. Raises DamagedError, OSError."""
        wanted = frozenset(channels)
        ranks = {number: rank for rank, number in enumerate(self.channels)}
        blocks = [b for b in self._contents.blocks if b.counts is None or wanted & b.counts.keys()]
        blocks.sort(key=lambda block: (block.start_ns, block.at))
        allowance = Allowance(self._size)
        waiting: list[_Placed] = []
        with self._path.open("rb") as file:
            for block in blocks:
                while waiting and waiting[0].bag_ns < block.start_ns:
                    yield heapq.heappop(waiting).entry
                for number, entry in enumerate(self._read(file, block, allowance)):
                    if entry.channel in wanted:
                        rank = ranks[entry.channel] if self._is_ros1 else 0
                        placed = _Placed(entry.bag_ns, rank, block.at, number, entry)
                        heapq.heappush(waiting, placed)
            while waiting:
                yield heapq.heappop(waiting).entry

    def _read(self, file: BinaryIO, block: Block, allowance: Allowance) -> Iterator[Entry]:
        file.seek(block.at)
        data = file.read(block.size)
        if len(data) < block.size:
            raise DamagedError("it is cut off")
        if block.declared is not None:
            data = unpack(block.compression, data, block.declared, allowance)
            if block.checksum and zlib.crc32(data) != block.checksum:
                raise DamagedError("a checksum in it is wrong")
        if self._is_ros1:
            return ros1_entries(allowance.counting(ros1_records(data)), self._contents.channels)
        records = allowance.counting(mcap_records(data))
        return mcap_entries(records, self._contents.schemas, self._contents.channels)

    def _complete(self, file: BinaryIO) -> None:
        """Read the blocks that alone can tell what is in them, or what their channels are."""
        allowance = Allowance(self._size)
        for block in self._contents.blocks:
            known = self._contents.channels.keys()
            if block.counts is None or not block.counts.keys() <= known:
                entries = self._read(file, block, allowance)
                block.counts = Counter(entry.channel for entry in entries)


def _scan_ros1(file: BinaryIO, size: int) -> Contents:
    contents = Contents()
    head: dict[str, bytes] = {}
    indexed: Counter[int] = Counter()  # records of each kind where the bag's header says
    loose: Block | None = None
    file.seek(len(ROS1_MAGIC))
    while (at := file.tell()) < size:
        op, header, data_at, length = _ros1_record(file, size)
        if op == ROS1_BAG:
            head = header
        elif head and at >= _number(head, "index_pos"):
            indexed[op] += 1
        if op == ROS1_MESSAGE:
            loose = _loose(contents.blocks, loose, at, data_at + length, _ros1_time(header))
            _count(loose, _number(header, "conn"))
        elif op != ROS1_CONNECTION:
            loose = None
        if op == ROS1_CHUNK:
            compression = header.get("compression", b"").decode("ascii", "replace")
            declared = _number(header, "size")
            contents.blocks.append(Block(data_at, length, _LATEST_NS, None, compression, declared))
        elif op == ROS1_INDEX and contents.blocks:
            _add_ros1_index(contents.blocks[-1], header, _exactly(file, length))
        elif op == ROS1_CONNECTION:
            number, channel = ros1_connection(header, _exactly(file, length))
            contents.channels.pop(number, None)  # their order in the index ranks them
            contents.channels[number] = channel
        file.seek(data_at + length)
    if not head or not _number(head, "index_pos"):
        raise DamagedError("it is not indexed")
    if head.get("encryptor"):
        raise DamagedError("it is encrypted")
    said = ((ROS1_CONNECTION, "conn_count"), (ROS1_CHUNK_INFO, "chunk_count"))
    if any(indexed[op] < _number(head, name) for op, name in said):
        raise DamagedError("its index is damaged")
    _start_unknown(contents.blocks)
    return contents


def _ros1_record(file: BinaryIO, size: int) -> tuple[int, dict[str, bytes], int, int]:
    """Kind and header of the record here, and where its data are; the file is left there."""
    header = ros1_fields(_sized(file, "<I"))
    if len(header.get("op", b"")) != 1:
        raise DamagedError("a record is of no kind")
    op = header["op"][0]
    (length,) = struct.unpack("<I", _exactly(file, 4))
    data_at = file.tell()
    if op == ROS1_INDEX:
        length = index_bytes(file, header, length, size)
    if data_at + length > size:
        raise DamagedError("it is cut off")
    return op, header, data_at, length


def _add_ros1_index(block: Block, header: dict[str, bytes], data: bytes) -> None:
    """Take over what an index record says about the chunk before it."""
    count = _number(header, "count")
    entries = data[: 12 * count]
    if _number(header, "ver") != 1 or len(entries) != 12 * count:
        raise DamagedError("its index is damaged")
    if not count:
        return
    _count(block, _number(header, "conn"), count)
    earliest = min((sec, nanosec) for sec, nanosec, _ in struct.iter_unpack("<III", entries))
    block.start_ns = min(block.start_ns, earliest[0] * 10**9 + earliest[1])


def _scan_mcap(file: BinaryIO, size: int) -> Contents:
    contents = Contents()
    blocks = contents.blocks
    file.seek(max(0, size - len(MCAP_MAGIC)))
    if size < 2 * len(MCAP_MAGIC) or file.read() != MCAP_MAGIC:
        raise DamagedError("its end is missing")
    end = size - len(MCAP_MAGIC)
    file.seek(len(MCAP_MAGIC))
    loose: Block | None = None
    has_ended = False
    while (at := file.tell()) < end:
        op, length = struct.unpack("<BQ", _exactly(file, 9))
        if op == 0 or at + 9 + length > end:
            raise DamagedError("it is cut off")
        has_ended = has_ended or op in (MCAP_DATA_END, MCAP_FOOTER)
        if op == MCAP_MESSAGE and not has_ended:
            number, _, log_ns = struct.unpack("<HIQ", _exactly(file, 14))
            loose = _loose(blocks, loose, at, at + 9 + length, log_ns)
            _count(loose, number)
        elif op in (MCAP_SCHEMA, MCAP_CHANNEL):
            record = _exactly(file, min(length, _MOST_SMALL_BYTES))
            for _ in mcap_entries(iter([(op, record)]), contents.schemas, contents.channels):
                pass
        else:
            loose = None
        if op == MCAP_CHUNK and not has_ended:
            blocks.append(_mcap_chunk(file, at + 9, length))
        elif op == MCAP_MESSAGE_INDEX and blocks and not has_ended:
            number, table_bytes = struct.unpack("<HI", _exactly(file, 6))
            _count(blocks[-1], number, table_bytes // 16)
        file.seek(at + 9 + length)
    if not has_ended:
        raise DamagedError("its end is missing")
    _start_unknown(blocks)
    return contents


def _mcap_chunk(file: BinaryIO, at: int, length: int) -> Block:
    head = _exactly(file, min(length, MCAP_CHUNK_BYTES + 256))
    if len(head) < MCAP_CHUNK_BYTES:
        raise DamagedError("a chunk is too short")
    start_ns, _, declared, checksum = struct.unpack_from("<QQQI", head)
    compression, after = mcap_string(head, 28)
    (packed,) = struct.unpack("<Q", head[after : after + 8].ljust(8, b"\xff"))
    if after + 8 + packed > length:
        raise DamagedError("a chunk is longer than its record")
    return Block(at + after + 8, packed, start_ns, None, compression, declared, checksum)


def _loose(blocks: list[Block], block: Block | None, at: int, end: int, bag_ns: int) -> Block:
    """The block that a message outside chunks belongs to: the last one while it is short."""
    if block is None or end - block.at > _LOOSE_BYTES:
        block = Block(at, 0, bag_ns)
        blocks.append(block)
    block.size = end - block.at
    block.start_ns = min(block.start_ns, bag_ns)
    return block


def _count(block: Block, channel: int, more: int = 1) -> None:
    if block.counts is None:
        block.counts = Counter()
    block.counts[channel] += more


def _start_unknown(blocks: list[Block]) -> None:
    """Chunks without an index of their own are read after those before them in the file."""
    start_ns = 0
    for block in blocks:
        if block.start_ns == _LATEST_NS:
            block.start_ns = start_ns
        start_ns = max(start_ns, block.start_ns)


def _exactly(file: BinaryIO, count: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise DamagedError("it is cut off")
    return data


def _sized(file: BinaryIO, form: str) -> bytes:
    (count,) = struct.unpack(form, _exactly(file, struct.calcsize(form)))
    if count > _MOST_SMALL_BYTES:
        raise DamagedError("a record's header is damaged")
    return _exactly(file, count)


def _number(header: dict[str, bytes], name: str) -> int:
    if name not in header:
        raise DamagedError(f"a record has no {name}")
    return int.from_bytes(header[name][:8], "little")


def _ros1_time(header: dict[str, bytes]) -> int:
    stamp = header.get("time", b"")
    if len(stamp) != 8:
        raise DamagedError("a message has no time")
    sec, nanosec = struct.unpack("<II", stamp)
    return int(sec) * 10**9 + int(nanosec)
