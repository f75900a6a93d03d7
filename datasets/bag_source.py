"""A bag as one stream: the messages of its files, in order of bag time.

What comes out of the files (``bag_parts.py``) is checked here: bag times are times, a topic has one
type, and what recorders compressed message by message is unpacked.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from datasets.bag_parts import Part, Topic, WholePart, open_bag
from datasets.bag_records import RawMessage
from datasets.errors import InputError, one_line
from datasets.unpack import ZSTD_MAGIC, Allowance, unpack

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_ROS1_ALIASES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
_LATEST_NS: Final = 2**63


class CorruptMessageError(Exception):
    """One message that is not of its type; what follows it may be good."""


class BagSource:
    """The raw messages of one recording in one or several bags; a context manager.

    paths : files of one recording in any order, or ROS 2 folders.
    notes : counts what could not be read.

    Raises InputError where nothing can be read, or, without ``salvage``, if a file is damaged.
    """

    def __init__(self, paths: Sequence[Path], *, salvage: bool, notes: Counter[str]) -> None:
        self.where = ", ".join(str(path) for path in paths)
        self._notes = notes
        self._parts: list[Part] = []
        try:
            for path in paths:
                self._parts.extend(open_bag(path, salvage, notes))
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

    def _until_damage(self, part: Part, topics: Collection[str]) -> Iterator[RawMessage]:
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
            if isinstance(part, WholePart):
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


def _merged(listings: Iterator[list[Topic]]) -> dict[str, Topic]:
    """Topics over all parts by name, with their counts added up; empty ones are left out."""
    merged: dict[str, Topic] = {}
    for topic in sorted(topic for listing in listings for topic in listing if topic.count):
        seen = merged.get(topic.name)
        if seen is None or seen.msgtype == topic.msgtype:
            count = topic.count + (seen.count if seen else 0)
            merged[topic.name] = replace(topic, count=count)
    return merged
