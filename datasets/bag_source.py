"""Opening bags: ROS 1 files, ROS 2 folders and bare .db3 and .mcap files, as one stream.

A whole file is read in order of bag time (``bag_index.py``, ``bag_sqlite.py``); a damaged one only
with ``salvage``, record by record (``bag_salvage.py``). What comes out of them is checked here:
names are printable, bag times are times, and what recorders compressed message by message is
unpacked.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Protocol, Self

from datasets.bag_index import IndexedFile
from datasets.bag_records import (
    MCAP_MAGIC,
    ROS1_MAGIC,
    SQLITE_MAGIC,
    Channel,
    RawMessage,
)
from datasets.bag_salvage import Lost, walk_mcap, walk_ros1, walk_sqlite
from datasets.bag_sqlite import Database
from datasets.errors import InputError, one_line, reading
from datasets.unpack import ZSTD_MAGIC, Allowance, DamagedError, unpack, unpack_file
from datasets.yaml_file import MarkedYaml

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Walker = Callable[[Path, Collection[str] | None, Lost], Iterator[RawMessage]]

_WALKERS: Final[dict[bytes, Walker]] = {
    ROS1_MAGIC: walk_ros1,
    MCAP_MAGIC: walk_mcap,
    SQLITE_MAGIC: walk_sqlite,
}
_ROS1_ALIASES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
_LONGEST_NAME: Final = 200
_LATEST_NS: Final = 2**63


@dataclass(frozen=True, slots=True, order=True)
class Topic:
    """A topic with messages. msgtype as ROS 2 writes it: `sensor_msgs/msg/LaserScan`."""

    name: str
    msgtype: str
    count: int


class CorruptMessageError(Exception):
    """One message that is not of its type; what follows it may be good."""


class _Part(Protocol):
    """One file of a recording. unpacked : closed with it."""

    path: Path
    unpacked: ExitStack

    @property
    def size(self) -> int: ...

    def topics(self) -> list[Topic]: ...

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]: ...

    def close(self) -> None: ...


class BagSource:
    """The raw messages of one recording in one or several bags; a context manager.

    paths : files of one recording in any order, or ROS 2 folders.
    notes : counts what could not be read.

    Raises InputError where nothing can be read, or, without ``salvage``, if a file is damaged.
    """

    def __init__(self, paths: Sequence[Path], *, salvage: bool, notes: Counter[str]) -> None:
        self.where = ", ".join(str(path) for path in paths)
        self._notes = notes
        self._parts: list[_Part] = []
        try:
            for path in paths:
                self._parts.extend(_open(path, salvage, notes))
            self.topics = _merged(part.topics() for part in self._parts)
            if not self.topics:
                told = f" ({'; '.join(notes)})" if notes else ""
                raise InputError(
                    f"no message in the bag can be read{told}" if salvage else "the bag is empty",
                    where=self.where,
                    remedy="Record it again; there is nothing here to work with",
                )
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        for part in self._parts:
            part.close()
        self._parts.clear()

    @property
    def size(self) -> int:
        """Bytes of all its files."""
        return sum(part.size for part in self._parts)

    def of_type(self, *msgtypes: str) -> list[Topic]:
        """The topics of these types, by name."""
        return [topic for topic in self.topics.values() if topic.msgtype in msgtypes]

    def listing(self) -> str:
        """Topics and types for an error message."""
        return ", ".join(f"{topic.name} ({topic.msgtype})" for topic in self.topics.values())

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of these topics by bag time, as far as each file keeps to it."""
        streams = [self._until_damage(part, topics) for part in self._parts]
        return heapq.merge(*streams, key=lambda message: message.bag_ns)

    def _until_damage(self, part: _Part, topics: Collection[str]) -> Iterator[RawMessage]:
        """A part's messages as far as they can be had; the one place where reading may fail."""
        allowance = Allowance(part.size)
        try:
            for message in part.messages(topics):
                if message.msgtype != self.topics[message.topic].msgtype:
                    self._notes[f"message of {message.topic} left out: it is of another type"] += 1
                elif not 0 <= message.bag_ns < _LATEST_NS:
                    self._notes[f"message of {message.topic} left out: its bag time is none"] += 1
                elif message.data[:4] == ZSTD_MAGIC and message.encoding != "ros1":
                    data = unpack("zstd", message.data, None, allowance)
                    yield message._replace(data=data)
                else:
                    yield message
        except Exception as error:  # a parser trips over what nobody thought of
            reason = one_line(str(error), 100) or type(error).__name__
            note = f"{part.path.name} ends early, it is damaged ({reason})"
            if isinstance(part, _WholePart):
                note += "; `--salvage` may read more"
            self._notes[note] = 1


def decode(message: RawMessage) -> Any:  # noqa: ANN401 - rosbags makes the classes at run time
    """The message as rosbags' class of its type, known from ROS's standard definitions.

    Raises CorruptMessageError.
    """
    try:
        if message.encoding == "ros1":
            msgtype = _ROS1_ALIASES.get(message.msgtype, message.msgtype)
            return _typestore("ros1").deserialize_ros1(message.data, msgtype)
        return _typestore("cdr").deserialize_cdr(message.data, message.msgtype)
    except Exception as error:  # struct, index, unicode, assertion errors: all mean the same
        raise CorruptMessageError(f"{message.topic}: {error}") from error


@lru_cache(maxsize=2)
def _typestore(encoding: str) -> Typestore:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    if encoding != "ros1":
        return get_typestore(Stores.LATEST)
    return ros1_typestore()


def ros1_typestore() -> Typestore:
    """The messages of ROS 1, and tf's, which rosbags leaves out of them."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS1_NOETIC)
    tf = "geometry_msgs/TransformStamped[] transforms"
    store.register(get_types_from_msg(tf, "tf2_msgs/msg/TFMessage"))
    return store


def magic(path: Path) -> bytes | None:
    """Which kind of bag a file is by its first bytes, one of the ``*_MAGIC``; else None."""
    with path.open("rb") as file:
        start = file.read(max(map(len, _WALKERS)))
    return next((known for known in _WALKERS if start.startswith(known)), None)


@dataclass(slots=True)
class _WholePart:
    """A file that is whole, or a file that one unpacked to. unpacked : where it lies then."""

    path: Path
    content: IndexedFile | Database
    counts: Counter[int]
    channels: dict[int, Channel]
    notes: Counter[str]
    unpacked: ExitStack = field(default_factory=ExitStack)

    @property
    def size(self) -> int:
        return self.path.stat().st_size

    def topics(self) -> list[Topic]:
        return [
            Topic(_name(channel.topic), _printable(channel.msgtype), self.counts[number])
            for number, channel in self.channels.items()
        ]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        wanted = {
            number: Channel(_name(channel.topic), _printable(channel.msgtype), channel.encoding)
            for number, channel in self.channels.items()
            if _name(channel.topic) in topics
        }
        if wanted:
            for number, bag_ns, data in self.content.entries(wanted.keys()):
                yield RawMessage(*wanted[number], bag_ns, data)
            if isinstance(self.content, Database) and self.content.unreadable:
                self.notes[f"{self.path.name}: rows left out that are no messages"] = 1

    def close(self) -> None:
        if isinstance(self.content, Database):
            self.content.close()
        self.unpacked.close()


@dataclass(slots=True)
class _WalkedPart:
    """A file that is read from its beginning to where it breaks off."""

    path: Path
    magic: bytes
    notes: Counter[str]
    unpacked: ExitStack = field(default_factory=ExitStack)

    @property
    def size(self) -> int:
        return self.path.stat().st_size

    def topics(self) -> list[Topic]:
        counts: Counter[tuple[str, str]] = Counter()
        lost: list[str] = []
        try:
            for message in _WALKERS[self.magic](self.path, None, lost.append):
                counts[_name(message.topic), _printable(message.msgtype)] += 1
        except Exception as error:  # as in reading, where it is told again
            lost.append(one_line(str(error), 100))
        if not counts:
            self.notes.update(lost)
        return [Topic(*key, count) for key, count in counts.items()]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        for message in _WALKERS[self.magic](self.path, None, self._lost):
            topic = _name(message.topic)
            if topic in topics:
                yield message._replace(topic=topic, msgtype=_printable(message.msgtype))

    def _lost(self, note: str) -> None:
        self.notes[note] += 1

    def close(self) -> None:
        self.unpacked.close()


@lru_cache(maxsize=4096)
def _name(topic: str) -> str:
    """A topic's name as it is shown and chosen: with a slash before it, printable."""
    topic = _printable(topic)
    return topic if topic.startswith("/") else f"/{topic}"


@lru_cache(maxsize=4096)
def _printable(name: str) -> str:
    return one_line(name, _LONGEST_NAME)


def _merged(listings: Iterator[list[Topic]]) -> dict[str, Topic]:
    """Topics over all parts by name, with their counts added up; empty ones are left out."""
    merged: dict[str, Topic] = {}
    for topic in sorted(topic for listing in listings for topic in listing if topic.count):
        seen = merged.get(topic.name)
        if seen is None or seen.msgtype == topic.msgtype:
            count = topic.count + (seen.count if seen else 0)
            merged[topic.name] = replace(topic, count=count)
    return merged


def _open(path: Path, salvage: bool, notes: Counter[str]) -> list[_Part]:
    remedy = "Check that it is there and may be read; for a damaged bag, add `--salvage`"
    with reading("the bag can't be read", where=str(path), remedy=remedy):
        if path.is_dir():
            return _open_folder(path, salvage, notes)
        return [_open_file(path, salvage, notes)]


def _open_folder(path: Path, salvage: bool, notes: Counter[str]) -> list[_Part]:
    """A ROS 2 bag by its metadata.yaml, or by the files in it if a killed recorder left none."""
    try:
        files = _listed_files(path)
    except (DamagedError, InputError) as error:
        reason = error.what if isinstance(error, InputError) else str(error)
        endings = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
        files = sorted(file for file in path.iterdir() if file.name.endswith(endings))
        if not files:
            raise InputError(
                f"not a ROS 2 bag ({reason})",
                where=str(path),
                remedy="Give a folder that holds .mcap or .db3 files",
            ) from error
        if not salvage:
            notes[f"{path.name}: read file by file, {reason}"] = 1
    parts: list[_Part] = []
    try:
        for file in files:
            parts.append(_open_file(file, salvage, notes))
    except BaseException:
        for part in parts:
            part.close()
        raise
    return parts


def _listed_files(path: Path) -> list[Path]:
    """The files that metadata.yaml names. Raises DamagedError or InputError if it can't be used."""
    if not (path / "metadata.yaml").exists():
        raise DamagedError("it has no metadata.yaml")
    content = MarkedYaml.read(path / "metadata.yaml", "metadata.yaml", "", "").content
    for key in ("rosbag2_bagfile_information", "relative_file_paths"):
        content = content.get(key) if isinstance(content, dict) else None
    if not (content and isinstance(content, list) and all(isinstance(n, str) for n in content)):
        raise DamagedError("its metadata.yaml names no files")
    files = [path / PurePath(name.replace("\0", "")).name for name in dict.fromkeys(content)]
    for file in files:
        if not file.is_file():
            raise DamagedError(f"{file.name} is missing")
    return files


def _open_file(path: Path, salvage: bool, notes: Counter[str]) -> _Part:
    kind = magic(path)
    if kind is None and path.suffix == ".zstd":
        return _open_packed(path, salvage, notes)
    if kind is None:
        empty = path.stat().st_size == 0
        raise InputError(
            "the file is empty" if empty else "not a bag, its first bytes are of another kind",
            where=str(path),
            remedy="Bags are ROS 1 .bag (format 2.0), ROS 2 .db3 and .mcap files",
        )
    if salvage:
        return _WalkedPart(path, kind, notes)
    try:
        if kind == SQLITE_MAGIC:
            return _open_database(path, notes)
        indexed = IndexedFile(path, kind)
    except DamagedError as error:
        raise InputError(
            f"the bag is truncated or damaged, or was never indexed because its recorder was "
            f"killed ({error})",
            where=str(path),
            remedy="Add `--salvage` to read what is readable",
        ) from error
    return _WholePart(path, indexed, indexed.counts, indexed.channels, notes)


def _open_database(path: Path, notes: Counter[str]) -> _WholePart:
    database = Database(path, salvage=False)
    try:
        return _WholePart(path, database, database.counts(), database.channels(), notes)
    except BaseException:
        database.close()
        raise


def _open_packed(path: Path, salvage: bool, notes: Counter[str]) -> _Part:
    """A file that rosbag2 compressed as a whole when it was done with it."""
    with ExitStack() as unpacked:
        target = Path(unpacked.enter_context(TemporaryDirectory())) / path.stem
        try:
            unpack_file(path, target)
        except DamagedError as error:
            if not salvage:
                raise InputError(
                    f"the bag is damaged ({error})",
                    where=str(path),
                    remedy="Add `--salvage` to read what is readable",
                ) from error
            notes[f"{path.name}: {error}"] = 1
        part = _open_file(target, salvage, notes)
        part.unpacked = unpacked.pop_all()
    return part
