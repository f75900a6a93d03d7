"""One depth image and the scan around it, fused as a run would: what ``slam fuse`` draws."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from datasets.errors import InputError
from datasets.messages import Array, DepthImage, LaserScan, Message, Odometry
from datasets.open_recording import open_recording
from datasets.options import ReadOptions
from datasets.recording import Calibration, CameraCalibration, Recording
from datasets.se2 import xyyaw
from frontend.motion import MotionModel
from fusion.depth_labels import BEHIND, HOLE, NEAREST, TOO_HIGH
from fusion.depth_projection import DepthProjection
from fusion.paper.mode import PaperConfig
from fusion.placed_points import PlacedView, place_views
from fusion.pseudo_scan import PseudoScan
from fusion.scan import FusedScan
from fusion.sweep import Sweep
from slam.config import Config
from slam.fusing import VIEW_AGE_S, Fusing

AROUND_S = 1.0
"""An image, or a scan, farther than this from the time asked for is not of that time."""
READ_S = 2.0
"""So much before and after is read, for scans and odometry around the image;"""
ODOMETRY_S = 1.5
"""and odometry so far from the image counts."""
ABSOLUTE_S = 1e8
"""A larger time is a stamp: no recording lasts three years."""

Labels = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class FuseMoment:
    """A depth image, what became of its pixels, and the scan that it was fused with.

    image_s       : seconds from the recording's first message to the image.
    labels        : (H, W) of the image's pixels, constants of ``fusion.depth_labels``.
    sweep, fused  : None where no lidar has a scan around that time.
    T_scan_view   : (3, 3), the base at the image in the base at the middle of the scan.
    odometry      : whether that is by odometry; otherwise the base is taken to stand.
    notes         : what a person should know of it, in words.
    """

    recording: str
    config: Config
    image: DepthImage
    image_s: float
    labels: Labels
    pseudo: PseudoScan
    sweep: Sweep | None
    fused: FusedScan | None
    T_scan_view: Array
    odometry: bool
    notes: tuple[str, ...]

    @property
    def offset_s(self) -> float:
        """From the middle of the scan to the image; 0 without a scan."""
        return 0.0 if self.sweep is None else (self.image.stamp_ns - self.sweep.moment_ns) * 1e-9

    @property
    def T_fused_view(self) -> Array:
        """(3, 3), by what the view is moved when it is fused: paper mode takes it as it is."""
        return np.eye(3) if self.config.fusion == "paper" else self.T_scan_view

    def title(self) -> list[str]:
        """What is drawn, in words, a line each."""
        lines = [
            f"{self.recording}, {self.config.fusion} mode: "
            f"image of {self.image.camera} at {self.image_s:.3f} s"
        ]
        if self.sweep is not None:
            x_m, y_m, yaw_rad = xyyaw(self.T_scan_view)
            after = "after" if self.offset_s >= 0.0 else "before"
            by = "odometry" if self.odometry else "no odometry: taken to stand"
            lines.append(
                f"{abs(self.offset_s) * 1e3:.0f} ms {after} the middle of the scan of "
                f"{self.sweep.sensor}; in between the base moved {math.hypot(x_m, y_m) * 100:.1f} "
                f"cm and turned {math.degrees(yaw_rad):+.2f} deg ({by})"
            )
        return [*lines, *self.notes]


@dataclass(frozen=True, slots=True)
class RangeRows:
    """Ranges over bearings around the lidar (or around the camera, where there is no lidar).

    lidar  : (N, 2) bearing rad, range m, finite. camera : (M, 2), moved to the scan's time.
    limits : (K, 3) bearing, and the nearest and farthest range at which a camera's point would be
             associated with the lidar's beam there, if the surface is seen square on.
    fused  : (F, 2), and source : (F,) of each.
    """

    lidar: Array
    camera: Array
    limits: Array
    fused: Array
    source: npt.NDArray[np.uint8]


def fuse_moment(
    paths: Sequence[Path], reading: ReadOptions, config: Config, at_s: float
) -> FuseMoment:
    """The depth image nearest to a time, fused with the scan nearest to it.

    at_s : seconds from the first message of the recording, or, from 1e8 on, a stamp.

    Raises InputError if the time lies outside the recording, or it has no depth image around it
    that can be used.
    """
    config = config.model_copy(update={"sensors": "fused"})
    where = ", ".join(map(str, paths))
    opened = open_recording(paths, reading)
    if not opened.calibration.cameras:
        raise InputError(
            "there is no depth camera in it, so there is nothing to fuse",
            where=where,
            remedy="'slam check' says what is in it; name a topic with --camera",
        )
    first = next(iter(opened), None)
    if first is None:
        raise InputError("no message in it", where=where, remedy="'slam check' says what is in it")
    since_s = at_s - first.stamp_ns * 1e-9 if at_s >= ABSOLUTE_S else at_s
    at_ns = first.stamp_ns + round(since_s * 1e9)
    window = replace(reading, start_s=max(0.0, since_s - READ_S), duration_s=2.0 * READ_S)
    recording = open_recording(paths, window)
    messages = list(recording) if since_s >= 0.0 else []
    image = _nearest_image(messages, at_ns)
    if image is None:
        raise _nothing_there(opened, messages, first.stamp_ns, since_s, where)
    return _fused(recording, config, messages, image, (image.stamp_ns - first.stamp_ns) * 1e-9)


def range_rows(moment: FuseMoment) -> RangeRows:
    """What the third panel shows, from the same functions that fuse."""
    from fusion.compensation_kernels import GAMMA2  # noqa: PLC0415

    pseudo, sweep, fused = moment.pseudo, moment.sweep, moment.fused
    if sweep is None or fused is None:
        met = np.isfinite(pseudo.ranges_m)
        camera = np.column_stack([pseudo.bearings_rad[met], pseudo.ranges_m[met]])
        nothing = np.empty((0, 2))
        return RangeRows(nothing, camera, np.empty((0, 3)), nothing, np.empty(0, np.uint8))
    better, compensation = moment.config.fusion == "better", moment.config.compensation
    share = compensation.systematic_share if better else 0.0
    view = PlacedView(pseudo, moment.T_fused_view)
    placed = place_views(sweep, [view], np.zeros(3), share)
    returned = np.isfinite(sweep.ranges_m)
    compared = placed.beams >= 0
    beams = placed.beams[compared]
    compared[compared] = returned[beams]
    beams = beams[returned[beams]]
    variance = placed.sigma_m[compared] ** 2 + sweep.variance_m2[beams]
    if better:
        variance += (0.5 * placed.systematic_m[compared]) ** 2 + compensation.placing_m**2
    reach = np.sqrt(GAMMA2 * variance)
    limits = np.column_stack(
        [
            placed.bearings_rad[compared],
            sweep.ranges_m[beams] - reach,
            sweep.ranges_m[beams] + reach,
        ]
    )
    seen = fused.points_base - fused.origin_base
    return RangeRows(
        np.column_stack([sweep.bearings_rad[returned], sweep.ranges_m[returned]]),
        np.column_stack([placed.bearings_rad, placed.ranges_m]),
        limits[np.argsort(limits[:, 0], kind="stable")],
        np.column_stack([np.arctan2(seen[:, 1], seen[:, 0]), np.hypot(seen[:, 0], seen[:, 1])]),
        fused.source,
    )


def paper_labels(image: DepthImage, calibration: CameraCalibration, config: PaperConfig) -> Labels:
    """(H, W) what paper mode makes of the pixels: NEAREST is the smallest range in its column.

    Rows outside ``scan_height_px`` are out of the gate. The filter may move the minimum by a row.
    """
    assert calibration.intrinsics is not None  # a pseudo-scan came of this image
    first = math.ceil(float(calibration.intrinsics.K[1, 2]) - config.scan_height_px / 2)
    rows = slice(max(first, 0), first + config.scan_height_px)
    labels = np.full(image.depth_m.shape, TOO_HIGH, np.uint8)
    labels[rows] = BEHIND
    depth_m = np.where(image.depth_m[rows] > 0.0, image.depth_m[rows], np.inf)
    nearest, columns = depth_m.argmin(axis=0), np.arange(depth_m.shape[1])
    seen = np.isfinite(depth_m[nearest, columns])
    labels[rows][nearest[seen], columns[seen]] = NEAREST
    labels[~(image.depth_m > 0.0)] = HOLE
    return labels


def _fused(
    recording: Recording,
    config: Config,
    messages: Sequence[Message],
    image: DepthImage,
    image_s: float,
) -> FuseMoment:
    left_out: Counter[str] = Counter()
    motion = MotionModel(config.motion)
    fusing = Fusing(config, recording.calibration, motion, left_out)
    for message in messages:
        near = abs(message.stamp_ns - image.stamp_ns) < ODOMETRY_S * 1e9
        if isinstance(message, Odometry) and config.odometry and near:
            motion.add_odometry(message)
    pseudo = fusing.add_view(image)
    if pseudo is None:
        raise InputError(
            next(iter(left_out)), where=recording.name, remedy="'slam check' says more"
        )
    notes: list[str] = []
    sweep = fused = None
    T_scan_view = np.eye(3)
    scan = _nearest_scan(messages, fusing, image.stamp_ns)
    if scan is None:
        notes.append(f"no scan of a lidar within {AROUND_S:g} s: the pseudo-laser alone")
    else:
        fused = fusing.fused(scan)
        sweep = fusing.lidars[scan.lidar].sweep(scan)
        T_scan_view = motion.between(sweep.moment_ns, image.stamp_ns)
        if config.fusion == "paper":
            notes.append("paper mode does not make up for that motion")
        if abs(image.stamp_ns - sweep.moment_ns) > VIEW_AGE_S * 1e9:
            notes.append(f"more than {VIEW_AGE_S:g} s apart: a run does not fuse them")
    return FuseMoment(
        recording.name,
        config,
        image,
        image_s,
        _labels(image, recording.calibration, config),
        pseudo,
        sweep,
        fused,
        T_scan_view,
        motion.odometry_ns is not None,
        tuple(notes),
    )


def _labels(image: DepthImage, calibration: Calibration, config: Config) -> Labels:
    camera = calibration.cameras[image.camera]
    if config.fusion == "paper":
        return paper_labels(image, camera, config.paper)
    return DepthProjection(camera, config.depth).used_pixels(image)


def _nearest_image(messages: Sequence[Message], at_ns: int) -> DepthImage | None:
    images = [message for message in messages if isinstance(message, DepthImage)]
    near = [image for image in images if abs(image.stamp_ns - at_ns) <= AROUND_S * 1e9]
    return min(near, key=lambda image: abs(image.stamp_ns - at_ns), default=None)


def _nearest_scan(messages: Sequence[Message], fusing: Fusing, at_ns: int) -> LaserScan | None:
    """By the middle of its turn; of a lidar whose scans are matched, not of a lower one."""

    def away_ns(scan: LaserScan) -> float:
        middle_s = 0.5 * float(scan.beam_offsets_s.max(initial=0.0))
        return abs(scan.stamp_ns + middle_s * 1e9 - at_ns)

    scans = [each for each in messages if isinstance(each, LaserScan) and fusing.is_scan(each)]
    near = [scan for scan in scans if away_ns(scan) <= AROUND_S * 1e9]
    return min(near, key=away_ns, default=None)


def _nothing_there(
    opened: Recording, messages: Sequence[Message], first_ns: int, since_s: float, where: str
) -> InputError:
    """Why there is no image at a time: it lies outside, or the camera says nothing there."""
    stamps = [message.stamp_ns for message in messages]
    if stamps and (max(stamps) - first_ns) * 1e-9 >= since_s:
        return InputError(
            f"no depth image within {AROUND_S:g} s of {since_s:.2f} s",
            where=where,
            remedy="Give another time; 'slam check' says when the camera ran",
        )
    last_s = (max(message.stamp_ns for message in opened) - first_ns) * 1e-9
    return InputError(
        f"{since_s:.2f} s lies outside the recording, which lasts {last_s:.2f} s",
        where=where,
        remedy="Give --at in seconds from its first message, or a stamp in it",
    )
