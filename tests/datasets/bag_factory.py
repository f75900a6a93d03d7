"""Bags written for tests, the same content in every format, through rosbags' writers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from datasets.bag_messages import RosMessage

Format = Literal["ros1", "sqlite3", "mcap"]
FORMATS: tuple[Format, ...] = ("ros1", "sqlite3", "mcap")
S = 10**9
T0_NS = 1_700_000_000 * S

Transform = tuple[str, str, Sequence[float], Sequence[float]]
"""parent, child, xyz, quaternion xyzw"""


@dataclass(frozen=True)
class Entry:
    """A message to write: a function that builds it, or its bytes as they shall lie in the bag."""

    topic: str
    msgtype: str
    bag_ns: int
    content: Callable[[Typestore], RosMessage] | bytes


def scan_entry(
    stamp_ns: int,
    *,
    topic: str = "/scan",
    frame: str = "laser",
    bag_ns: int | None = None,
    ranges: Sequence[float] | None = None,
    time_increment: float = 0.0,
    scan_time: float = 0.0,
    angle_min: float = -1.5,
    angle_increment: float = 0.5,
) -> Entry:
    values = np.asarray([2.0, 3.0, 4.0, 5.0] if ranges is None else ranges, dtype=np.float32)

    def build(store: Typestore) -> RosMessage:
        return store.types["sensor_msgs/msg/LaserScan"](
            header=_header(store, stamp_ns, frame),
            angle_min=angle_min,
            angle_max=angle_min + angle_increment * (len(values) - 1),
            angle_increment=angle_increment,
            time_increment=time_increment,
            scan_time=scan_time,
            range_min=0.1,
            range_max=30.0,
            ranges=values,
            intensities=np.empty(0, dtype=np.float32),
        )

    return Entry(topic, "sensor_msgs/msg/LaserScan", _at(bag_ns, stamp_ns), build)


def odometry_entry(
    stamp_ns: int,
    x_m: float,
    y_m: float = 0.0,
    yaw_rad: float = 0.0,
    *,
    topic: str = "/odom",
    child: str = "base_link",
    bag_ns: int | None = None,
) -> Entry:
    def build(store: Typestore) -> RosMessage:
        types = store.types
        pose = _pose(store, (x_m, y_m, 0.0), yaw_quaternion(yaw_rad))
        zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        twist = types["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
        none = np.zeros(36)
        return types["nav_msgs/msg/Odometry"](
            header=_header(store, stamp_ns, "odom"),
            child_frame_id=child,
            pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=none),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=none),
        )

    return Entry(topic, "nav_msgs/msg/Odometry", _at(bag_ns, stamp_ns), build)


def pose_entry(
    stamp_ns: int, x_m: float, y_m: float, yaw_rad: float, *, topic: str = "/ground_truth"
) -> Entry:
    def build(store: Typestore) -> RosMessage:
        return store.types["geometry_msgs/msg/PoseStamped"](
            header=_header(store, stamp_ns, "map"),
            pose=_pose(store, (x_m, y_m, 0.0), yaw_quaternion(yaw_rad)),
        )

    return Entry(topic, "geometry_msgs/msg/PoseStamped", stamp_ns, build)


def tf_entry(
    stamp_ns: int, *transforms: Transform, topic: str = "/tf", bag_ns: int | None = None
) -> Entry:
    def build(store: Typestore) -> RosMessage:
        return store.types["tf2_msgs/msg/TFMessage"](
            transforms=[_transform(store, stamp_ns, *transform) for transform in transforms]
        )

    return Entry(topic, "tf2_msgs/msg/TFMessage", _at(bag_ns, stamp_ns), build)


def image_entry(
    stamp_ns: int,
    pixels: npt.NDArray[Any],
    *,
    topic: str = "/camera/depth/image_rect_raw",
    frame: str = "camera_depth_optical_frame",
    encoding: str = "16UC1",
    padding: int = 0,
    bigendian: bool = False,
    bag_ns: int | None = None,
    **fields: object,
) -> Entry:
    """A raw image of what lies in ``pixels``; fields overrule those of the message."""
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if bigendian else "<"))
    height, width = rows.shape[:2]
    lines = rows.reshape(height, -1).view(np.uint8)
    lines = np.pad(lines, ((0, 0), (0, padding)), constant_values=0xEE)

    def build(store: Typestore) -> RosMessage:
        content: dict[str, Any] = {
            "height": height,
            "width": width,
            "encoding": encoding,
            "is_bigendian": int(bigendian),
            "step": lines.shape[1],
            "data": lines.ravel(),
        }
        header = _header(store, stamp_ns, frame)
        return store.types["sensor_msgs/msg/Image"](header=header, **(content | fields))

    return Entry(topic, "sensor_msgs/msg/Image", _at(bag_ns, stamp_ns), build)


def compressed_entry(
    stamp_ns: int,
    data: bytes,
    *,
    topic: str = "/camera/depth/image_rect_raw/compressedDepth",
    frame: str = "camera_depth_optical_frame",
    form: str = "16UC1; compressedDepth png",
    bag_ns: int | None = None,
) -> Entry:
    def build(store: Typestore) -> RosMessage:
        return store.types["sensor_msgs/msg/CompressedImage"](
            header=_header(store, stamp_ns, frame),
            format=form,
            data=np.frombuffer(data, dtype=np.uint8),
        )

    return Entry(topic, "sensor_msgs/msg/CompressedImage", _at(bag_ns, stamp_ns), build)


def png(pixels: npt.NDArray[Any]) -> bytes:
    written, data = cv2.imencode(".png", pixels)
    assert written
    return data.tobytes()


def camera_info_entry(
    stamp_ns: int,
    *,
    topic: str = "/camera/depth/camera_info",
    frame: str = "camera_depth_optical_frame",
    size: tuple[int, int] = (8, 6),
    K: Sequence[float] = (5.0, 0, 4.0, 0, 5.5, 3.0, 0, 0, 1),
    P: Sequence[float] = (0.0,) * 12,
    D: Sequence[float] = (),
    model: str = "plumb_bob",
    binning: int = 0,
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
) -> Entry:
    """size : width, height; roi : x, y, width, height."""

    def build(store: Typestore) -> RosMessage:
        kind = store.types["sensor_msgs/msg/CameraInfo"]
        matrices = {"D": D, "K": K, "R": np.eye(3).ravel(), "P": P}
        names = {n: n if n in kind.__dataclass_fields__ else n.lower() for n in matrices}
        x, y, width, height = roi
        return kind(
            header=_header(store, stamp_ns, frame),
            width=size[0],
            height=size[1],
            distortion_model=model,
            **{names[n]: np.array(values, dtype=np.float64) for n, values in matrices.items()},
            binning_x=binning,
            binning_y=binning,
            roi=store.types["sensor_msgs/msg/RegionOfInterest"](
                x_offset=x, y_offset=y, height=height, width=width, do_rectify=False
            ),
        )

    return Entry(topic, "sensor_msgs/msg/CameraInfo", stamp_ns, build)


def string_entry(bag_ns: int, text: str = "", *, topic: str = "/chatter") -> Entry:
    def build(store: Typestore) -> RosMessage:
        return store.types["std_msgs/msg/String"](data=text)

    return Entry(topic, "std_msgs/msg/String", bag_ns, build)


def yaw_quaternion(yaw_rad: float) -> tuple[float, float, float, float]:
    return 0.0, 0.0, float(np.sin(yaw_rad / 2)), float(np.cos(yaw_rad / 2))


def write_bag(
    folder: Path,
    kind: Format,
    entries: Sequence[Entry],
    *,
    name: str = "drive",
    compression: str = "",
    chunk_bytes: int = 4096,
) -> Path:
    """Write a bag and return what a person would name: the .bag file, or the ROS 2 folder.

    compression : ros1: "bz2" or "lz4"; ROS 2: "file", "message" or (MCAP only) "storage".
    """
    if kind == "ros1":
        path = folder / f"{name}.bag"
        ros1 = Ros1Writer(path)
        ros1.chunk_threshold = chunk_bytes
        if compression:
            ros1.set_compression(Ros1Writer.CompressionFormat[compression.upper()])
        with ros1:
            _write(ros1, entries, ros1_store(), ros1=True)
        return path
    path = folder / name
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
    ros2 = Ros2Writer(path, version=9, storage_plugin=plugin)
    if compression:
        ros2.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with ros2:
        _write(ros2, entries, get_typestore(Stores.LATEST), ros1=False)
    return path


def storage_file(path: Path) -> Path:
    """The one file in which the messages of a written bag lie."""
    if path.is_file():
        return path
    return next(file for file in path.iterdir() if file.suffix in (".db3", ".mcap"))


def ros1_store() -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC)
    tf = "geometry_msgs/TransformStamped[] transforms"
    store.register(get_types_from_msg(tf, "tf2_msgs/msg/TFMessage"))
    return store


def _write(
    writer: Ros1Writer | Ros2Writer, entries: Sequence[Entry], store: Typestore, *, ros1: bool
) -> None:
    connections: dict[str, Any] = {}
    for entry in entries:
        if entry.topic not in connections:
            definition: dict[str, Any] = {"typestore": store}
            if entry.msgtype not in store.fielddefs:
                checksum = "md5sum" if ros1 else "rihs01"
                definition = {"msgdef": "no ! definition @", checksum: "0" * 32}
            connections[entry.topic] = writer.add_connection(
                entry.topic, entry.msgtype, **definition
            )
        data = entry.content
        if not isinstance(data, bytes):
            serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
            data = bytes(serialize(data(store), entry.msgtype))
        writer.write(connections[entry.topic], entry.bag_ns, data)


def _at(bag_ns: int | None, stamp_ns: int) -> int:
    return stamp_ns if bag_ns is None else bag_ns


def _header(store: Typestore, stamp_ns: int, frame: str) -> RosMessage:
    stamp = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // S, nanosec=stamp_ns % S)
    header = store.types["std_msgs/msg/Header"]
    if "seq" in header.__dataclass_fields__:
        return header(seq=0, stamp=stamp, frame_id=frame)
    return header(stamp=stamp, frame_id=frame)


def _pose(store: Typestore, xyz: Sequence[float], quaternion: Sequence[float]) -> RosMessage:
    types = store.types
    return types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](**dict(zip("xyz", xyz, strict=True))),
        orientation=types["geometry_msgs/msg/Quaternion"](
            **dict(zip("xyzw", quaternion, strict=True))
        ),
    )


def _transform(
    store: Typestore,
    stamp_ns: int,
    parent: str,
    child: str,
    xyz: Sequence[float],
    quaternion: Sequence[float],
) -> RosMessage:
    types = store.types
    return types["geometry_msgs/msg/TransformStamped"](
        header=_header(store, stamp_ns, parent),
        child_frame_id=child,
        transform=types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](**dict(zip("xyz", xyz, strict=True))),
            rotation=types["geometry_msgs/msg/Quaternion"](
                **dict(zip("xyzw", quaternion, strict=True))
            ),
        ),
    )
