"""Simulated drives as bags that any ROS tool reads: MCAP files, ROS 2 folders, ROS 1 .bag files.

A bag is written into a hidden folder beside its place and moved there when it is whole. Whatever
happens before, a full disk or Ctrl-C, leaves nothing behind. The same drive gives the same bytes,
whatever the bag is called.
"""

from __future__ import annotations

import os
import secrets
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

from datasets.bag_source import ros1_typestore
from datasets.errors import InputError
from datasets.simulation.driver_messages import DriverMessage
from datasets.simulation.ros_messages import TF_STATIC, Published, RosMessages
from datasets.simulation.simulated_drive import SimulatedDrive

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_Writer = Any  # those of rosbags for ROS 1 and ROS 2 have no type in common
Kind = Literal["mcap", "folder", "ros1"]
KINDS: dict[str, Kind] = {".mcap": "mcap", "": "folder", ".bag": "ros1"}

PROGRESS_NS = 500_000_000
"""How often the progress is told, in time of the drive."""

MESSAGE_OVERHEAD = 47
"""Bytes that a message takes in MCAP besides its own: a record's head, a place in the index."""

SAMPLED_IMAGES, SAMPLED_MESSAGES = 4, 600
"""What an estimate looks at: images along the drive, and the first of all other messages."""


@dataclass(frozen=True, slots=True)
class Written:
    """messages : how many, by topic."""

    path: Path
    size_bytes: int
    messages: Counter[str]


class Estimate(NamedTuple):
    """How large a bag becomes, and how long it takes to write it."""

    size_bytes: int
    duration_s: float


def write_bag(
    drive: SimulatedDrive,
    path: Path,
    *,
    raw_depth: bool = False,
    force: bool = False,
    progress: Callable[[float], None] = lambda driven_s: None,
) -> Written:
    """Write a drive as a bag, by the ending of its path (``KINDS``).

    raw_depth : images as 16UC1 instead of compressedDepth.
    force     : replace a bag of the same name.
    progress  : is told up to what time of the drive the bag is written.

    Raises InputError as ``check_target``, and where the bag can't be written to the end.
    """
    check_target(path, force=force)
    counts: Counter[str] = Counter()
    with _whole(path, drive.name) as staging, _Bag(staging, drive, _kind(path), raw_depth) as bag:
        told_ns = drive.start_ns
        for raw in drive.driver_messages():
            counts.update(bag.write(raw))
            if raw.published_ns - told_ns >= PROGRESS_NS:
                told_ns = raw.published_ns
                progress((told_ns - drive.start_ns) * 1e-9)
    size = sum(file.stat().st_size for file in path.rglob("*")) if path.is_dir() else None
    return Written(path, path.stat().st_size if size is None else size, counts)


def check_target(path: Path, *, force: bool) -> None:
    """Raise InputError if no bag can be written there: before anything is simulated."""
    kind = _kind(path)
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(
            "nothing can be written in that folder" if path.parent.is_dir() else "no such folder",
            where=str(path),
            remedy=f"Make {path.parent}, or give a path in a folder where you may write",
        )
    if path.exists() or path.is_symlink():
        if not force:
            raise InputError(
                "this exists already",
                where=str(path),
                remedy="Give another path, or --force to replace it",
            )
        if path.is_dir() != (kind == "folder") or (
            kind == "folder" and not (path / "metadata.yaml").is_file()
        ):
            raise InputError(
                "this is no bag of that kind, it is not replaced",
                where=str(path),
                remedy="Give another path, or remove it yourself",
            )


def check_room(path: Path, size_bytes: int) -> None:
    """Raise InputError if the disk has less room than a bag will need."""
    free = shutil.disk_usage(path.parent).free
    if size_bytes > free:
        raise InputError(
            f"the bag needs about {size_bytes / 1e6:.0f} MB, there are {free / 1e6:.0f} MB free",
            where=str(path),
            remedy="Make room, give a path on another disk, or take fewer or smaller depth images",
        )


def estimate(drive: SimulatedDrive, *, raw_depth: bool = False) -> Estimate:
    """What writing a drive comes to, from a few of its images and the first of its messages."""
    store = _typestore("mcap")
    ros = RosMessages(store, drive.robot, raw_depth=raw_depth)

    def cost(messages: Iterable[DriverMessage]) -> Estimate:
        begun_s, size = time.perf_counter(), 0
        for raw in messages:
            for topic_message in ros.of(raw):
                data = store.serialize_cdr(topic_message.message, topic_message.msgtype)
                size += len(data) + MESSAGE_OVERHEAD
        return Estimate(size, time.perf_counter() - begun_s)

    first = list(islice(drive.driver_messages(images=False), SAMPLED_MESSAGES))
    sampled_s = max((first[-1].published_ns - drive.start_ns) * 1e-9, 1e-3)
    cost(first)  # the first time there are things to be imported, compiled and built
    costs = [cost(islice(drive.driver_messages(images=False), SAMPLED_MESSAGES))]
    shares = [drive.drive.duration_s / sampled_s]
    for topic in drive.robot.cameras:
        if not (count := drive.image_count(topic)):
            continue
        looked_at = range(0, count, -(-count // SAMPLED_IMAGES))
        cost([drive.image(topic, 0)])
        costs.append(cost(drive.image(topic, index) for index in looked_at))
        shares.append(count / len(looked_at))
    size = sum(c.size_bytes * share for c, share in zip(costs, shares, strict=True))
    duration_s = sum(c.duration_s * share for c, share in zip(costs, shares, strict=True))
    return Estimate(round(size), duration_s)


class _Bag:
    """An open bag of rosbags, in a folder of its own; closed whole, or broken off by an error."""

    def __init__(self, folder: Path, drive: SimulatedDrive, kind: Kind, raw_depth: bool) -> None:
        self._kind = kind
        self._store = _typestore(kind)
        self._ros = RosMessages(self._store, drive.robot, raw_depth=raw_depth)
        self._start_ns = drive.start_ns
        self._writer = _writer(folder, drive.name, kind)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> Self:
        self._writer.__enter__()
        self._add(self._ros.mountings(self._start_ns), self._start_ns)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._writer.__exit__(exc_type, exc, traceback)

    def write(self, raw: DriverMessage) -> Iterator[str]:
        """Gives the topics on which something was published."""
        for published in self._ros.of(raw):
            self._add(published, raw.published_ns)
            yield published.topic

    def _add(self, published: Published, at_ns: int) -> None:
        topic, msgtype, message = published
        if topic not in self._connections:
            more = _latched(self._kind) if topic == TF_STATIC else {}
            self._connections[topic] = self._writer.add_connection(
                topic, msgtype, typestore=self._store, **more
            )
        ros1 = self._kind == "ros1"
        serialize = self._store.serialize_ros1 if ros1 else self._store.serialize_cdr
        self._writer.write(self._connections[topic], at_ns, serialize(message, msgtype))


def _kind(path: Path) -> Kind:
    kind = KINDS.get(path.suffix.lower())
    if kind is None or not path.name:
        raise InputError(
            f"no kind of bag ends in {path.suffix}" if path.name else "this is no name for a bag",
            where=str(path),
            remedy="End it in .mcap (ROS 2), .bag (ROS 1), or in nothing for a ROS 2 folder",
        )
    return kind


def _typestore(kind: Kind) -> Typestore:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    return ros1_typestore() if kind == "ros1" else get_typestore(Stores.ROS2_JAZZY)


def _writer(folder: Path, name: str, kind: Kind) -> _Writer:
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415

    if kind == "ros1":
        return rosbag1.Writer(folder / name)
    # 8 is what all of ROS 2 since Humble can play.
    return rosbag2.Writer(folder / name, version=8, storage_plugin=rosbag2.StoragePlugin.MCAP)


def _latched(kind: Kind) -> dict[str, Any]:
    """So that whoever listens later hears it as well."""
    if kind == "ros1":
        return {"latching": 1}
    from rosbags.interfaces import (  # noqa: PLC0415
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    for_ever = QosTime(9223372036, 854775807)
    qos = Qos(
        history=QosHistory.KEEP_LAST,
        depth=1,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL,
        deadline=for_ever,
        lifespan=for_ever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=for_ever,
        avoid_ros_namespace_conventions=False,
    )
    return {"offered_qos_profiles": [qos]}


@contextmanager
def _whole(path: Path, name: str) -> Iterator[Path]:
    """Give a folder for a bag called ``name``, and move the bag to ``path`` when it is whole."""
    staging = path.with_name(f".{path.name}.writing-{secrets.token_hex(4)}")
    made = staging / name
    try:
        staging.mkdir()
        yield staging
        if _kind(path) == "mcap":
            made = made / f"{name}.mcap"
        _sync(made)
        before = staging / ".old"
        if path.is_dir():
            os.rename(path, before)
        try:
            os.replace(made, path)
        except BaseException:
            if before.exists():
                os.rename(before, path)
            raise
    except OSError as error:
        raise InputError(
            f"the bag can't be written ({error.strerror or error})",
            where=str(path),
            remedy="Make room, or give a path on another disk where you may write",
        ) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _sync(made: Path) -> None:
    for file in sorted(made.iterdir()) if made.is_dir() else [made]:
        with file.open("rb") as handle:
            os.fsync(handle)
