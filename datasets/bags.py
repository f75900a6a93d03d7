"""Bags as recordings: ROS 1 .bag, ROS 2 folders, .db3 and .mcap, whole or split."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from datasets.bag_images import Arriving, CameraClocks, ImageStore, WaitingImage
from datasets.bag_layout import BagLayout, TfPoses, TopicPoses, survey
from datasets.bag_messages import (
    LASER_SCAN,
    POSE_TYPES,
    RosMessage,
    framed_pose,
    scan,
    stamp_ns,
)
from datasets.bag_records import RawMessage
from datasets.bag_source import BagSource, CorruptMessageError, decode
from datasets.bag_topics import find_ground_truth
from datasets.calibration_file import read_calibration_file
from datasets.errors import InputError, one_line
from datasets.messages import Array, Message, Odometry
from datasets.options import ReadOptions
from datasets.recording import Calibration
from datasets.tf_tree import frame_name, planar
from datasets.time_order import TimeOrder, cut
from datasets.trajectory import Trajectory
from datasets.unpack import Allowance

SPARE_PIXELS = 300_000_000
"""What a small recording may decode, as in ``unpack.py``: a thousand images of 640 x 480."""


class BagRecording:
    """The lidars, depth cameras, odometry and ground truth of one recording in one or several bags.

    paths : the files of a split bag in any order, or a ROS 2 folder.

    What the bag holds is found out at once (``layout``), so that errors come before a run begins:
    raises InputError where there is no lidar and no depth camera, no such topic, no mounting, or
    damage that was not to be salvaged.
    """

    def __init__(self, paths: Sequence[Path], options: ReadOptions) -> None:
        if not paths:
            raise InputError("no files given", where="recording", remedy="Name at least one bag")
        self._paths = tuple(paths)
        self._options = options
        self._supplied = read_calibration_file(options.calibration)
        self._found: Counter[str] = Counter()
        with self._open(Counter()) as source:
            self._bytes = source.size
            self.layout: BagLayout = survey(source, options, self._supplied, self._found)
        self.name = self._paths[0].stem
        self.calibration = Calibration(dict(self.layout.lidars), dict(self.layout.cameras))
        self.notes: Counter[str] = Counter(self._found)

    def __iter__(self) -> Iterator[Message]:
        self.notes.clear()
        self.notes.update(self._found)
        return self._developed()

    def ground_truth(self) -> Trajectory | None:
        """The pose of the base in the frame of the bag's ground truth; None if it has none."""
        truth = self.layout.ground_truth
        if truth is None:
            return None
        with self._open(Counter()) as source:
            return _trajectory(source, truth)

    def _open(self, notes: Counter[str]) -> BagSource:
        return BagSource(self._paths, salvage=self._options.salvage, notes=notes)

    def _developed(self) -> Iterator[Message]:
        """The messages in order, with images decoded last: they are large, and many are skipped."""
        with ExitStack() as opened:
            cameras = self.layout.cameras
            pixels = Allowance(self._bytes, SPARE_PIXELS).bytes
            images = ImageStore(cameras, lambda name: self._again(name, opened), self.notes, pixels)
            for message in cut(self._in_order(images), self._options):
                if not isinstance(message, WaitingImage):
                    yield message
                elif (image := images.developed(message)) is not None:
                    yield image

    def _again(self, topic: str, opened: ExitStack) -> Iterator[RawMessage]:
        """A topic from its beginning once more, apart from the reading that goes on."""
        return opened.enter_context(self._open(Counter())).messages((topic,))

    def _in_order(self, images: ImageStore) -> Iterator[Arriving]:
        order: TimeOrder[Arriving] = TimeOrder(self.notes)
        layout = self.layout
        clocks = CameraClocks(self.notes, alone=not layout.lidars and layout.odometry is None)
        topics = {*layout.lidars, *layout.cameras}
        if isinstance(layout.odometry, TopicPoses):
            topics.add(layout.odometry.topic.name)
        elif isinstance(layout.odometry, TfPoses):
            topics.update(layout.odometry.topics)
        with self._open(self.notes) as source:
            for raw in source.messages(topics):
                for arriving in self._converted(raw, images):
                    for stream, message in clocks.passed(*arriving, raw.bag_ns):
                        yield from order.push(stream, message)
        for stream, message in clocks.rest():
            yield from order.push(stream, message)
        yield from order.flush()

    def _converted(self, raw: RawMessage, images: ImageStore) -> Iterator[tuple[str, Arriving]]:
        """A raw message as ours, with the name of its stream in the notes."""
        odometry = self.layout.odometry
        if (
            isinstance(odometry, TfPoses)
            and raw.topic in odometry.topics
            and odometry.child.encode() not in raw.data
        ):
            return  # most of tf is about other links: a look at the bytes saves decoding them
        index = images.arrived(raw.topic)
        try:
            message = decode(raw)
        except CorruptMessageError:
            self.notes[f"message of {raw.topic} left out: it can't be decoded"] += 1
            return
        try:
            yield from self._ours(message, raw, index, images)
        except (ValueError, ArithmeticError) as error:  # numbers that no message can have
            reason = one_line(str(error), 100)
            self.notes[f"message of {raw.topic} left out: {reason}"] += 1

    def _ours(
        self, message: RosMessage, raw: RawMessage, index: int, images: ImageStore
    ) -> Iterator[tuple[str, Arriving]]:
        odometry = self.layout.odometry
        if raw.msgtype == LASER_SCAN:
            yield from self._scan(message, raw)
        elif raw.topic in self.layout.cameras:
            stamp = stamp_ns(message, raw.bag_ns, self.notes)
            stamp += self._supplied.camera_clock_offsets_ns.get(raw.topic, 0)
            image = images.waiting(message, raw, stamp_ns=stamp, index=index)
            yield f"image of {raw.topic}", image
        elif isinstance(odometry, TopicPoses):
            yield from self._odometry(message, raw, odometry, raw.topic)
        elif isinstance(odometry, TfPoses):
            for link in message.transforms:
                names = frame_name(link.header.frame_id), frame_name(link.child_frame_id)
                if names == (odometry.parent, odometry.child):
                    stream = f"tf {odometry.parent} -> {odometry.child}"
                    yield from self._odometry(link, raw, odometry, stream)

    def _scan(self, message: RosMessage, raw: RawMessage) -> Iterator[tuple[str, Arriving]]:
        stamp = stamp_ns(message, raw.bag_ns, self.notes)
        found = scan(
            message,
            stamp_ns=stamp + self._supplied.clock_offset_ns(raw.topic),
            lidar=raw.topic,
            masks_rad=self.layout.lidars[raw.topic].masks_rad,
            notes=self.notes,
        )
        if found is not None:
            yield f"scan of {raw.topic}", found

    def _odometry(
        self, message: RosMessage, raw: RawMessage, odometry: TopicPoses | TfPoses, stream: str
    ) -> Iterator[tuple[str, Arriving]]:
        stamp = stamp_ns(message, raw.bag_ns, self.notes)
        try:
            T_odom_child = framed_pose(message).T_parent_child
        except ValueError as error:
            self.notes[f"odometry of {stream} left out: {error}"] += 1
            return
        yield f"odometry of {stream}", Odometry(stamp, planar(T_odom_child @ odometry.T_child_base))


def read_trajectory(path: Path, topic: str | None) -> Trajectory:
    """The poses of a topic of a bag; topic None takes the one whose name says ground truth.

    The poses are of the frame that the topic tells them of. Raises InputError if there is no such
    topic or no pose in it.
    """
    with BagSource((path,), salvage=False, notes=Counter()) as source:
        found = find_ground_truth(source, topic)
        if found is None:
            known = ", ".join(t.name for t in source.of_type(*POSE_TYPES)) or "none"
            raise InputError(
                "no topic is called ground truth",
                where=str(path),
                remedy=f"Name one, as in BAG:TOPIC; topics with poses are: {known}",
            )
        trajectory = _trajectory(source, TopicPoses(found, np.eye(4)))
    if trajectory is None:
        raise InputError(
            "no pose in it can be read",
            where=f"{path}, topic {found.name}",
            remedy="Name another topic, as in BAG:TOPIC",
        )
    return trajectory


def _trajectory(source: BagSource, poses: TopicPoses) -> Trajectory | None:
    """The base by the poses of a topic, ordered, the first of each stamp; None if there is none."""
    by_stamp: dict[int, Array] = {}
    ignored: Counter[str] = Counter()
    for raw in source.messages((poses.topic.name,)):
        try:
            message = decode(raw)
            T_fixed_child = framed_pose(message).T_parent_child
        except (CorruptMessageError, ValueError):
            continue
        T_fixed_base = planar(T_fixed_child @ poses.T_child_base)
        by_stamp.setdefault(stamp_ns(message, raw.bag_ns, ignored), T_fixed_base)
    if not by_stamp:
        return None
    stamps_ns = sorted(by_stamp)
    return Trajectory.from_matrices(stamps_ns, [by_stamp[stamp] for stamp in stamps_ns])
