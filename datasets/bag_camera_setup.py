"""Where the depth cameras of a bag stand and how they see: from CameraInfo, tf and the file."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from itertools import islice, takewhile
from typing import Final, NamedTuple

import numpy as np

from datasets.bag_cameras import CameraTopic
from datasets.bag_frames import near_base
from datasets.bag_messages import RosMessage
from datasets.bag_source import BagSource
from datasets.bag_topics import decoded
from datasets.calibration_file import T_BODY_OPTICAL, CalibrationFile
from datasets.errors import InputError
from datasets.messages import Array
from datasets.recording import CameraCalibration, Intrinsics
from datasets.tf_tree import TfTree, frame_name

CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"

MOST_DISTORTION_PX = 1.0
"""Distortion that moves no corner of the image further than this is none."""

LOWEST_BASE_LINK_M = -0.3
"""A base at the height of its axles may have a camera below it, but not so far."""

_BODY_NAMES = re.compile(r"(?i)(_link|_frame|_body|_mount)$")
_UP = 0.7
"""A z axis that points up by more than this (a cosine) is a body's, no optical axis."""


class CameraInfo(NamedTuple):
    """What the first CameraInfo of a topic says, of images width_px x height_px.

    K, P       : (3, 3) of the image as it is, and as it is rectified; not valid ones are None.
    distortion : its coefficients D as they stand.
    """

    topic: str
    frame: str
    width_px: int
    height_px: int
    K: Array | None
    P: Array | None
    model: str
    distortion: Array


def read_camera_infos(source: BagSource) -> list[CameraInfo]:
    """The first CameraInfo of each topic that can be decoded; by topic name."""
    infos = []
    for topic in source.of_type(CAMERA_INFO):
        for _, message in islice(decoded(source, topic), 1):
            infos.append(_camera_info(topic.name, message))
    return infos


def _camera_info(topic: str, message: RosMessage) -> CameraInfo:
    """The pinholes of the images themselves: binned, and cut to the region of interest."""
    capitals = hasattr(message, "K")  # ROS 1 writes K, D and P, ROS 2 k, d and p
    K, P, D = (getattr(message, name if capitals else name.lower()) for name in "KPD")
    roi, bin_x, bin_y = message.roi, max(1, message.binning_x), max(1, message.binning_y)
    width_px = (int(roi.width) or int(message.width)) // bin_x
    height_px = (int(roi.height) or int(message.height)) // bin_y

    def pinhole(matrix: Array) -> Array | None:
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0.0 and fy > 0.0):
            return None
        cx, cy = (cx - roi.x_offset) / bin_x, (cy - roi.y_offset) / bin_y
        return np.array([[fx / bin_x, 0.0, cx], [0.0, fy / bin_y, cy], [0.0, 0.0, 1.0]])

    return CameraInfo(
        topic,
        frame_name(message.header.frame_id),
        width_px,
        height_px,
        pinhole(np.asarray(K, dtype=np.float64).reshape(3, 3)),
        pinhole(np.asarray(P, dtype=np.float64).reshape(3, 4)[:, :3]),
        str(message.distortion_model),
        np.asarray(D, dtype=np.float64),
    )


def intrinsics(
    camera: CameraTopic, infos: Sequence[CameraInfo], notes: Counter[str]
) -> Intrinsics | None:
    """The pinhole of a camera by the CameraInfo that belongs to it; None if there is none.

    That in the image's namespace belongs to it; else, of those for the same frame and size, the
    one with the most similar name. One in the namespace is taken even if its size is another: the
    images are then left out, with both sizes. Rectified images have the pinhole P, others K.
    """
    namespace = camera.base_name.rpartition("/")[0]
    size = camera.width_px, camera.height_px
    infos = [info for info in infos if info.K is not None or info.P is not None]
    own = [info for info in infos if info.topic == f"{namespace}/camera_info"]
    same = [info for info in infos if info.frame == camera.frame and info[2:4] == size]
    fitting = [info for info in own if info[2:4] == size]
    candidates = fitting or sorted(same, key=lambda info: _name_distance(camera, info)) or own
    if not candidates:
        return None
    info = candidates[0]
    rectified = "rect" in camera.base_name or not np.any(info.distortion)
    K = info.P if info.P is not None and (rectified or info.K is None) else info.K
    assert K is not None  # one of the two is there
    if K is info.K and "rect" not in camera.base_name:
        moved_px = _distortion_px(info)
        if moved_px > MOST_DISTORTION_PX:
            notes[
                f"{camera.topic}: its lens moves the corners by {moved_px:.1f} px ({info.topic}); "
                "its images are taken as if it had none"
            ] = 1
    return Intrinsics(K, info.width_px, info.height_px)


def _name_distance(camera: CameraTopic, info: CameraInfo) -> tuple[int, str]:
    parts = zip(camera.base_name.split("/"), info.topic.split("/"), strict=False)
    return -sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], parts)), info.topic


def _distortion_px(info: CameraInfo) -> float:
    """How far the lens moves a corner or the middle of an edge, at most (plumb_bob and kin)."""
    K, D = info.K, info.distortion
    if K is None or not np.any(D):
        return 0.0
    if not np.isfinite(D).all() or info.model == "equidistant" or D.size not in (4, 5, 8, 12, 14):
        return math.inf
    import cv2  # noqa: PLC0415

    u, v = np.meshgrid(
        [0.0, info.width_px / 2, float(info.width_px)],
        [0.0, info.height_px / 2, float(info.height_px)],
    )
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    seen, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, D)
    moved_px = np.hypot(*(seen.reshape(-1, 2) - np.stack([u, v], -1).reshape(-1, 2)).T)
    return float(moved_px.max())


def optical_mounting(
    camera: CameraTopic, base: str, tree: TfTree, notes: Counter[str]
) -> Array | None:
    """T_base_camera, (4, 4), of the optical frame, by tf; None if tf doesn't know it.

    Images are to be stamped with an optical frame (REP 103), but some drivers and simulators name
    the camera's body, x forward: then the optical frame on it is taken, or, if there is none, what
    it would be.
    """
    frame = camera.frame
    if not frame or not base or tree.path(base, frame) is None:
        return None
    T_base_frame = tree.transform(base, frame)
    if _is_body(frame, T_base_frame):
        optical = _optical_on(tree, frame)
        if optical is None:
            notes[
                f"{camera.topic}: its frame {frame} is taken as that of the body, looking along x"
            ] = 1
            T_base_frame = T_base_frame @ T_BODY_OPTICAL
        else:
            notes[f"{camera.topic}: for its frame {frame} stands {optical}, that hangs on it"] = 1
            frame, T_base_frame = optical, tree.transform(base, optical)
    if tree.moves(base, frame):
        notes[f"{camera.topic} moves on the base; its first pose in tf is used"] = 1
    return near_base(T_base_frame, camera.topic, notes)


def _is_body(frame: str, T_base_frame: Array) -> bool:
    """By the frame's name; where that says nothing, a camera does not look at the ceiling."""
    if "optical" in frame.lower():
        return False
    return bool(_BODY_NAMES.search(frame)) or bool(T_base_frame[2, 2] > _UP)


def _optical_on(tree: TfTree, body: str) -> str | None:
    """The optical frame that hangs on a body's: the depth camera's, the nearest."""
    found = [
        ("depth" not in frame.lower(), tree.upwards(frame).index(body), frame)
        for frame in tree.edges
        if "optical" in frame.lower() and body in tree.upwards(frame)
    ]
    return min(found)[2] if found else None


def set_up(
    cameras: Sequence[CameraTopic],
    source: BagSource,
    base: str,
    tree: TfTree,
    supplied: CalibrationFile,
    notes: Counter[str],
    *,
    asked: bool,
    alone: bool,
    unmounted: bool = False,
) -> dict[str, CameraCalibration]:
    """Mounting and pinhole of each camera, by the file, else by the recording.

    A camera without one of them is left out, with a note of what supplies it; one that only lacks
    its mounting stays with ``unmounted``. Raises InputError if one that is left out was asked for,
    or if then there is nothing to read (``alone``).
    """
    infos = read_camera_infos(source) if cameras else []
    known: dict[str, CameraCalibration] = {}
    lacking: list[InputError] = []
    for camera in cameras:
        given = supplied.cameras.get(camera.topic, CameraCalibration(None, None))
        T_base_camera, pinhole = given.T_base_camera, given.intrinsics
        if T_base_camera is None:
            T_base_camera = optical_mounting(camera, base, tree, notes)
        if pinhole is None:
            pinhole = intrinsics(camera, infos, notes)
        if pinhole is not None and T_base_camera is None and unmounted:
            known[camera.topic] = CameraCalibration(None, pinhole)
            continue
        if T_base_camera is None or pinhole is None:
            what, key = _lacking(camera, base, T_base_camera, pinhole)
            remedy = (
                f"Give it with `--calibration FILE`, key `cameras: {{{camera.topic}: {{{key}}}}}`"
            )
            lacking.append(
                InputError(what, where=f"{source.where}, topic {camera.topic}", remedy=remedy)
            )
            notes[
                f"{camera.topic} left out: {what} (`--calibration FILE` gives it, key cameras)"
            ] = camera.messages
            continue
        known[camera.topic] = CameraCalibration(T_base_camera, pinhole)
        lowest_m = 0.0 if base.endswith("footprint") else LOWEST_BASE_LINK_M
        height_m = float(T_base_camera[2, 3])
        if height_m < lowest_m:
            notes[
                f"{camera.topic} stands underground by its mounting, at a height of "
                f"{height_m:.2f} m on {base or 'the base'}"
            ] = 1
    if lacking and (asked or (alone and not known)):
        raise lacking[0]
    return known


def _lacking(
    camera: CameraTopic, base: str, T_base_camera: Array | None, pinhole: Intrinsics | None
) -> tuple[str, str]:
    """What is not known of a camera, and the keys of the calibration file that say it."""
    whats, keys = [], []
    if T_base_camera is None:
        whats.append(f"tf does not say how the camera's frame {camera.frame!r} stands on {base!r}")
        keys.append("mounting: {x_m: ..., z_m: ..., pitch_deg: ...}")
    if pinhole is None:
        whats.append("no CameraInfo with intrinsics belongs to its images")
        keys.append("intrinsics: {width_px: ..., height_px: ..., fx_px: ..., ...}")
    return " and ".join(whats), ", ".join(keys)
