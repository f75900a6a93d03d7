"""What goes wrong on a drive: the base handled by people, silent sensors, a door that closes.

A base that is carried or turned by hand rolls nothing: its wheels know one motion (``rolled``), the
truth is another. The two differ by a rigid transform between one handling and the next.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from datasets.errors import InputError
from datasets.messages import Array
from datasets.se2 import wrap_rad
from datasets.simulation.drive import SHORTEST_LEG_M, Drive, DriveLimits, Stretch, plan_drive
from datasets.simulation.driver_messages import DriverPose
from datasets.simulation.place_checks import FreeSpace
from datasets.simulation.place_file import (
    CarriedSection,
    DoorClosedSection,
    LidarSilentSection,
    OdometryResetSection,
    TroubleSection,
    TurnedSection,
)
from datasets.simulation.place_geometry import segment_distances

TroubleKind = Literal["carried", "turned", "odometry-reset", "lidar-silent", "door-closed"]
KINDS: tuple[TroubleKind, ...] = get_args(TroubleKind)

CARRIED_M = (8.0, 25.0)
"""How far along its path a base is carried, where that is drawn."""

TURNED_DEG = (60.0, 150.0)
"""By how much it is turned to either side, where that is drawn."""

SILENT_S = 20.0
CARRY_M_S = 1.2
"""Someone with a robot in their arms walks so fast."""

DRAWN_BETWEEN = (0.3, 0.6)
"""Trouble that is drawn happens in this share of the drive."""

DOOR_SEEN_M, DOOR_CLEAR_M = 4.0, 0.4
"""A door that is drawn is passed within the first distance and never nearer than the second."""


@dataclass(frozen=True, slots=True)
class Handling:
    """The base in someone's hands from begin_s to end_s.

    path : (K, 2) m, map frame, K >= 1. yaw_rad, turn_rad : at its begin, and by how much it is
    turned on the way. Both start and end at rest.
    """

    begin_s: float
    end_s: float
    path: Array
    yaw_rad: float
    turn_rad: float

    def pose(self, times_s: Array) -> Array:
        """(N, 3) x m, y m, yaw rad within the handling."""
        share = np.clip((times_s - self.begin_s) / (self.end_s - self.begin_s), 0.0, 1.0)
        smooth = share**2 * (3.0 - 2.0 * share)
        along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.path, axis=0).T))])
        x_m, y_m = (np.interp(smooth * along_m[-1], along_m, axis) for axis in self.path.T)
        return np.column_stack([x_m, y_m, self.yaw_rad + smooth * self.turn_rad])

    def turn_rate(self, times_s: Array) -> Array:
        """(N,) rad/s within the handling: what a gyro feels."""
        duration_s = self.end_s - self.begin_s
        share = np.clip((times_s - self.begin_s) / duration_s, 0.0, 1.0)
        rate: Array = self.turn_rad * 6.0 * share * (1.0 - share) / duration_s
        return rate


@dataclass(frozen=True, slots=True)
class HandledDrive:
    """A drive on which the base is taken by hand: read as a ``Drive``, but for ``rolled``.

    rolled : what the wheels roll; it stands still during each handling.
    """

    rolled: Drive
    handlings: tuple[Handling, ...]

    @property
    def duration_s(self) -> float:
        return self.rolled.duration_s

    @property
    def length_m(self) -> float:
        """What the wheels roll."""
        return self.rolled.length_m

    def pose(self, times_s: npt.ArrayLike) -> Array:
        """T_map_base in truth at times (N,) s, as (N, 3); yaw is continuous, not wrapped."""
        times = np.clip(np.asarray(times_s, dtype=np.float64), 0.0, self.duration_s)
        poses = self.rolled.pose(times)
        for handling in self.handlings:
            ends = np.array([handling.begin_s, handling.end_s])
            rolled, true = self.rolled.pose(ends[1:])[0], handling.pose(ends)[1]
            after, within = times >= ends[1], (times >= ends[0]) & (times < ends[1])
            poses[after] = _moved(self.rolled.pose(times[after]), rolled, true)
            poses[within] = handling.pose(times[within])
        return poses

    def velocity(self, times_s: npt.ArrayLike) -> Array:
        """(N, 2): v m/s that the wheels roll, and the base's true omega rad/s."""
        times = np.asarray(times_s, dtype=np.float64)
        rates = self.rolled.velocity(times)
        for handling in self.handlings:
            rates[:, 1] += handling.turn_rate(times)
        return rates

    def travelled(self, times_s: npt.ArrayLike) -> Array:
        """(N, 2): what the wheels roll, m, and turn, rad."""
        return self.rolled.travelled(times_s)


def plan_handled(
    way_points: Array,
    limits: DriveLimits,
    events: Sequence[TroubleSection],
    *,
    start_yaw_rad: float,
    stand_s: float,
    space: FreeSpace,
    where: str,
) -> HandledDrive:
    """Drive through way points (K, 2), handled where the events say so; at rest before and after.

    Distances of events count along the legs that are driven. Raises InputError for events beyond
    the end of the drive, and where something stands in the way from where the base is set down.
    """
    ahead, yaw, driven_m, now_s = way_points, start_yaw_rad, 0.0, 0.0
    stretches: list[Stretch] = []
    handlings: list[Handling] = []
    wait_s = stand_s
    for event in sorted(events, key=lambda event: event.at_m):
        if not isinstance(event, CarriedSection | TurnedSection):
            continue
        driven, ahead = _cut(ahead, event.at_m - driven_m, event.at_m, where)
        part = plan_drive(driven, limits, start_yaw_rad=yaw, waits_s={0: wait_s})
        stretches += [*_stretches(part), Stretch(event.seconds)]
        now_s, driven_m, wait_s = now_s + part.duration_s, event.at_m, 0.0
        x_m, y_m, yaw = part.pose([part.duration_s])[0].tolist()
        path = np.array([[x_m, y_m]])
        if isinstance(event, CarriedSection):
            turn_rad = wrap_rad(math.radians(event.to[2]) - yaw)
            path = np.array([*path.tolist(), *event.via_m, event.to[:2]])
            if event.then_m is not None:
                ahead = np.array([path[-1], *event.then_m])
        else:
            turn_rad = math.radians(event.by_deg)
        ahead = np.vstack([path[-1:], ahead[1:]])
        fault = space.fault(ahead, closed=False)
        if fault is not None:
            raise InputError(
                f"after the base was {event.kind} at {event.at_m:g} m, {fault.what}",
                where=where,
                remedy="Set it down where it can drive on, or say how with `then_m` "
                "(docs/places.md)",
            )
        handlings.append(Handling(now_s, now_s + event.seconds, path, yaw, turn_rad))
        now_s, yaw = now_s + event.seconds, yaw + turn_rad
    legs_m = np.hypot(*np.diff(ahead, axis=0).T)
    ahead = ahead[np.concatenate([[True], legs_m > SHORTEST_LEG_M])]
    stretches += _stretches(plan_drive(ahead, limits, start_yaw_rad=yaw, waits_s={0: wait_s}))
    start = (float(way_points[0, 0]), float(way_points[0, 1]), start_yaw_rad)
    return HandledDrive(Drive.chained(stretches, start), tuple(handlings))


def time_at_s(drive: Drive | HandledDrive, at_m: float, where: str) -> float:
    """When the wheels have rolled so far. Raises InputError if they never do."""
    if at_m > drive.length_m:
        raise _beyond(at_m, drive.length_m, where)
    low_s, high_s = 0.0, drive.duration_s
    while high_s - low_s > 1e-6:
        middle_s = (low_s + high_s) / 2.0
        if drive.travelled([middle_s])[0, 0] < at_m:
            low_s = middle_s
        else:
            high_s = middle_s
    return high_s


def restarted(poses: Iterator[DriverPose], resets_ns: Sequence[int]) -> Iterator[DriverPose]:
    """Odometry that starts at zero again: the first pose at or after each reset is the origin."""
    zero = np.zeros(3)
    waiting = sorted(resets_ns)
    for pose in poses:
        while waiting and pose.stamp_ns >= waiting[0]:
            waiting.pop(0)
            zero = pose.xyyaw
        yield replace(pose, xyyaw=_moved(pose.xyyaw[None], zero, np.zeros(3))[0])


def drawn_trouble(
    kind: TroubleKind,
    way_points: Array,
    doors: Mapping[str, tuple[Array, Array]],
    seed: int,
    where: str,
) -> TroubleSection:
    """Trouble of a kind on a drive, drawn from the seed.

    way_points : (K, 2) m, all that are driven. doors : of each open door the ends of its leaf when
    it is closed, hinge and tip, (2,) m each. A base is carried along its own path, past some of
    it, and goes on from there. A door is closed between two passages. Raises InputError where none
    can be.
    """
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(99, KINDS.index(kind))))
    steps_m = np.hypot(*np.diff(way_points, axis=0).T)
    length_m = float(steps_m.sum())
    at_m = round(length_m * random.uniform(*DRAWN_BETWEEN), 2)
    if kind == "turned":
        by_deg = round(random.uniform(*TURNED_DEG) * random.choice([-1.0, 1.0]), 1)
        return TurnedSection(kind="turned", at_m=at_m, by_deg=by_deg)
    if kind == "odometry-reset":
        return OdometryResetSection(kind="odometry_reset", at_m=at_m)
    if kind == "lidar-silent":
        return LidarSilentSection(kind="lidar_silent", at_m=at_m, seconds=SILENT_S)
    if kind == "door-closed":
        return _drawn_door(way_points, doors, random, where)
    far_m = min(random.uniform(*CARRIED_M), 0.5 * (length_m - at_m))
    _, ahead = _cut(way_points, at_m, at_m, where)
    carried, then = _cut(ahead, far_m, at_m + far_m, where)
    heading = then[1] - then[0]
    yaw_deg = math.degrees(math.atan2(heading[1], heading[0])) + random.uniform(-60.0, 60.0)
    return CarriedSection(
        kind="carried",
        at_m=at_m,
        to=(float(then[0, 0]), float(then[0, 1]), math.remainder(yaw_deg, 360.0)),
        seconds=round(1.0 + far_m / CARRY_M_S, 1),
        via_m=tuple((float(x), float(y)) for x, y in carried[1:-1]),
        then_m=tuple((float(x), float(y)) for x, y in then[1:]),
    )


def _drawn_door(
    way_points: Array,
    doors: Mapping[str, tuple[Array, Array]],
    random: np.random.Generator,
    where: str,
) -> DoorClosedSection:
    chances: list[DoorClosedSection] = []
    for name, (hinge, tip) in doors.items():
        near_m = [
            float(segment_distances(a, b, hinge[None], tip[None])[0])
            for a, b in pairwise(way_points)
        ]
        passed = [index for index, distance_m in enumerate(near_m) if distance_m < DOOR_SEEN_M]
        if len(passed) < 2 or min(near_m) < DOOR_CLEAR_M:
            continue
        ends_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way_points, axis=0).T))])
        for first, second in pairwise(passed):
            if second - first > 1:
                at_m = round(float(ends_m[first + 1] + ends_m[second]) / 2.0, 2)
                chances.append(DoorClosedSection(kind="door_closed", at_m=at_m, door=name))
    if not chances:
        raise InputError(
            "no open door is passed twice on this drive",
            where=where,
            remedy="Choose another drive, or say which door closes: `trouble` (docs/places.md)",
        )
    return chances[int(random.integers(len(chances)))]


def _cut(points: Array, at_m: float, asked_m: float, where: str) -> tuple[Array, Array]:
    """Way points up to a distance along their legs, and from there on; both hold the place."""
    ends_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    if not 0.0 < at_m < ends_m[-1] - SHORTEST_LEG_M:
        raise _beyond(asked_m, asked_m - at_m + float(ends_m[-1]), where)
    place = np.array([np.interp(at_m, ends_m, axis) for axis in points.T])
    before = points[ends_m < at_m - SHORTEST_LEG_M]
    after = points[ends_m > at_m + SHORTEST_LEG_M]
    return np.vstack([before, place]), np.vstack([place, after])


def _stretches(drive: Drive) -> list[Stretch]:
    durations_s = np.diff(drive.starts_s)
    rows = np.column_stack([durations_s, drive.motions[:-1]])
    return [Stretch(*row) for row in rows.tolist()]


def _moved(poses: Array, origin: Array, target: Array) -> Array:
    """Poses (N, 3) by the motion that takes one pose, (3,), to another; yaw isn't wrapped."""
    turn = target[2] - origin[2]
    place = (poses[:, 0] - origin[0] + 1j * (poses[:, 1] - origin[1])) * np.exp(1j * turn)
    return np.column_stack([place.real + target[0], place.imag + target[1], poses[:, 2] + turn])


def _beyond(at_m: float, length_m: float, where: str) -> InputError:
    return InputError(
        f"trouble at {at_m:g} m of a drive that is {length_m:.1f} m long there",
        where=where,
        remedy="Let `at_m` rise from event to event and end within the drive (docs/places.md)",
    )
