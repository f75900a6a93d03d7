"""Opening bags: ROS 1 files, ROS 2 folders and bare .db3 and .mcap files, as one stream.

A whole file is read through rosbags, by its index; a damaged one only with ``salvage``, record by
record (``bag_salvage.py``).
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

from datasets.bag_salvage import (
    MCAP_MAGIC,
    ROS1_MAGIC,
    SQLITE_MAGIC,
    RawMessage,
    walk_mcap,
    walk_ros1,
    walk_sqlite,
)
from datasets.errors import InputError

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

_WALKERS = {ROS1_MAGIC: walk_ros1, MCAP_MAGIC: walk_mcap, SQLITE_MAGIC: walk_sqlite}
_ROS1_ALIASES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}


@dataclass(frozen=True, slots=True, order=True)
class Topic:
    """A topic with messages. msgtype as ROS 2 writes it: `sensor_msgs/msg/LaserScan`."""

    name: str
    msgtype: str
    count: int


class CorruptMessageError(Exception):
    """One message that is not of its type; what follows it may be good."""


class _Part(Protocol):
    """One file or folder of a recording."""

    path: Path

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
                raise InputError(
                    "no message in the bag can be read" if salvage else "the bag is empty",
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
        try:
            yield from part.messages(topics)
        except Exception as error:  # rosbags lets out whatever its parsing trips over
            reason = str(error) or type(error).__name__
            note = f"{part.path.name} ends early, it is damaged ({reason})"
            if isinstance(part, _IndexedPart):
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
class _IndexedPart:
    """A file or folder that rosbags can open."""

    path: Path
    reader: Reader1 | Reader2
    encoding: str

    def topics(self) -> list[Topic]:
        connections = self.reader.connections
        return [Topic(_slash(c.topic), c.msgtype, c.msgcount) for c in connections]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        connections = [c for c in self.reader.connections if _slash(c.topic) in topics]
        if not connections:
            return
        for connection, bag_ns, data in self.reader.messages(connections=connections):
            topic = _slash(connection.topic)
            yield RawMessage(topic, connection.msgtype, self.encoding, bag_ns, data)

    def close(self) -> None:
        with suppress(Exception):  # nothing was written: there is nothing to lose
            self.reader.close()


@dataclass(slots=True)
class _WalkedPart:
    """A file that is read from its beginning to where it breaks off."""

    path: Path
    magic: bytes
    notes: Counter[str]

    def topics(self) -> list[Topic]:
        counts: Counter[tuple[str, str]] = Counter()
        with suppress(Exception):  # told of when the messages are read
            for message in _WALKERS[self.magic](self.path, None, lambda note: None):
                counts[_slash(message.topic), message.msgtype] += 1
        return [Topic(*key, count) for key, count in counts.items()]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        # A topic may be written without its slash, but never in both ways.
        both = {*topics, *(topic.removeprefix("/") for topic in topics)}
        for message in _WALKERS[self.magic](self.path, both, self._lost):
            yield message._replace(topic=_slash(message.topic))

    def _lost(self, note: str) -> None:
        self.notes[note] += 1

    def close(self) -> None:
        pass


def _slash(topic: str) -> str:
    return topic if topic.startswith("/") else f"/{topic}"


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
    try:
        if path.is_dir():
            return _open_folder(path, salvage, notes)
        return [_open_file(path, salvage, notes)]
    except OSError as error:
        raise InputError(
            f"the bag can't be read ({error.strerror})",
            where=str(path),
            remedy="Check that it is there and may be read",
        ) from error


def _open_folder(path: Path, salvage: bool, notes: Counter[str]) -> list[_Part]:
    """A ROS 2 bag by its metadata.yaml, or by the files in it if a killed recorder left none."""
    reason = "it has no metadata.yaml"
    if (path / "metadata.yaml").exists():
        opened = _indexed(path, "cdr")
        if isinstance(opened, _IndexedPart):
            # What rosbag2 compressed itself can't be walked through.
            if not salvage or getattr(opened.reader, "compression_mode", None):
                return [opened]
            opened.close()
        reason = str(opened)
    files = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    if not files:
        raise InputError(
            f"not a ROS 2 bag ({reason})",
            where=str(path),
            remedy="Give a folder that holds .mcap or .db3 files",
        )
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


def _open_file(path: Path, salvage: bool, notes: Counter[str]) -> _Part:
    kind = magic(path)
    if kind is None:
        empty = path.stat().st_size == 0
        raise InputError(
            "the file is empty" if empty else "not a bag, its first bytes are of another kind",
            where=str(path),
            remedy="Bags are ROS 1 .bag (format 2.0), ROS 2 .db3 and .mcap files",
        )
    if salvage:
        return _WalkedPart(path, kind, notes)
    opened = _indexed(path, "ros1" if kind == ROS1_MAGIC else "cdr")
    # A whole MCAP may be of a kind that rosbags doesn't take: another profile, foreign schemas,
    # or without chunks and then not in order of time.
    foreign = kind == MCAP_MAGIC and _is_complete_mcap(path)
    if isinstance(opened, _IndexedPart):
        storage: Any = getattr(opened.reader, "storage", None)
        if not foreign or storage.chunks:
            return opened
        opened.close()
    if foreign:
        return _WalkedPart(path, kind, notes)
    raise InputError(
        f"the bag is truncated, or was never indexed because its recorder was killed ({opened})",
        where=str(path),
        remedy="Add `--salvage` to read what is readable",
    )


def _indexed(path: Path, encoding: str) -> _IndexedPart | Exception:
    """The bag opened by rosbags, or why it can't be."""
    reader: Reader1 | Reader2
    try:
        if encoding == "ros1":
            from rosbags.rosbag1 import Reader as Ros1Reader  # noqa: PLC0415

            reader = Ros1Reader(path)
        else:
            from rosbags.rosbag2 import Reader as Ros2Reader  # noqa: PLC0415

            reader = Ros2Reader(path)
        reader.open()
    except OSError:
        raise
    except Exception as error:  # rosbags lets out whatever its parsing trips over
        return error
    return _IndexedPart(path, reader, encoding)


def _is_complete_mcap(path: Path) -> bool:
    if path.stat().st_size < 2 * len(MCAP_MAGIC):
        return False
    with path.open("rb") as file:
        file.seek(-len(MCAP_MAGIC), 2)
        return file.read() == MCAP_MAGIC
