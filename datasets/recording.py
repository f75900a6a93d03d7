"""What every reader gives: a stream of messages with its calibration and its ground truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

from datasets.messages import Array, Message
from datasets.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class LidarCalibration:
    """How one lidar stands on the base.

    T_base_lidar : (4, 4) float64; upside down, backwards or tilted mountings included.
    masks_rad    : bearing intervals (from, to), counter-clockwise in the lidar frame, whose beams
                   see the robot itself and are left out.
    """

    T_base_lidar: Array
    masks_rad: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole without distortion. K : (3, 3) float64, px; of images width_px x height_px."""

    K: Array
    width_px: int
    height_px: int


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """How one camera stands on the base, and its pinhole; None where nothing says it.

    T_base_camera : (4, 4) float64, of the optical frame (z forward, x right, y down).
    """

    T_base_camera: Array | None
    intrinsics: Intrinsics | None


@dataclass(slots=True)
class Calibration:
    """What is known of the sensors, by name.

    A reader may fill it while it reads.
    """

    lidars: dict[str, LidarCalibration] = field(default_factory=dict)
    cameras: dict[str, CameraCalibration] = field(default_factory=dict)


class Recording(Protocol):
    """A time-ordered stream of messages.

    Iterating starts from the beginning each time, keeps no more than a short window in memory,
    and yields only messages that are well-formed (a bad one is left out and counted).
    Every scan's lidar is in ``calibration.lidars`` by the time the scan is yielded, and every depth
    image's camera in ``calibration.cameras``, with a pinhole of the image's size, and its mounting
    unless cameras without one were asked for (``ReadOptions.unmounted_cameras``).
    ``notes`` counts, in the words of the report, what was changed or left out on reading, such
    as ``"scan left out: stamp runs backwards"``. ``ground_truth`` is None where there is none.
    """

    name: str
    calibration: Calibration
    notes: Counter[str]

    def __iter__(self) -> Iterator[Message]: ...

    def ground_truth(self) -> Trajectory | None: ...
