"""ROS messages turned into ours: stamps, poses, transforms and scans, as rosbags decodes them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from datasets.messages import Array, LaserScan
from datasets.normalise import laser_scan
from datasets.tf_tree import frame_name, se3

# What rosbags gives are classes made at run time: there is no type to name but Any.
RosMessage = Any

LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSE_TYPES = (
    ODOMETRY,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)

LATEST_NS = 2**62
NO_STAMP = "message without a stamp: the time of recording taken"


def stamp_ns(message: RosMessage, bag_ns: int, notes: Counter[str]) -> int:
    """The stamp of a message's header; where that is 0, when the message was recorded."""
    stamp = message.header.stamp
    header_ns = int(stamp.sec) * 10**9 + int(stamp.nanosec)
    if header_ns == 0:
        notes[NO_STAMP] += 1
        return min(bag_ns, LATEST_NS)  # MCAP has 64 bits without a sign
    return header_ns


class FramedPose(NamedTuple):
    """T_parent_child : (4, 4). child is "" where the message doesn't say whose pose it is."""

    parent: str
    child: str
    T_parent_child: Array


def framed_pose(message: RosMessage) -> FramedPose:
    """The pose in a message of one of ``POSE_TYPES``, or in one transform of tf.

    Raises ValueError if it is not finite or its quaternion is zero.
    """
    parent = frame_name(message.header.frame_id)
    child = frame_name(getattr(message, "child_frame_id", ""))
    if hasattr(message, "transform"):
        place, turn = message.transform.translation, message.transform.rotation
    else:
        pose = getattr(message.pose, "pose", message.pose)  # with a covariance, or bare
        place, turn = pose.position, pose.orientation
    xyz_m = (place.x, place.y, place.z)
    return FramedPose(parent, child, se3(xyz_m, (turn.x, turn.y, turn.z, turn.w)))


def scan(
    message: RosMessage,
    *,
    stamp_ns: int,
    lidar: str,
    masks_rad: Sequence[tuple[float, float]],
    notes: Counter[str],
) -> LaserScan | None:
    """The scan in a sensor_msgs/LaserScan, or None and a note if it is none.

    Beams are timed by ``time_increment`` only. Where it is 0 the beam times are unknown, even if
    ``scan_time`` is not: simulators take a whole scan at one instant and give their period there.
    """
    with np.errstate(invalid="ignore"):  # damaged bytes may be signalling NaNs
        ranges = np.asarray(message.ranges, dtype=np.float64)
    try:
        return laser_scan(
            stamp_ns=stamp_ns,
            lidar=lidar,
            ranges=ranges,
            angle_min_rad=float(message.angle_min),
            angle_max_rad=float(message.angle_max),
            angle_increment_rad=float(message.angle_increment),
            time_increment_s=float(message.time_increment),
            range_min_m=float(message.range_min),
            range_max_m=float(message.range_max),
            masks_rad=masks_rad,
            notes=notes,
        )
    except (ValueError, OverflowError) as error:
        notes[f"scan of {lidar} left out: {error}"] += 1
        return None
