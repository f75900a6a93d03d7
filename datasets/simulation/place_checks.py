"""What a place must hold to: no things inside each other, drives and paths through free space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from datasets.simulation.place_file import MotionSection, PlaceSection
from datasets.simulation.place_geometry import (
    Part,
    Prism,
    contains,
    penetration_m,
    segment_distances,
)
from datasets.simulation.place_outline import Outline, encloses
from datasets.yaml_file import MarkedYaml

TOUCHING_M = 0.01
"""Things may stand this deep in each other: positions are rounded."""

STEP_M, ROBOT_M = 0.05, 1.0
"""The robot drives over what is lower and under what is higher."""

PERSON_M = 0.2
"""Half the width of a person, whose path keeps as far from things."""


@dataclass(frozen=True, slots=True)
class Fault:
    """Why a way is none: the index of the point, what, and what would be right."""

    index: int
    what: str
    remedy: str


@dataclass(frozen=True, slots=True)
class FreeSpace:
    """Where in a place one can drive and walk: between the walls and around what stands there."""

    rings: tuple[tuple[Outline, str], ...] = ()
    obstacles: tuple[tuple[str, Prism], ...] = ()

    @classmethod
    def between(cls, rings: Sequence[tuple[Outline, str]], parts: Sequence[Part]) -> FreeSpace:
        """rings : outlines with the side they face."""
        obstacles = [
            (part.name, prism)
            for part in parts
            for prism in part.prisms
            if prism.top_m > STEP_M and prism.bottom_m < ROBOT_M
        ]
        return cls(tuple(rings), tuple(obstacles))

    def fault(self, points: Array, *, closed: bool, clearance_m: float = 0.0) -> Fault | None:
        """What is wrong with a way through points, (K, 2) m, or None.

        A way must stay inside the place and pass everything by more than the clearance.
        """
        for index, point in enumerate(points):
            inside_of = [name for name, prism in self.obstacles if contains(prism.footprint, point)]
            at = f"the point ({point[0]:g}, {point[1]:g})"
            if inside_of:
                return Fault(index, f"{at} lies inside {inside_of[0]}", "Move it into the open.")
            if not encloses(self.rings, point):
                return Fault(
                    index,
                    f"{at} lies outside the place",
                    "Move it inside the wall rings; check the signs of x and y.",
                )
        if not self.obstacles:
            return None
        sizes = [len(prism.footprint) for _, prism in self.obstacles]
        starts = np.concatenate([prism.footprint for _, prism in self.obstacles])
        ends = np.concatenate([np.roll(p.footprint, -1, axis=0) for _, p in self.obstacles])
        owners = np.repeat(np.arange(len(sizes)), sizes)
        following = np.roll(points, -1, axis=0) if closed else np.append(points[1:], points[-1:], 0)
        for index, (start, end) in enumerate(zip(points, following, strict=True)):
            distances_m = segment_distances(start, end, starts, ends)
            nearest = int(np.argmin(distances_m))
            if distances_m[nearest] <= clearance_m:
                name = self.obstacles[owners[nearest]][0]
                near = f"passes {name} at {distances_m[nearest]:.2f} m"
                how = near if distances_m[nearest] > 0.0 else f"goes through {name}"
                return Fault(
                    index,
                    f"the way from ({start[0]:g}, {start[1]:g}) to ({end[0]:g}, {end[1]:g}) {how}",
                    "Put a point between them that leads around it.",
                )
        return None


def check_parts(parts: Sequence[Part], materials: Sequence[str], source: MarkedYaml) -> None:
    """Raise InputError for a name used twice and for an unknown material."""
    seen: set[str] = set()
    for part in parts:
        if part.name in seen:
            raise source.error(
                (*part.keys, "name"),
                f"there are two things called {part.name!r}",
                "Give each a name of its own.",
            )
        seen.add(part.name)
        if part.material not in materials:
            raise source.error(
                (*part.keys, part.material_key),
                f"unknown material {part.material!r}",
                f"Known are: {', '.join(sorted(materials))}; others are made under `materials`.",
            )


def check_overlaps(parts: Sequence[Part], source: MarkedYaml) -> None:
    """Raise InputError if one thing stands inside another; walls may run into each other."""
    prisms = [(owner, prism) for owner, part in enumerate(parts) for prism in part.prisms]
    owners = np.array([owner for owner, _ in prisms])
    low = np.array([[*p.footprint.min(0), p.bottom_m] for _, p in prisms]) + TOUCHING_M / 2
    high = np.array([[*p.footprint.max(0), p.top_m] for _, p in prisms]) - TOUCHING_M / 2
    walls = np.array([parts[owner].wall for owner in owners])
    for index, (owner, prism) in enumerate(prisms):
        if parts[owner].wall:
            continue
        near = (low < high[index]).all(1) & (high > low[index]).all(1)
        # Each pair once: what is no wall is compared with walls and with what came before it.
        near &= walls | (owners < owner)
        for other in np.flatnonzero(near):
            depth_m = penetration_m(prism, prisms[other][1])
            if depth_m > TOUCHING_M:
                part, second = parts[owner], parts[owners[other]]
                raise source.error(
                    part.keys,
                    f"{part.name} stands {depth_m:.2f} m deep in {second.name}",
                    "Move one of them, or make it smaller.",
                )


def check_inside(spec: PlaceSection, space: FreeSpace, source: MarkedYaml) -> None:
    """Raise InputError if there is no ring around the place, or a thing stands outside of it."""
    if not any(faces == "inside" for _, faces in space.rings):
        raise source.error(
            ("walls",),
            "no wall closes the place",
            "Give one of the walls a `ring` around everything, with its first point again as last.",
        )
    groups = {
        "boxes": [(thing.name, thing.at_m) for thing in spec.boxes],
        "cylinders": [(thing.name, thing.at_m) for thing in spec.cylinders],
        "furniture": [(thing.name, thing.at_m) for thing in spec.furniture],
    }
    for group, things in groups.items():
        for index, (name, at_m) in enumerate(things):
            if not encloses(space.rings, np.array(at_m)):
                raise source.error(
                    (group, index, "at_m"),
                    f"{name} stands outside the place",
                    "Move it inside the wall rings; check the signs of x and y.",
                )


def check_paths(spec: PlaceSection, space: FreeSpace, source: MarkedYaml) -> None:
    """Raise InputError if what moves stands still, leaves the place or runs into something."""
    paths: list[tuple[str, int, MotionSection, float]] = [
        ("people", index, person, PERSON_M) for index, person in enumerate(spec.people)
    ]
    paths += [
        ("moving_boxes", index, box, min(box.size_m[:2]) / 2)
        for index, box in enumerate(spec.moving_boxes)
    ]
    for group, index, motion, clearance_m in paths:
        points = np.array(motion.path_m)
        closed = motion.repeat == "circle"
        still = np.linalg.norm(np.diff(points, axis=0), axis=1) == 0.0
        if still.any() or (closed and motion.path_m[0] == motion.path_m[-1]):
            raise source.error(
                (group, index, "path_m"),
                f"the path of {motion.name} has a point twice in a row",
                "Leave one out; a circle goes back to its first point by itself.",
            )
        fault = space.fault(points, closed=closed, clearance_m=clearance_m)
        if fault is not None:
            raise source.error((group, index, "path_m", fault.index), fault.what, fault.remedy)
