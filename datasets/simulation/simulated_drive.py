"""A robot driving through a place, as a recording: made while it is read, never held whole."""

from __future__ import annotations

import heapq
import math
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from datasets.errors import InputError
from datasets.messages import Message
from datasets.recording import Calibration, CameraCalibration, Intrinsics, LidarCalibration
from datasets.simulation.depth_camera import MODES, simulate_depth, to_millimetres
from datasets.simulation.drive import Drive, DriveLimits, plan_drive
from datasets.simulation.driver_messages import DriverDepth, DriverMessage, DriverPose, DriverTurn
from datasets.simulation.lidar import simulate_turns
from datasets.simulation.odometry import odometry, true_poses
from datasets.simulation.place import DriveSpec, Place, with_door_closing
from datasets.simulation.place_file import (
    CarriedSection,
    DoorClosedSection,
    LidarSilentSection,
    OdometryResetSection,
    TurnedSection,
)
from datasets.simulation.robot import MountedCamera, MountedLidar, Robot
from datasets.simulation.scene import Scene
from datasets.simulation.trouble import HandledDrive, plan_handled, restarted, time_at_s
from datasets.tf_tree import standing
from datasets.trajectory import Trajectory

START_NS = 1_700_000_000_000_000_000

SHORTEST_S = 1.0
"""A drive that is over sooner is a mistake: no scan may come of it."""

# What the random numbers of lidars and cameras begin with; `wheels.py` has the numbers below.
_SENSORS = 10


class SimulatedDrive:
    """A ``Recording`` of a robot on one of a place's drives, or on a drive of your own.

    laps   : how often a closed drive is driven, without a stop in between.
    people : False leaves out all that moves.

    The same arguments give the same messages, bit by bit, each time it is iterated. Each sensor
    draws from a stream of random numbers of its own: one that is added or left out changes
    nothing of the others. Memory doesn't grow with the length of the drive.

    Raises InputError for several laps of a drive that is not closed, and for a drive that is over
    in less than ``SHORTEST_S``.
    """

    def __init__(
        self,
        place: Place,
        spec: DriveSpec,
        robot: Robot,
        seed: int,
        *,
        start_ns: int = START_NS,
        laps: int = 1,
        people: bool = True,
        limits: DriveLimits | None = None,
    ) -> None:
        self.name = place.name
        self.robot = robot
        self.start_ns = start_ns
        self.drive = _planned(place, spec, laps, limits or DriveLimits())
        self.calibration = Calibration(
            {name: LidarCalibration(each.T_base_lidar) for name, each in robot.lidars.items()},
            {name: _calibrated(each) for name, each in robot.cameras.items()},
        )
        self.notes: Counter[str] = Counter()
        where = f"{place.name}, its drive"
        begins_s = [
            (time_at_s(self.drive, event.at_m, where), event)
            for event in spec.trouble
            if not isinstance(event, CarriedSection | TurnedSection)
        ]
        seen = place if people else replace(place, movers=())
        for begin_s, event in begins_s:
            if isinstance(event, DoorClosedSection):
                seen = with_door_closing(seen, event.door, begin_s, begin_s + event.seconds)
        self._scene = Scene(seen)
        self._silent_s = [
            (begin_s, begin_s + event.seconds)
            for begin_s, event in begins_s
            if isinstance(event, LidarSilentSection)
        ]
        self._resets_ns = [
            start_ns + round(begin_s * 1e9)
            for begin_s, event in begins_s
            if isinstance(event, OdometryResetSection)
        ]
        self._seed = seed

    def __iter__(self) -> Iterator[Message]:
        """In order of the stamps, odometry first, as a reader of the bag gives them."""
        self.notes.clear()
        ordered = heapq.merge(
            *self._sensors(), key=lambda raw: (raw.stamp_ns, not isinstance(raw, DriverPose))
        )
        for raw in ordered:
            yield raw.as_read(self.notes)

    def driver_messages(self, *, images: bool = True) -> Iterator[DriverMessage]:
        """What the drivers publish, and the true poses, in the order in which they do.

        That is not the order of the stamps: a turn of a lidar is published at its end.
        """
        truth = true_poses(self.drive, self.start_ns)
        sensors = self._sensors(images=images)
        return heapq.merge(truth, *sensors, key=lambda raw: raw.published_ns)

    def ground_truth(self) -> Trajectory:
        """T_map_base at ``odometry.TRUTH_RATE_HZ``."""
        stamps_ns, poses = [], []
        for raw in true_poses(self.drive, self.start_ns):
            stamps_ns.append(raw.stamp_ns)
            poses.append(raw.as_read(self.notes).T_odom_base)
        return Trajectory.from_matrices(stamps_ns, poses)

    def image_count(self, topic: str) -> int:
        """How many depth images a camera takes: none if the drive is over before its first."""
        taking_s = self.drive.duration_s - self._first_image_s(topic)
        return max(0, math.floor(taking_s * self.robot.cameras[topic].rate_hz) + 1)

    def image(self, topic: str, index: int) -> DriverDepth:
        """One of a camera's depth images; each has random numbers of its own."""
        camera = self.robot.cameras[topic]
        time_s = self._first_image_s(topic) + index / camera.rate_hz
        T_map_camera = standing(self.drive.pose([time_s])[0]) @ camera.T_base_camera
        random = self._random(topic, index)
        depth_m = simulate_depth(self._scene, T_map_camera, camera.model, random, time_s)
        stamp_ns = self.start_ns + round(time_s * 1e9)
        return DriverDepth(stamp_ns, topic, to_millimetres(depth_m))

    def _first_image_s(self, topic: str) -> float:
        return float(self._random(topic).uniform(0.0, 1.0 / self.robot.cameras[topic].rate_hz))

    def _sensors(self, *, images: bool = True) -> list[Iterator[DriverMessage]]:
        """One stream of each sensor, in order of its stamps."""
        robot = self.robot
        poses = odometry(self.drive, robot, self._seed, self.start_ns)
        if self._resets_ns:
            poses = restarted(poses, self._resets_ns)
        streams: list[Iterator[DriverMessage]] = [poses]
        streams += [self._turns(name, lidar) for name, lidar in sorted(robot.lidars.items())]
        if images:
            streams += [self._images(name) for name in sorted(robot.cameras)]
        return streams

    def _images(self, topic: str) -> Iterator[DriverMessage]:
        for index in range(self.image_count(topic)):
            yield self.image(topic, index)

    def _turns(self, topic: str, lidar: MountedLidar) -> Iterator[DriverMessage]:
        random = self._random(topic)
        turns = simulate_turns(
            self._scene,
            self.drive.pose,
            lidar.T_base_lidar,
            lidar.model,
            random,
            # Nobody switches sensors on at the same instant.
            start_s=float(random.uniform(0.0, 1.0 / lidar.model.turn_rate_hz)),
            end_s=self.drive.duration_s,
        )
        for turn in turns:
            end_s = turn.stamp_s + turn.scan_time_s
            if any(turn.stamp_s < until_s and end_s > from_s for from_s, until_s in self._silent_s):
                continue
            yield DriverTurn(self.start_ns + round(turn.stamp_s * 1e9), topic, turn)

    def _random(self, topic: str, *index: int) -> np.random.Generator:
        """A sensor's stream of random numbers, the same whatever other sensors there are."""
        key = (_SENSORS, zlib.crc32(topic.encode()), *index)
        return np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=key))


def _planned(place: Place, spec: DriveSpec, laps: int, limits: DriveLimits) -> Drive | HandledDrive:
    if laps < 1 or (laps > 1 and not spec.closed):
        raise InputError(
            f"{laps} laps of a drive that is not closed" if laps > 1 else f"{laps} laps",
            where=f"{place.name}, its drive",
            remedy="Drive it once, or close it (`closed: true` in the file, docs/places.md)",
        )
    drive: Drive | HandledDrive
    if any(isinstance(event, CarriedSection | TurnedSection) for event in spec.trouble):
        drive = plan_handled(
            spec.driven(laps),
            limits,
            spec.trouble,
            start_yaw_rad=spec.start_yaw_rad,
            stand_s=spec.stand_s,
            space=place.space,
            where=f"{place.name}, its drive",
        )
    else:
        drive = _undisturbed(spec, laps, limits)
    if drive.duration_s < SHORTEST_S:
        raise InputError(
            f"the drive is over after {drive.duration_s:.1f} s",
            where=f"{place.name}, its drive",
            remedy="Give it more way points, or let it stand: `stand_s` (docs/places.md)",
        )
    return drive


def _undisturbed(spec: DriveSpec, laps: int, limits: DriveLimits) -> Drive:
    return plan_drive(
        np.tile(spec.way_points, (laps, 1)),
        limits,
        start_yaw_rad=spec.start_yaw_rad,
        closed=spec.closed,
        waits_s={0: spec.stand_s},
    )


def _calibrated(camera: MountedCamera) -> CameraCalibration:
    mode = MODES[camera.model.mode]
    intrinsics = Intrinsics(camera.model.K, mode.width, mode.height)
    return CameraCalibration(camera.T_base_camera, intrinsics)
