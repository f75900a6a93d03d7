"""What a bag holds for us, found before its messages are read.

Looked at are the list of topics, the first messages of some, and as much of tf as is needed.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from datasets.bag_camera_setup import set_up
from datasets.bag_cameras import CameraTopic, choose_cameras, find_depth_topics, no_camera
from datasets.bag_frames import (
    choose_base,
    mounting,
    odometry_link,
    read_tf,
    tf_topics,
    to_base,
)
from datasets.bag_messages import LASER_SCAN
from datasets.bag_parts import Topic
from datasets.bag_source import BagSource
from datasets.bag_topics import (
    LidarTopic,
    child_frame,
    find_ground_truth,
    find_lidars,
    find_odometry,
)
from datasets.calibration_file import CalibrationFile
from datasets.errors import InputError
from datasets.messages import Array
from datasets.options import ReadOptions
from datasets.recording import CameraCalibration, LidarCalibration
from datasets.tf_tree import TfTree


@dataclass(frozen=True, slots=True)
class TopicPoses:
    """Poses from a topic; T_child_base : (4, 4), from the frame they are of to the base."""

    topic: Topic
    T_child_base: Array


@dataclass(frozen=True, slots=True)
class TfPoses:
    """Poses from a link of tf; T_child_base : (4, 4), from its child to the base."""

    topics: tuple[str, ...]
    parent: str
    child: str
    T_child_base: Array


@dataclass(frozen=True, slots=True)
class BagLayout:
    """base_frame is "" where the bag doesn't name it."""

    base_frame: str
    lidars: dict[str, LidarCalibration]
    cameras: dict[str, CameraCalibration]
    odometry: TopicPoses | TfPoses | None
    ground_truth: TopicPoses | None


def survey(
    source: BagSource, options: ReadOptions, supplied: CalibrationFile, notes: Counter[str]
) -> BagLayout:
    """Find out what is to be read from a bag.

    Raises InputError if there is no lidar nor a depth camera that can be used, not a topic that
    was asked for, or no way from tf to a lidar's mounting.
    """
    cameras = _cameras(source, options, supplied, notes)
    lidars: list[LidarTopic] = []
    if options.use_lidars:
        lidars = find_lidars(source, options.lidars, notes, required=not cameras)
    elif not cameras:
        raise no_camera(source)
    supplied.require_known([topic.name for topic in source.of_type(LASER_SCAN)])
    truth = find_ground_truth(source, options.ground_truth or supplied.ground_truth)
    asked = options.odometry or supplied.odometry
    moving = None if asked == "tf" else find_odometry(source, asked, truth, notes)
    moving_child = child_frame(source, moving) if moving else ""
    tree = read_tf(source, [*lidars, *cameras], moving_child, notes)
    # Cameras tell the base only where there are no lidars, which then stand on the same.
    base = choose_base(tree, [sensor.frame for sensor in lidars or cameras], moving_child)
    mountings = {
        lidar.topic: mounting(
            lidar, base, tree, supplied, alone=len(lidars) == 1, where=source.where, notes=notes
        )
        for lidar in lidars
    }
    seeing = set_up(
        cameras,
        source,
        base,
        tree,
        supplied,
        notes,
        asked=bool(options.cameras),
        alone=not lidars,
        unmounted=options.unmounted_cameras,
    )
    odometry: TopicPoses | TfPoses | None = None
    # Looked for even where it is not used: the base must not depend on that.
    if moving is not None:
        T_moving_base = to_base(tree, moving_child, base, moving.name, notes)
        odometry = TopicPoses(moving, T_moving_base)
    else:
        odometry = _tf_odometry(source, tree, base, required=asked == "tf")
    if not options.use_odometry:
        odometry = None
    elif odometry is None:
        notes["no odometry in the recording, neither as a topic nor as tf odom -> base"] = 1
    ground_truth = None
    if truth is not None:
        T_truth_base = to_base(tree, child_frame(source, truth), base, truth.name, notes)
        ground_truth = TopicPoses(truth, T_truth_base)
    return BagLayout(base, mountings, seeing, odometry, ground_truth)


def _cameras(
    source: BagSource, options: ReadOptions, supplied: CalibrationFile, notes: Counter[str]
) -> list[CameraTopic]:
    if not options.use_cameras:
        return []
    found = find_depth_topics(source, notes)
    chosen = choose_cameras(source, found, options.cameras, notes)
    supplied.require_known_cameras({*found, *(camera.topic for camera in chosen)})
    return chosen


def _tf_odometry(source: BagSource, tree: TfTree, base: str, *, required: bool) -> TfPoses | None:
    link = odometry_link(tree, base)
    if link is None and required:
        raise InputError(
            f"tf has no frame called odom above {base or 'the lidars'!r}",
            where=source.where,
            remedy=f"Choose a topic with `--odometry TOPIC`; there is: {source.listing()}",
        )
    if link is None:
        return None
    parent, child = link
    return TfPoses(tuple(tf_topics(source)[1]), parent, child, tree.transform(child, base))
