"""Way points turned into the motion of a base with two driven wheels.

A drive is a chain of stretches, each with a constant acceleration a and a constant turning
acceleration alpha, so v and omega are continuous and linear in each. Legs between way points are
straight; v rises, holds and falls on them. A corner is rounded at constant v, while omega rises,
holds and falls (two clothoids with an arc between them), as fast as the room on its legs, the
miss that is allowed and the braking distances permit; where that would be slower than
``CREEP_M_S`` the base stops and turns on the spot. It never drives backwards.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field

from datasets.messages import Array
from datasets.se2 import wrap_rad
from datasets.section import Section

CREEP_M_S = 0.1
"""A corner that could only be taken slower than this is turned on the spot."""

SHORTEST_LEG_M = 0.001

# Gauss-Legendre on 0..1: with 8 nodes the way round half a turn is right to 1e-14 of its length.
_NODES, _WEIGHTS = (np.polynomial.legendre.leggauss(8) + np.array([[1.0], [0.0]])) / 2.0


class DriveLimits(Section):
    """How fast a base drives and how closely it follows its way points."""

    speed_m_s: float = Field(0.5, ge=CREEP_M_S, le=5.0)
    turn_rate_rad_s: float = Field(0.6, gt=0.0, le=5.0)
    acceleration_m_s2: float = Field(0.4, gt=0.0, le=10.0)
    turn_acceleration_rad_s2: float = Field(1.0, gt=0.0, le=20.0)
    corner_miss_m: float = Field(
        0.3, ge=0.0, le=5.0, description="a rounded corner passes its way point within this"
    )


class Stretch(NamedTuple):
    """Motion for a while: v = speed + acceleration t, omega = turn_rate + turn_acceleration t."""

    duration_s: float
    speed_m_s: float = 0.0
    acceleration_m_s2: float = 0.0
    turn_rate_rad_s: float = 0.0
    turn_acceleration_rad_s2: float = 0.0


@dataclass(frozen=True, slots=True)
class Drive:
    """The motion of the base in the map frame, for times from 0 to ``duration_s``.

    Before and after, the base stands still where it begins and ends.

    starts_s : (M,) float64, when each stretch begins; the last stands still for ever.
    starts   : (M, 5) float64, there: x m, y m, yaw rad (map frame, never wrapped), and the way m
               and the turn rad (either direction counts) since the start.
    motions  : (M, 4) float64, there: v m/s, a m/s^2, omega rad/s, alpha rad/s^2.
    """

    starts_s: Array
    starts: Array
    motions: Array

    @classmethod
    def chained(cls, stretches: Sequence[Stretch], start_xyyaw: tuple[float, float, float]) -> Self:
        """A drive of stretches one after the other; its end is held."""
        rows = np.array([s for s in stretches if s.duration_s > 0.0] + [Stretch(0.0)])
        durations_s, motions = rows[:, 0], rows[:, 1:]
        way_m, turn_rad = _way_and_turn(motions, durations_s)
        yaws = start_xyyaw[2] + _running(turn_rad)
        steps_m = _displacement(motions, yaws, durations_s)
        x_m, y_m = start_xyyaw[0] + _running(steps_m[0]), start_xyyaw[1] + _running(steps_m[1])
        starts = np.column_stack([x_m, y_m, yaws, _running(way_m), _running(np.abs(turn_rad))])
        return cls(_running(durations_s), starts, motions)

    @property
    def duration_s(self) -> float:
        return float(self.starts_s[-1])

    @property
    def rolled(self) -> Drive:
        """What the wheels roll: all of it, since nobody takes the base by hand."""
        return self

    @property
    def length_m(self) -> float:
        """The whole way."""
        return float(self.starts[-1, 3])

    def pose(self, times_s: npt.ArrayLike) -> Array:
        """T_map_base at times (N,) s, as (N, 3) x m, y m, yaw rad; yaw is continuous, not wrapped.

        The integral of ``velocity`` to about 1e-14 of the way.
        """
        index, since_s = self._located(times_s)
        motions, starts = self.motions[index], self.starts[index]
        steps_m = _displacement(motions, starts[:, 2], since_s)
        turn_rad = _way_and_turn(motions, since_s)[1]
        poses: Array = starts[:, :3] + np.column_stack([*steps_m, turn_rad])
        return poses

    def velocity(self, times_s: npt.ArrayLike) -> Array:
        """(N, 2) at times (N,) s: v m/s along the base's x axis, omega rad/s."""
        index, since_s = self._located(times_s)
        motions = self.motions[index]
        rates: Array = motions[:, [0, 2]] + motions[:, [1, 3]] * since_s[:, None]
        return rates

    def travelled(self, times_s: npt.ArrayLike) -> Array:
        """(N, 2) from the start to times (N,) s: way m and turn rad, either direction counted."""
        index, since_s = self._located(times_s)
        way_m, turn_rad = _way_and_turn(self.motions[index], since_s)
        totals: Array = self.starts[index, 3:] + np.column_stack([way_m, np.abs(turn_rad)])
        return totals

    def _located(self, times_s: npt.ArrayLike) -> tuple[npt.NDArray[np.intp], Array]:
        """The stretch of each time, and the seconds since it began."""
        held_s = np.clip(np.asarray(times_s, dtype=np.float64), 0.0, self.duration_s)
        index = np.searchsorted(self.starts_s, held_s, side="right") - 1
        return index, held_s - self.starts_s[index]


def plan_drive(
    way_points: npt.ArrayLike,
    limits: DriveLimits,
    *,
    start_yaw_rad: float | None = None,
    closed: bool = False,
    waits_s: Mapping[int, float] | None = None,
) -> Drive:
    """Drive from rest at the first way point past all others to rest at the last.

    way_points    : (K, 2) m, map frame, K >= 1; one alone, with a wait, is a base that stands.
    start_yaw_rad : where the base looks at first; it turns to its first leg on the spot. Without,
                    it looks along that leg.
    closed        : go back to the first way point and end in the very pose of the start.
    waits_s       : seconds to stand at a way point, by its index; the return of a closed drive
                    has index K.

    Every way point is passed within ``limits.corner_miss_m``, and no part of the drive is further
    from its legs than that. Raises ValueError for points that are not finite or follow each other
    within 1 mm, and for waits that are negative or at no way point.
    """
    points = np.asarray(way_points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not points.size or not np.isfinite(points).all():
        raise ValueError(f"way points must be finite (K, 2), not {points.shape}")
    if closed:
        points = np.vstack([points, points[:1]])
    legs = np.diff(points, axis=0)
    lengths_m = np.hypot(*legs.T)
    if (lengths_m < SHORTEST_LEG_M).any():
        index = int(np.argmin(lengths_m))
        raise ValueError(f"way points {index} and {index + 1} are the same place")
    waits = {**(waits_s or {})}
    for index, wait_s in waits.items():
        if not (0 <= index < len(points) and math.isfinite(wait_s) and wait_s >= 0.0):
            raise ValueError(f"cannot wait {wait_s} s at way point {index} of {len(points)}")

    headings = np.arctan2(legs[:, 1], legs[:, 0]).tolist()
    start_yaw = start_yaw_rad if start_yaw_rad is not None else (headings or [0.0])[0]
    if not math.isfinite(start_yaw):
        raise ValueError(f"start yaw {start_yaw} is not finite")
    end_yaw = start_yaw if closed else (headings or [start_yaw])[-1]
    towards = [start_yaw, *headings, end_yaw]
    corners = [_corner(wrap_rad(after - before), limits) for before, after in pairwise(towards)]
    stops = {index for index, wait_s in waits.items() if wait_s > 0.0} | {0, len(points) - 1}
    speeds = _corner_speeds(corners, lengths_m.tolist(), stops, limits)
    stretches: list[Stretch] = []
    for index, (corner, speed) in enumerate(zip(corners, speeds, strict=True)):
        stretches += [Stretch(waits.get(index, 0.0)), *_turn(corner.turn_rad, speed, limits)]
        if index < len(lengths_m):
            after, speed_after = corners[index + 1], speeds[index + 1]
            cuts_m = speed * corner.cut_s + speed_after * after.cut_s
            stretches += _straight(lengths_m[index] - cuts_m, speed, speed_after, limits)
    return Drive.chained(stretches, (points[0, 0], points[0, 1], start_yaw))


class _Corner(NamedTuple):
    """A turn taken at constant speed; what it needs grows with that speed.

    cut_s  : it leaves its legs so many metres from the way point for each m/s.
    miss_s : and passes the way point at so many.
    """

    turn_rad: float
    cut_s: float
    miss_s: float


def _corner(turn_rad: float, limits: DriveLimits) -> _Corner:
    stretches = _turn(turn_rad, 1.0, limits)
    drive = Drive.chained(stretches, (0.0, 0.0, 0.0))
    middle, end = drive.pose([drive.duration_s / 2.0, drive.duration_s])
    # Both legs are tangents, the turn is symmetric: they meet at equal distances from its ends.
    cut_s = math.hypot(end[0], end[1]) / (2.0 * math.cos(turn_rad / 2.0))
    return _Corner(turn_rad, cut_s, math.hypot(cut_s - middle[0], middle[1]))


def _corner_speeds(
    corners: Sequence[_Corner], lengths_m: Sequence[float], stops: set[int], limits: DriveLimits
) -> list[float]:
    """The speed at each way point, 0 where the base stops: the highest that all limits allow."""
    speeds = [
        0.0 if index in stops else min(limits.speed_m_s, _ratio(limits.corner_miss_m, c.miss_s))
        for index, c in enumerate(corners)
    ]
    speeds = [_no_creep(speed) for speed in speeds]
    # Two corners share the leg between them; one that is turned on the spot leaves it all.
    for index in range(1, len(corners) - 1):
        before, after = lengths_m[index - 1], lengths_m[index]
        room_m = min(
            before / 2.0 if speeds[index - 1] > 0.0 else before,
            after / 2.0 if speeds[index + 1] > 0.0 else after,
        )
        speeds[index] = _no_creep(min(speeds[index], _ratio(room_m, corners[index].cut_s)))
    settled = False
    while not settled:  # ends, since speeds only fall, and those that fall too low become 0
        ahead = _reachable(speeds, corners, lengths_m, limits.acceleration_m_s2)
        back = _reachable(ahead[::-1], corners[::-1], lengths_m[::-1], limits.acceleration_m_s2)
        lowered = [_no_creep(speed) for speed in back[::-1]]
        settled = lowered == back[::-1]
        speeds = lowered
    return speeds


def _reachable(
    speeds: Sequence[float], corners: Sequence[_Corner], lengths_m: Sequence[float], a_m_s2: float
) -> list[float]:
    """The speeds lowered to what acceleration reaches from each way point to the next.

    v^2 = u^2 + 2 a (length - u cut_u - v cut_v), solved for v.
    """
    out = list(speeds)
    for index, length_m in enumerate(lengths_m):
        before, cut_s = out[index], corners[index + 1].cut_s
        free_m = length_m - before * corners[index].cut_s
        brake = a_m_s2 * cut_s
        reached = math.sqrt(brake**2 + before**2 + 2.0 * a_m_s2 * free_m) - brake
        out[index + 1] = min(out[index + 1], reached)
    return out


def _ratio(space_m: float, space_s: float) -> float:
    return space_m / space_s if space_s > 0.0 else math.inf


def _no_creep(speed: float) -> float:
    return speed if speed >= CREEP_M_S else 0.0


def _turn(turn_rad: float, speed: float, limits: DriveLimits) -> list[Stretch]:
    """A turn at constant speed (0: on the spot): omega rises, holds and falls."""
    if turn_rad == 0.0:
        return []
    size, alpha = abs(turn_rad), math.copysign(limits.turn_acceleration_rad_s2, turn_rad)
    peak = min(limits.turn_rate_rad_s, math.sqrt(size * abs(alpha)))
    ramp_s = peak / abs(alpha)
    omega = math.copysign(peak, turn_rad)
    return [
        Stretch(ramp_s, speed, 0.0, 0.0, alpha),
        Stretch(max(0.0, size / peak - ramp_s), speed, 0.0, omega, 0.0),
        Stretch(ramp_s, speed, 0.0, omega, -alpha),
    ]


def _straight(
    length_m: float, speed: float, speed_after: float, limits: DriveLimits
) -> list[Stretch]:
    """A leg, or what corners leave of it: v rises, holds and falls to the speed after it."""
    a, length_m = limits.acceleration_m_s2, max(0.0, length_m)
    highest = math.sqrt((speed**2 + speed_after**2) / 2.0 + a * length_m)
    peak = max(min(limits.speed_m_s, highest), speed, speed_after)
    ramps_m = (2.0 * peak**2 - speed**2 - speed_after**2) / (2.0 * a)
    return [
        Stretch((peak - speed) / a, speed, a),
        Stretch(max(0.0, length_m - ramps_m) / max(peak, CREEP_M_S), peak),
        Stretch((peak - speed_after) / a, peak, -a),
    ]


def _running(steps: Array) -> Array:
    """(M,): the sum of all steps before each."""
    return np.concatenate([[0.0], np.cumsum(steps[:-1])])


def _way_and_turn(motions: Array, since_s: Array) -> tuple[Array, Array]:
    """Way m and turn rad, (N,) each, of motions (N, 4) after (N,) s."""
    speed, a, omega, alpha = motions.T
    way_m: Array = since_s * (speed + 0.5 * a * since_s)
    turn_rad: Array = since_s * (omega + 0.5 * alpha * since_s)
    return way_m, turn_rad


def _displacement(motions: Array, yaws: Array, since_s: Array) -> Array:
    """(2, N) m, map frame, of motions (N, 4) that begin at yaws (N,), after (N,) s.

    The integral of v (cos yaw, sin yaw), by Gauss-Legendre: there is no closed form of it that
    keeps its digits from straights to clothoids.
    """
    speed, a, omega, alpha = motions.T
    at_s = _NODES[:, None] * since_s
    heading = yaws + at_s * (omega + 0.5 * alpha * at_s)
    step_m = (speed + a * at_s) * (_WEIGHTS[:, None] * since_s)
    return np.stack([(step_m * np.cos(heading)).sum(0), (step_m * np.sin(heading)).sum(0)])
