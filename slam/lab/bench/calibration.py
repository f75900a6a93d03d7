"""Mountings of simulated cameras, estimated from 20 s of driving."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from datasets.calibration_file import T_BODY_OPTICAL, mounting
from datasets.errors import InputError
from datasets.messages import Array, Message
from datasets.simulation.place import DriveSpec, load_place
from datasets.simulation.place_file import RobotName
from datasets.simulation.robot import DEPTH, ROBOTS
from datasets.simulation.simulated_drive import SimulatedDrive
from datasets.trajectory import Trajectory
from fusion.calibration.estimate import CalibrationConfig, body_values, calibrate

SECONDS = 20.0
GUESS_OFF = np.array([0.08, 0.07, 0.10, *np.radians([4.0, 4.0, 5.0])])
"""So far the guess is off in each value, to one side or the other."""


@dataclass(frozen=True, slots=True)
class Mounted:
    """A robot that sets out from one of the way points of a place's first drive."""

    place: str
    robot: RobotName
    from_point: int
    seed: int


@dataclass(frozen=True, slots=True)
class Found:
    """errors : (6,) x, y, z m, roll, pitch, yaw rad; those not determined are NaN."""

    errors: tuple[float, ...]
    trouble: str = ""


class FirstSeconds:
    """The begin of a drive, as a recording."""

    def __init__(self, drive: SimulatedDrive, seconds: float) -> None:
        self.name, self.calibration, self.notes = drive.name, drive.calibration, drive.notes
        self._drive, self._end_ns = drive, drive.start_ns + int(seconds * 1e9)

    def __iter__(self) -> Iterator[Message]:
        for message in self._drive:
            if message.stamp_ns > self._end_ns:
                return
            yield message

    def ground_truth(self) -> Trajectory:
        return self._drive.ground_truth()


def estimated(mounted: Mounted) -> Found:
    """The errors of what ``slam calibrate`` estimates from the first seconds."""
    place = load_place(mounted.place)
    way = next(iter(place.drives.values())).way_points[mounted.from_point :]
    ahead = way[1] - way[0]
    spec = DriveSpec(way, start_yaw_rad=math.atan2(ahead[1], ahead[0]))
    robot = ROBOTS[mounted.robot].seeing(None, 5.0)
    drive = SimulatedDrive(place, spec, robot, mounted.seed)
    truth = body_values(robot.cameras[DEPTH].T_base_camera)
    signs = np.random.default_rng(mounted.seed).choice([-1.0, 1.0], 6)
    guess: Array = _T_base_camera(truth + signs * GUESS_OFF)
    recording = FirstSeconds(drive, SECONDS)
    try:
        result = calibrate(recording, CalibrationConfig(), Counter(), T_base_camera_guess=guess)
    except InputError as error:
        return Found((math.nan,) * 6, str(error))
    errors = np.where(np.isfinite(result.sigma), result.values - truth, np.nan)
    return Found(tuple(errors.tolist()), "; ".join(result.findings))


def _T_base_camera(values: Array) -> Array:
    x, y, z, roll, pitch, yaw = values.tolist()
    T: Array = mounting((x, y, z), (roll, pitch, yaw)) @ T_BODY_OPTICAL
    return T
