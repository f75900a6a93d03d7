"""Messages of simulated drivers as ROS messages, of ROS 1 and of ROS 2.

Frames as REP 105 and the drivers name them: map, odom, base_link, laser, camera_link (x forward)
and camera_depth_optical_frame (z forward).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from datasets.bag_messages import RosMessage
from datasets.calibration_file import T_BODY_OPTICAL
from datasets.messages import Array
from datasets.simulation.depth_camera import MODES
from datasets.simulation.driver_messages import (
    ODOMETRY,
    DriverDepth,
    DriverMessage,
    DriverPose,
    DriverTurn,
)
from datasets.simulation.robot import Robot
from datasets.tf_tree import se3_inverse

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

BASE, ODOM, MAP = "base_link", "odom", "map"
TF, TF_STATIC = "/tf", "/tf_static"

COMPRESSED: Final = "/compressedDepth"
"""image_transport publishes this kind of image below the topic of the raw one."""

_RUN_LENGTHS = 3
"""OpenCV's PNG strategy RLE, at level 1: four times as fast as its default, a tenth larger."""

_NO_HEADER = struct.pack("<iff", 0, 0.0, 0.0)
"""What compressed_depth_image_transport puts before the PNG of a 16UC1 image; it means nothing."""


class Published(NamedTuple):
    """A message on its topic. message : of the typestore that made it."""

    topic: str
    msgtype: str
    message: RosMessage


class RosMessages:
    """Makes the messages of a robot.

    raw_depth : images as 16UC1, two bytes a pixel; else as compressedDepth, a PNG.
    """

    def __init__(self, store: Typestore, robot: Robot, *, raw_depth: bool) -> None:
        self._types: Mapping[str, RosMessage] = store.types
        self._robot = robot
        self._raw_depth = raw_depth
        header_fields = store.fielddefs["std_msgs/msg/Header"][1]
        self._seq = any(name == "seq" for name, _ in header_fields)

    def mountings(self, stamp_ns: int) -> Published:
        """Where the sensors stand on the base."""
        links = [
            self._link(stamp_ns, BASE, lidar_frame(topic), lidar.T_base_lidar)
            for topic, lidar in sorted(self._robot.lidars.items())
        ]
        for topic, camera in sorted(self._robot.cameras.items()):
            body, optical = camera_frames(topic)
            T_base_body = camera.T_base_camera @ se3_inverse(T_BODY_OPTICAL)
            links.append(self._link(stamp_ns, BASE, body, T_base_body))
            links.append(self._link(stamp_ns, body, optical, T_BODY_OPTICAL))
        return self._transforms(TF_STATIC, links)

    def of(self, raw: DriverMessage) -> Iterator[Published]:
        """What is published with a message of a driver."""
        match raw:
            case DriverTurn():
                yield Published(raw.topic, "sensor_msgs/msg/LaserScan", self._scan(raw))
            case DriverDepth():
                yield self._image(raw)
                yield self._camera_info(raw)
            case DriverPose() if raw.topic == ODOMETRY:
                yield Published(raw.topic, "nav_msgs/msg/Odometry", self._odometry(raw))
                link = self._link(raw.stamp_ns, ODOM, BASE, _planar(raw), raw.quaternion_xyzw)
                yield self._transforms(TF, [link])
            case DriverPose():
                pose = self._make(
                    "geometry_msgs/msg/PoseStamped",
                    header=self._header(raw.stamp_ns, MAP),
                    pose=self._pose(raw),
                )
                yield Published(raw.topic, "geometry_msgs/msg/PoseStamped", pose)

    def _scan(self, raw: DriverTurn) -> RosMessage:
        turn = raw.turn
        return self._make(
            "sensor_msgs/msg/LaserScan",
            header=self._header(raw.stamp_ns, lidar_frame(raw.topic)),
            angle_min=turn.angle_min_rad,
            angle_max=turn.angle_max_rad,
            angle_increment=turn.angle_increment_rad,
            time_increment=turn.time_increment_s,
            scan_time=turn.scan_time_s,
            range_min=turn.range_min_m,
            range_max=turn.range_max_m,
            ranges=turn.ranges_m,
            intensities=np.empty(0, dtype=np.float32),
        )

    def _image(self, raw: DriverDepth) -> Published:
        header = self._header(raw.stamp_ns, camera_frames(raw.topic)[1])
        height, width = raw.depth_mm.shape
        if self._raw_depth:
            image = self._make(
                "sensor_msgs/msg/Image",
                header=header,
                height=height,
                width=width,
                encoding="16UC1",
                is_bigendian=0,
                step=2 * width,
                data=raw.depth_mm.astype("<u2").view(np.uint8).reshape(-1),
            )
            return Published(raw.topic, "sensor_msgs/msg/Image", image)
        image = self._make(
            "sensor_msgs/msg/CompressedImage",
            header=header,
            format="16UC1; compressedDepth png",
            data=np.frombuffer(_NO_HEADER + _png(raw), dtype=np.uint8),
        )
        return Published(raw.topic + COMPRESSED, "sensor_msgs/msg/CompressedImage", image)

    def _camera_info(self, raw: DriverDepth) -> Published:
        model = self._robot.cameras[raw.topic].model
        mode, K = MODES[model.mode], model.K
        matrices = {
            "d": np.zeros(5),
            "k": K.reshape(-1),
            "r": np.eye(3).reshape(-1),
            "p": np.column_stack([K, np.zeros(3)]).reshape(-1),
        }
        if self._seq:  # ROS 1 writes them large
            matrices = {name.upper(): matrix for name, matrix in matrices.items()}
        info = self._make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(raw.stamp_ns, camera_frames(raw.topic)[1]),
            height=mode.height,
            width=mode.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=self._make(
                "sensor_msgs/msg/RegionOfInterest",
                x_offset=0,
                y_offset=0,
                height=0,
                width=0,
                do_rectify=False,
            ),
            **matrices,
        )
        return Published(info_topic(raw.topic), "sensor_msgs/msg/CameraInfo", info)

    def _odometry(self, raw: DriverPose) -> RosMessage:
        linear = self._vector((raw.speed_m_s, 0.0, 0.0))
        angular = self._vector((0.0, 0.0, raw.turn_rate_rad_s))
        twist = self._make("geometry_msgs/msg/Twist", linear=linear, angular=angular)
        unknown = np.zeros(36)
        return self._make(
            "nav_msgs/msg/Odometry",
            header=self._header(raw.stamp_ns, ODOM),
            child_frame_id=BASE,
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(raw), covariance=unknown
            ),
            twist=self._make(
                "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown
            ),
        )

    def _pose(self, raw: DriverPose) -> RosMessage:
        x_m, y_m, _ = raw.xyyaw.tolist()
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=x_m, y=y_m, z=0.0),
            orientation=self._quaternion(raw.quaternion_xyzw),
        )

    def _transforms(self, topic: str, links: list[RosMessage]) -> Published:
        msgtype = "tf2_msgs/msg/TFMessage"
        return Published(topic, msgtype, self._make(msgtype, transforms=links))

    def _link(
        self,
        stamp_ns: int,
        parent: str,
        child: str,
        T_parent_child: Array,
        quaternion_xyzw: tuple[float, float, float, float] | None = None,
    ) -> RosMessage:
        """quaternion_xyzw : of the transform's rotation, where it is known."""
        return self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp_ns, parent),
            child_frame_id=child,
            transform=self._make(
                "geometry_msgs/msg/Transform",
                translation=self._vector(T_parent_child[:3, 3].tolist()),
                rotation=self._quaternion(quaternion_xyzw or _quaternion(T_parent_child)),
            ),
        )

    def _vector(self, xyz: tuple[float, float, float]) -> RosMessage:
        return self._make("geometry_msgs/msg/Vector3", x=xyz[0], y=xyz[1], z=xyz[2])

    def _quaternion(self, xyzw: tuple[float, float, float, float]) -> RosMessage:
        x, y, z, w = xyzw
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _header(self, stamp_ns: int, frame: str) -> RosMessage:
        sec, nanosec = divmod(stamp_ns, 10**9)
        time = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        more = {"seq": 0} if self._seq else {}
        return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame, **more)

    def _make(self, msgtype: str, **fields: object) -> RosMessage:
        return self._types[msgtype](**fields)


def lidar_frame(topic: str) -> str:
    """laser for /scan, laser_low for /scan_low."""
    return topic.strip("/").replace("/", "_").replace("scan", "laser")


def camera_frames(topic: str) -> tuple[str, str]:
    """The body's frame and the optical one, for /camera/depth/... those of the RealSense driver."""
    name = topic.strip("/").partition("/")[0]
    return f"{name}_link", f"{name}_depth_optical_frame"


def info_topic(image_topic: str) -> str:
    """The topic of a camera's intrinsics, beside that of its raw images."""
    return f"{image_topic.rpartition('/')[0]}/camera_info"


def _png(raw: DriverDepth) -> bytes:
    import cv2  # noqa: PLC0415

    wanted = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, _RUN_LENGTHS]
    done, packed = cv2.imencode(".png", raw.depth_mm, wanted)
    assert done, "an image of 16 bits can be a PNG"
    return packed.tobytes()


def _planar(raw: DriverPose) -> Array:
    T_fixed_base = np.eye(4)
    T_fixed_base[:2, 3] = raw.xyyaw[:2]
    return T_fixed_base


def _quaternion(T_a_b: Array) -> tuple[float, float, float, float]:
    """x, y, z, w of a rotation, w not negative.

    Bar-Itzhack (2000): the eigenvector of the largest eigenvalue of a symmetric matrix, right for
    all angles. SciPy has it too, and takes 20 MB and half a second to be imported.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = T_a_b[:3, :3]
    matrix = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    vector = np.linalg.eigh(matrix)[1][:, -1]
    x, y, z, w = (vector if vector[3] >= 0.0 else -vector).tolist()
    return x, y, z, w
