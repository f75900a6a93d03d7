"""Ways of what moves: boxes that follow a path, people whose legs step."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from datasets.messages import Array
from datasets.simulation.place_file import MotionSection, PersonSection
from datasets.simulation.place_geometry import Prism, column, cuboid

TURN_RAD_S = 2.5
"""How fast one turns on the spot at the corners of a path."""

STRIDE_S = 1.0
"""Two steps of a walking person take about so long."""

TURN_STEPS = 8


@dataclass(frozen=True, slots=True)
class Track:
    """Where a body is when; linear in between.

    stamps_s : (K,) from 0. xyyaw : (K, 3), yaw without jumps. loop : whether it starts again.
    """

    prisms: tuple[Prism, ...]
    stamps_s: Array
    xyyaw: Array
    loop: bool


def box_track(prism: Prism, motion: MotionSection) -> Track:
    """A box that goes along a path."""
    return Track((prism,), *_walk(motion, stride=0.0, aside_m=0.0), motion.repeat != "once")


def person_tracks(person: PersonSection) -> Iterator[tuple[str, Track]]:
    """Left leg, right leg and body. A foot on the floor stands still, the other swings past it."""
    hip_m = 0.47 * person.height_m
    leg = (column((0.0, 0.0), 0.06, hip_m, 0.0, sides=12),)
    trunk = cuboid((0.0, 0.0), (0.24, 0.44, 0.38 * person.height_m), hip_m)
    neck_m = 0.85 * person.height_m
    head = column((0.0, 0.0), 0.09, person.height_m - neck_m, neck_m, sides=12)
    loop = person.repeat != "once"
    for name, stride, aside_m in (("left leg", 1.0, 0.1), ("right leg", -1.0, -0.1)):
        yield name, Track(leg, *_walk(person, stride, aside_m), loop)
    yield "body", Track((trunk, head), *_walk(person, 0.0, 0.0), loop)


def _walk(motion: MotionSection, stride: float, aside_m: float) -> tuple[Array, Array]:
    """Stamps and poses along the path, turning on the spot at its corners.

    stride  : 1 or -1 for a foot that begins forward or backward, 0 for the middle of the body.
    aside_m : how far to the left of the path.
    """
    points = [np.array(point) for point in motion.path_m]
    if motion.repeat == "circle":
        points.append(points[0])
    elif motion.repeat == "to-and-fro":
        points += points[-2::-1]
    legs = [b - a for a, b in pairwise(points)]
    yaws = [math.atan2(leg[1], leg[0]) for leg in legs]
    stamps: list[float] = []
    rows: list[tuple[float, float, float]] = []
    time_s, yaw = motion.start_s, yaws[0]

    def stand(at_s: float, point: Array, along_m: float, heading: float) -> None:
        c, s = math.cos(heading), math.sin(heading)
        stamps.append(at_s)
        rows.append(
            (
                float(point[0] + along_m * c - aside_m * s),
                float(point[1] + along_m * s + aside_m * c),
                heading,
            )
        )

    if time_s > 0.0:
        stand(0.0, points[0], 0.0, yaw)
    for index, (start, leg) in enumerate(zip(points, legs, strict=False)):
        length_m = float(np.linalg.norm(leg))
        walk_s = length_m / motion.speed_m_s
        cycles = max(1, round(walk_s / STRIDE_S)) if stride else 1
        reach_m = stride * length_m / cycles / 4
        # Half a cycle the foot stands (the body gains on it), half a cycle it swings.
        quarters = (0.0, 0.25, 0.75) if stride else (0.0,)
        for cycle in range(cycles):
            for quarter, ahead_m in zip(quarters, (0.0, reach_m, -reach_m), strict=False):
                share = (cycle + quarter) / cycles
                stand(time_s + share * walk_s, start, share * length_m + ahead_m, yaw)
        time_s += walk_s
        last = index + 1 == len(legs)
        stand(time_s, start + leg, 0.0, yaw)
        if last and motion.repeat == "once":
            break
        turn = math.remainder(yaws[(index + 1) % len(yaws)] - yaw, 2 * math.pi)
        if abs(turn) < 1e-9:
            continue
        turn_s = abs(turn) / TURN_RAD_S
        for step in range(1, TURN_STEPS + 1):
            share = step / TURN_STEPS
            stand(time_s + share * turn_s, start + leg, 0.0, yaw + share * turn)
        time_s, yaw = time_s + turn_s, yaw + turn
    times, poses = np.array(stamps), np.array(rows)
    kept = np.append(np.diff(times) > 1e-9, True)
    return times[kept], poses[kept]
