"""The files of bags, whole and damaged: each one's topics, and its messages in order.

A whole file is read in order of bag time (``bag_index.py``, ``bag_sqlite.py``); a damaged one only
with ``salvage``, record by record (``bag_salvage.py``). Names are made printable here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Final, Protocol

from datasets.bag_index import IndexedFile
from datasets.bag_records import MCAP_MAGIC, ROS1_MAGIC, SQLITE_MAGIC, Channel, RawMessage
from datasets.bag_salvage import Lost, walk_mcap, walk_ros1, walk_sqlite
from datasets.bag_sqlite import Database
from datasets.errors import InputError, one_line, reading
from datasets.unpack import DamagedError, unpack_file
from datasets.yaml_file import MarkedYaml

Walker = Callable[[Path, Collection[str] | None, Lost], Iterator[RawMessage]]

_WALKERS: Final[dict[bytes, Walker]] = {
    ROS1_MAGIC: walk_ros1,
    MCAP_MAGIC: walk_mcap,
    SQLITE_MAGIC: walk_sqlite,
}
_LONGEST_NAME: Final = 200


@dataclass(frozen=True, slots=True, order=True)
class Topic:
    """A topic with messages. msgtype as ROS 2 writes it: `sensor_msgs/msg/LaserScan`."""

    name: str
    msgtype: str
    count: int


class Part(Protocol):
    """One file of a recording. unpacked : closed with it."""

    path: Path
    unpacked: ExitStack

    @property
    def size(self) -> int: ...

    def topics(self) -> list[Topic]: ...

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]: ...

    def close(self) -> None: ...


def magic(path: Path) -> bytes | None:
    """Which kind of bag a file is by its first bytes, one of the ``*_MAGIC``; else None."""
    with path.open("rb") as file:
        start = file.read(max(map(len, _WALKERS)))
    return next((known for known in _WALKERS if start.startswith(known)), None)


@dataclass(slots=True)
class WholePart:
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
class WalkedPart:
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


def open_bag(path: Path, salvage: bool, notes: Counter[str]) -> list[Part]:
    remedy = "Check that it is there and may be read; for a damaged bag, add `--salvage`"
    with reading("the bag can't be read", where=str(path), remedy=remedy):
        if path.is_dir():
            return _open_folder(path, salvage, notes)
        return [_open_file(path, salvage, notes)]


def _open_folder(path: Path, salvage: bool, notes: Counter[str]) -> list[Part]:
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
    parts: list[Part] = []
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


def _open_file(path: Path, salvage: bool, notes: Counter[str]) -> Part:
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
        return WalkedPart(path, kind, notes)
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
    return WholePart(path, indexed, indexed.counts, indexed.channels, notes)


def _open_database(path: Path, notes: Counter[str]) -> WholePart:
    database = Database(path, salvage=False)
    try:
        return WholePart(path, database, database.counts(), database.channels(), notes)
    except BaseException:
        database.close()
        raise


def _open_packed(path: Path, salvage: bool, notes: Counter[str]) -> Part:
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
