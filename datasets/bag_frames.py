"""Frames of a bag: how much of tf to read, which frame is the base, how lidars stand on it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from datasets.bag_cameras import CameraTopic
from datasets.bag_messages import TF_TYPES, framed_pose
from datasets.bag_records import RawMessage
from datasets.bag_source import BagSource, CorruptMessageError, decode
from datasets.bag_topics import LidarTopic
from datasets.bounds import FARTHEST_MOUNTING_M, within
from datasets.calibration_file import CalibrationFile
from datasets.errors import InputError
from datasets.messages import Array
from datasets.recording import LidarCalibration
from datasets.tf_tree import TfTree

TF_WAIT_NS = 60_000_000_000
"""How long after the first message of the last sensor tf may still come."""

TF_WATCH_NS = 2_000_000_000
"""How long tf is watched, once everything is connected, for mountings that move."""

BASE_NAMES = ("base_footprint", "base_link", "base")
_ODOM = re.compile(r"(?i)(^|[/_])odom")
_FIXED = re.compile(r"(?i)(^|[/_])(odom\w*|map|world|earth|utm)$")


def tf_topics(source: BagSource) -> tuple[list[str], list[str]]:
    """The topics of transforms, (static, moving)."""
    names = [topic.name for topic in source.of_type(*TF_TYPES)]
    static = [name for name in names if "static" in name.rpartition("/")[2]]
    return static, [name for name in names if name not in static]


def read_tf(
    source: BagSource,
    sensors: Sequence[LidarTopic | CameraTopic],
    odometry_child: str,
    notes: Counter[str],
) -> TfTree:
    """tf_static whole, and of tf as much as connects the sensors with each other and with odom."""
    tree = TfTree()
    static, moving = tf_topics(source)
    for raw in source.messages(static):
        add_transforms(tree, raw, notes)
    frames = [sensor.frame for sensor in sensors]
    if _connected(tree, frames, odometry_child):
        return tree
    until_ns, connected = max(each.first_bag_ns for each in sensors) + TF_WAIT_NS, False
    for raw in source.messages(moving):
        if raw.bag_ns > until_ns:
            break
        known = len(tree.edges)
        add_transforms(tree, raw, notes)
        if not connected and len(tree.edges) > known:
            connected = _connected(tree, frames, odometry_child)
            until_ns = raw.bag_ns + TF_WATCH_NS if connected else until_ns
    return tree


def add_transforms(tree: TfTree, raw: RawMessage, notes: Counter[str]) -> None:
    """Put the transforms of a tf message into the tree; what is no transform is counted."""
    try:
        message = decode(raw)
    except CorruptMessageError:
        notes[f"message of {raw.topic} left out: it can't be decoded"] += 1
        return
    for link in message.transforms:
        try:
            tree.add(*framed_pose(link))
        except ValueError as error:
            notes[f"transform of {raw.topic} left out: {error}"] += 1


def _connected(tree: TfTree, frames: Sequence[str], odometry_child: str) -> bool:
    first = frames[0]
    if any(tree.path(first, frame) is None for frame in frames):
        return False
    if odometry_child:
        return tree.path(first, odometry_child) is not None
    return odometry_link(tree, first) is not None


def odometry_link(tree: TfTree, frame: str) -> tuple[str, str] | None:
    """The link (odom, child) above or at a frame; None if no frame there is called odom."""
    chain = tree.upwards(frame)
    links = zip(chain[1:], chain, strict=False)
    return next((link for link in links if _ODOM.search(link[0])), None)


def choose_base(tree: TfTree, sensor_frames: Sequence[str], odometry_child: str) -> str:
    """The frame that stands for the robot; "" if there is nothing to tell it from.

    What odometry moves, if it is connected with the sensors; else the frame that tf hangs on odom;
    else one with a usual name; else the highest that carries the sensors without moving.
    """
    known = [frame for frame in sensor_frames if frame in tree]
    if not known:
        return odometry_child
    chains = [tree.upwards(frame) for frame in known]
    carrying = [f for f in chains[0] if all(f in chain for chain in chains)] or chains[0]
    carrying = [frame for frame in carrying if not _FIXED.search(frame)] or [known[0]]
    usual = next((name for name in BASE_NAMES if name in carrying), None)
    if odometry_child and tree.path(known[0], odometry_child) is not None:
        # Visual odometry may move a camera: the base is a better frame where both are known.
        return odometry_child if usual is None or "base" in odometry_child else usual
    link = odometry_link(tree, known[0])
    if link is not None and link[1] in carrying:
        return link[1]
    if usual is not None:
        return usual
    rigid = [frame for frame in carrying if not tree.moves(frame, known[0])]
    return rigid[-1] if rigid else known[0]


def mounting(
    lidar: LidarTopic,
    base: str,
    tree: TfTree,
    supplied: CalibrationFile,
    *,
    alone: bool,
    where: str,
    notes: Counter[str],
) -> LidarCalibration:
    """Where a lidar stands: by the calibration file, else by tf.

    A lidar that is alone in a recording whose tf doesn't know it at all may stand for the base.
    Raises InputError if its mounting is not known.
    """
    recorded = None
    if tree.path(base, lidar.frame) is not None and (base or alone):
        recorded = near_base(tree.transform(base, lidar.frame), lidar.topic, notes)
        if recorded is not None and tree.moves(base, lidar.frame):
            notes[f"{lidar.topic} moves on the base; its first pose in tf is used"] = 1
    calibration = supplied.lidar(lidar.topic, recorded)
    if calibration is None and alone and not tree.edges:
        notes[
            f"no tf in the recording: the frame of {lidar.topic} is taken as the base "
            "(a mounting can be given with `--calibration FILE`)"
        ] = 1
        calibration = supplied.lidar(lidar.topic, np.eye(4))
    if calibration is None:
        raise InputError(
            f"tf does not say how the lidar's frame {lidar.frame!r} stands on {base!r}",
            where=f"{where}, topic {lidar.topic}",
            remedy=(
                "Give its mounting with `--calibration FILE`, key "
                f"`lidars: {{{lidar.topic}: {{mounting: {{x_m: ..., y_m: ..., yaw_deg: ...}}}}}}`; "
                "or leave it out, choosing others with `--lidar TOPIC`"
            ),
        )
    return calibration


def near_base(T_base_sensor: Array, topic: str, notes: Counter[str]) -> Array | None:
    """The same, or None and a note where no robot is as large as that."""
    if within(T_base_sensor[:3, 3], FARTHEST_MOUNTING_M):
        return T_base_sensor
    notes[
        f"tf has {topic} more than {FARTHEST_MOUNTING_M:g} m from the base: no mounting is that"
    ] = 1
    return None


def to_base(tree: TfTree, child: str, base: str, topic: str, notes: Counter[str]) -> Array:
    """T_child_base, (4, 4): from the frame whose pose a topic tells to the base.

    Without a frame, or a constant way to it in tf, they are taken as one.
    """
    if not child or child == base:
        return np.eye(4)
    if _FIXED.search(child) or tree.path(child, base) is None or tree.moves(child, base):
        notes[f"{topic} tells the pose of {child}, which is taken as the base {base}"] = 1
        return np.eye(4)
    return tree.transform(child, base)
