"""Places that a simulated robot drives through, read from YAML (`docs/places.md`)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np

from datasets.messages import Array
from datasets.simulation.place_checks import (
    FreeSpace,
    check_inside,
    check_overlaps,
    check_parts,
    check_paths,
)
from datasets.simulation.place_file import (
    CarriedSection,
    DoorClosedSection,
    DriveSection,
    PlaceSection,
    RobotName,
    TroubleSection,
)
from datasets.simulation.place_geometry import Part, Triangles, Vertices, mesh
from datasets.simulation.place_openings import leaf_hinge
from datasets.simulation.place_outline import Outline, outline_of
from datasets.simulation.place_parts import moving_parts, static_parts
from datasets.yaml_file import Keys, MarkedYaml

SHIPPED = ("room", "ring-corridor", "beam-room", "office", "campus")
EXAMPLE = "docs/places.md has an example."


@dataclass(frozen=True, slots=True)
class Material:
    """How sensors see a surface.

    lidar : "clear" lets the beam through. depth : "invisible" gives a depth camera no return.
    reflectance : 0..1, diffuse, at the sensors' infrared.
    """

    name: str
    lidar: Literal["opaque", "clear"] = "opaque"
    depth: Literal["opaque", "invisible"] = "opaque"
    reflectance: float = 0.5


MATERIALS = {
    material.name: material
    for material in (
        Material("wall", reflectance=0.85),
        Material("concrete", reflectance=0.4),
        Material("wood", reflectance=0.6),
        Material("cardboard", reflectance=0.5),
        Material("metal", reflectance=0.5),
        Material("cloth", reflectance=0.4),
        Material("carpet", reflectance=0.3),
        Material("marble", reflectance=0.6),
        Material("glass", lidar="clear", depth="invisible", reflectance=0.05),
        Material("black", depth="invisible", reflectance=0.03),
        Material("polished", depth="invisible", reflectance=0.2),
    )
}
"""What every place knows; a file may add others."""


@dataclass(frozen=True, slots=True)
class Solid:
    """A thing as a closed mesh, in one piece or several.

    vertices : (V, 3) float32 m, map frame (a mover's: its own). triangles : (T, 3) uint32,
    counter-clockwise seen from outside.
    """

    name: str
    vertices: Vertices
    triangles: Triangles
    material: Material

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3:
            raise ValueError(f"vertices must be (V, 3), not {self.vertices.shape}")
        if not np.isfinite(self.vertices).all():
            raise ValueError(f"the vertices of {self.name} must be finite")
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3:
            raise ValueError(f"triangles must be (T, 3), not {self.triangles.shape}")


@dataclass(frozen=True, slots=True)
class Mover:
    """A solid, in its own frame, that moves over the floor.

    stamps_s : (K,) increasing from 0. xyyaw : (K, 3), map frame, yaw without jumps; linear between
    stamps. loop : start again after the last stamp; otherwise it stays there.
    """

    name: str
    solid: Solid
    stamps_s: Array
    xyyaw: Array
    loop: bool

    def __post_init__(self) -> None:
        if self.stamps_s.ndim != 1 or self.xyyaw.shape != (self.stamps_s.size, 3):
            raise ValueError(f"{self.stamps_s.shape} stamps for {self.xyyaw.shape} poses")
        if self.stamps_s[0] != 0.0 or (np.diff(self.stamps_s) <= 0.0).any():
            raise ValueError(f"the stamps of {self.name} must increase from 0")

    def T_map_mover(self, time_s: float) -> Array:
        """Its pose, (4, 4), at a time from the start of the drive."""
        end_s = float(self.stamps_s[-1])
        if self.loop and end_s > 0.0:
            time_s %= end_s
        x_m, y_m, yaw = (float(np.interp(time_s, self.stamps_s, row)) for row in self.xyyaw.T)
        c, s = math.cos(yaw), math.sin(yaw)
        return np.array(
            [[c, -s, 0.0, x_m], [s, c, 0.0, y_m], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        )


@dataclass(frozen=True, slots=True)
class Structure:
    """A length that is known, between two points (x, y) of the map frame, such as a corridor's."""

    name: str
    length_m: float
    start_m: tuple[float, float]
    end_m: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Door:
    """A door that stands open.

    hinge, tip : (2,) m, map frame, the tip where it is when the door is closed. close_rad : the
    turn about the hinge that closes it.
    """

    hinge: Array
    tip: Array
    close_rad: float


@dataclass(frozen=True, slots=True)
class DriveSpec:
    """A way for the robot, from its first way point.

    way_points : (K, 2) m, map frame, K >= 1; with one it only stands.
    start_yaw_rad : how it stands at first. closed : whether it comes back to the first point.
    stand_s : how long it stands before it starts. robot : which one drives it, unless another is
    asked for. trouble : what goes wrong.
    """

    way_points: Array
    start_yaw_rad: float = 0.0
    closed: bool = False
    stand_s: float = 0.0
    robot: RobotName = "paper"
    trouble: tuple[TroubleSection, ...] = ()

    def driven(self, laps: int = 1) -> Array:
        """All way points in order, (K, 2) m, with the return to the first of a closed drive."""
        points = np.tile(self.way_points, (laps, 1))
        return np.vstack([points, points[:1]]) if self.closed else points


@dataclass(frozen=True, slots=True)
class Place:
    """A place: what stands there, what moves, what is known about it, ways through it.

    points : (x, y, z) m, map frame.
    floor  : whether one of the solids, called "floor", is one with its top at z = 0.
    doors  : those that stand open, by the names of their leaves.
    space  : where one can go. about : what the file says the place is.
    """

    name: str
    solids: tuple[Solid, ...]
    movers: tuple[Mover, ...] = ()
    structures: Mapping[str, Structure] = field(default_factory=dict)
    points: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    drives: Mapping[str, DriveSpec] = field(default_factory=dict)
    floor: bool = True
    doors: Mapping[str, Door] = field(default_factory=dict)
    space: FreeSpace = field(default_factory=FreeSpace)
    about: str = ""


def load_place(name_or_path: str | Path) -> Place:
    """One of the ``SHIPPED`` places by its name, or one from a file.

    Raises InputError that names file, line, key and remedy if no place can come of it.
    """
    source = _source(name_or_path)
    spec = source.validate(PlaceSection)
    materials = MATERIALS | {
        name: Material(name, section.lidar, section.depth, section.reflectance)
        for name, section in spec.materials.items()
    }
    outlines = [outline_of(wall, ("walls", index), source) for index, wall in enumerate(spec.walls)]
    parts = list(static_parts(spec, outlines, source))
    moving = list(moving_parts(spec))
    check_parts([*parts, *(part for part, _ in moving)], list(materials), source)
    check_overlaps(parts, source)
    rings = [(o, wall.faces) for o, wall in zip(outlines, spec.walls, strict=True) if o.ring]
    space = FreeSpace.between(rings, parts)
    doors = dict(_doors(spec, outlines))
    check_inside(spec, space, source)
    check_paths(spec, space, source)
    return Place(
        name=Path(source.label).stem,
        solids=tuple(_solid(part, materials) for part in parts),
        movers=tuple(
            Mover(part.name, _solid(part, materials), track.stamps_s, track.xyyaw, track.loop)
            for part, track in moving
        ),
        structures=dict(_structures(spec, source)),
        points=dict(spec.points),
        drives={
            name: _drive(drive, space, doors, ("drives", name), source)
            for name, drive in spec.drives.items()
        },
        floor=spec.floor is not None,
        doors=doors,
        space=space,
        about=spec.about.strip(),
    )


def with_door_closing(place: Place, name: str, begin_s: float, end_s: float) -> Place:
    """The place, with a door that is closed from one time to the other of the drive."""
    door = place.doors[name]
    leaf = next(solid for solid in place.solids if solid.name == name)
    offset = np.array([*door.hinge, 0.0], dtype=np.float32)
    open_pose = (*door.hinge.tolist(), 0.0)
    mover = Mover(
        name,
        replace(leaf, vertices=leaf.vertices - offset),
        np.array([0.0, begin_s, end_s]),
        np.array([open_pose, open_pose, (*door.hinge.tolist(), door.close_rad)]),
        loop=False,
    )
    solids = tuple(solid for solid in place.solids if solid is not leaf)
    return replace(place, solids=solids, movers=(*place.movers, mover))


def load_drive(path: Path, place: Place) -> DriveSpec:
    """A drive from a file of its own, which holds the keys of one drive.

    Raises InputError that names file, line, key and remedy; also if it doesn't fit the place.
    """
    source = MarkedYaml.read(path, "the drive", EXAMPLE, "Give the path of a YAML file.")
    return _drive(source.validate(DriveSection), place.space, place.doors, (), source)


def _source(name_or_path: str | Path) -> MarkedYaml:
    path, name = Path(name_or_path), str(name_or_path)
    if name in SHIPPED and not path.is_file():
        shipped = files("datasets.simulation").joinpath("places", f"{name}.yaml")
        return MarkedYaml.parse(shipped.read_text(encoding="utf-8"), f"{name}.yaml", EXAMPLE)
    remedy = f"Give the path of a YAML file, or one of the places {', '.join(SHIPPED)}."
    return MarkedYaml.read(path, "the place", EXAMPLE, remedy)


def _solid(part: Part, materials: Mapping[str, Material]) -> Solid:
    return Solid(part.name, *mesh(part.prisms), materials[part.material])


def _structures(spec: PlaceSection, source: MarkedYaml) -> Iterator[tuple[str, Structure]]:
    for name, section in spec.structures.items():
        length_m = math.dist(section.from_m, section.to_m)
        if length_m == 0.0:
            raise source.error(
                ("structures", name), f"the structure {name} has no length", "Correct its ends."
            )
        yield name, Structure(name, length_m, section.from_m, section.to_m)


def _doors(spec: PlaceSection, outlines: Sequence[Outline]) -> Iterator[tuple[str, Door]]:
    for wall, outline in zip(spec.walls, outlines, strict=True):
        for index, opening in enumerate(wall.openings):
            if opening.leaf is None or opening.leaf.open_deg == 0.0:
                continue
            hinge, tip, open_rad = leaf_hinge(
                opening.leaf, outline, opening.segment, opening.at_m, opening.width_m
            )
            yield f"{wall.name}/leaf {index}", Door(hinge, tip, -open_rad)


def _drive(
    section: DriveSection,
    space: FreeSpace,
    doors: Mapping[str, Door],
    keys: Keys,
    source: MarkedYaml,
) -> DriveSpec:
    points = np.array(section.way_points_m, dtype=np.float64)
    again = np.append(points, points[:1], axis=0) if section.closed else points
    still = np.flatnonzero(np.linalg.norm(np.diff(again, axis=0), axis=1) == 0.0)
    if still.size:
        raise source.error(
            (*keys, "way_points_m", int(still[0])),
            "two way points in a row are the same",
            "Leave one out; a closed drive goes back to its first way point by itself.",
        )
    fault = space.fault(points, closed=section.closed)
    if fault is not None:
        raise source.error((*keys, "way_points_m", fault.index), fault.what, fault.remedy)
    yaw = 0.0
    if section.start_yaw_deg is not None:
        yaw = math.radians(section.start_yaw_deg)
    elif len(points) > 1:
        yaw = math.atan2(*(points[1] - points[0])[::-1])
    for index, event in enumerate(section.trouble):
        here = (*keys, "trouble", index)
        if isinstance(event, DoorClosedSection) and event.door not in doors:
            known = ", ".join(doors) or "none"
            raise source.error(
                here, f"no open door is called {event.door!r}", f"Open doors are: {known}."
            )
        if isinstance(event, CarriedSection):
            path = np.array([event.to[:2], *(event.then_m or ())])
            fault = space.fault(path, closed=False)
            if fault is not None:
                raise source.error(here, fault.what, fault.remedy)
    return DriveSpec(
        points, yaw, section.closed, section.stand_s, section.robot, tuple(section.trouble)
    )
