"""The line of a wall in the plan: its corners, its thickness, what it encloses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from datasets.simulation.place_file import WallSection
from datasets.simulation.place_geometry import contains, segment_distances
from datasets.yaml_file import Keys, MarkedYaml

SHARPEST_DEG = 150.0
"""A corner that turns by more would reach far out."""


@dataclass(frozen=True, slots=True)
class Outline:
    """The line of a wall in the plan.

    points : (K, 2) m. ring : whether the last joins the first.
    right_m, left_m : how far the wall reaches from the line, counted to the left.
    """

    points: Array
    ring: bool
    right_m: float
    left_m: float

    @property
    def segments(self) -> int:
        """How many segments there are."""
        return len(self.points) - (not self.ring)

    def segment(self, index: int) -> tuple[Array, Array]:
        """Start and end, (2,) each."""
        return self.points[index], self.points[(index + 1) % len(self.points)]

    def frame(self, index: int) -> tuple[Array, Array, float]:
        """Unit vectors along and to the left of a segment, and its length."""
        start, end = self.segment(index)
        length_m = float(np.linalg.norm(end - start))
        along = (end - start) / length_m
        return along, np.array([-along[1], along[0]]), length_m

    def corner(self, index: int, left_m: float) -> Array:
        """The corner point of the line ``left_m`` to the left of the wall's."""
        last = len(self.points) - 1
        before = index - 1 if index or self.ring else 0
        after = index if index < last or self.ring else last - 1
        left_0, left_1 = self.frame(before % len(self.points))[1], self.frame(after)[1]
        mitre: Array = (left_0 + left_1) / (1.0 + left_0 @ left_1)
        return self.points[index] + left_m * mitre

    def at(self, segment: int, along_m: float, left_m: float) -> Array:
        """The point (2,) that far along a segment and to the left of it."""
        along, left, _ = self.frame(segment)
        point: Array = self.segment(segment)[0] + along_m * along + left_m * left
        return point

    def span(self, segment: int) -> tuple[float, float]:
        """Between which distances along a segment the wall has its full thickness."""
        along, _, _ = self.frame(segment)
        start = self.segment(segment)[0]
        ends = (segment, (segment + 1) % len(self.points))
        reach = [
            [float((self.corner(end, left_m) - start) @ along) for end in ends]
            for left_m in (self.right_m, self.left_m)
        ]
        return max(reach[0][0], reach[1][0]), min(reach[0][1], reach[1][1])


def outline_of(wall: WallSection, keys: Keys, source: MarkedYaml) -> Outline:
    """The outline of a wall; raises InputError if its ring is open or it runs into itself."""
    points = np.array(wall.ring if wall.ring is not None else wall.line, dtype=np.float64)
    ring = wall.ring is not None
    keys = (*keys, "ring" if ring else "line")
    if ring:
        gap_m = math.dist(points[0], points[-1])
        if gap_m > 0.0:
            raise source.error(
                keys,
                f"the ring of {wall.name} is open: it ends {gap_m:.3g} m from where it began",
                "Let the last point be the first again, or write `line` for a wall with two ends.",
            )
        points = points[:-1]
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if (steps_m == 0.0).any():
        raise source.error(
            (*keys, int(np.argmin(steps_m)) + 1),
            f"the wall {wall.name} has a point twice in a row",
            "Leave one of the two out.",
        )
    half_m = wall.thickness_m / 2
    outline = Outline(points, ring, -half_m, half_m)
    _refuse_crossing(outline, wall.name, keys, source)
    if not ring:
        return outline
    x, y = points.T
    left_is_inside = float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) > 0.0
    if left_is_inside == (wall.faces == "inside"):
        return Outline(points, ring, -wall.thickness_m, 0.0)
    return Outline(points, ring, 0.0, wall.thickness_m)


def _refuse_crossing(outline: Outline, name: str, keys: Keys, source: MarkedYaml) -> None:
    count = outline.segments
    starts = outline.points[:count]
    ends = np.roll(outline.points, -1, axis=0)[:count]
    for i in range(count):
        apart = [j for j in range(i + 2, count) if not (outline.ring and i == 0 and j == count - 1)]
        met = [
            j
            for j in apart
            if segment_distances(starts[i], ends[i], starts[[j]], ends[[j]])[0] == 0.0
        ]
        if met:
            raise source.error(
                (*keys, met[0]),
                f"the wall {name} runs through itself: segments {i} and {met[0]} meet",
                "Check the order of its points; a wall that closes is a `ring`.",
            )
        j = (i + 1) % count
        if j == 0 and not outline.ring:
            continue
        turn_deg = math.degrees(
            math.acos(np.clip(outline.frame(i)[0] @ outline.frame(j)[0], -1, 1))
        )
        if turn_deg > SHARPEST_DEG:
            raise source.error(
                (*keys, j),
                f"the wall {name} turns back by {turn_deg:.0f} deg",
                f"A corner may turn by {SHARPEST_DEG:.0f} deg; make two walls of it.",
            )


def encloses(rings: Sequence[tuple[Outline, str]], point: Array) -> bool:
    """Whether a point lies inside a ring that faces inside and outside those facing outside."""
    inside = [contains(o.points, point) for o, faces in rings if faces == "inside"]
    blocks = [contains(o.points, point) for o, faces in rings if faces == "outside"]
    return any(inside) and not any(blocks)
