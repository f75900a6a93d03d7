"""What a place file may say; `docs/places.md` tells what it means."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from datasets.section import Section

LONGEST_WALK_S: Final = 86_400.0
Metres = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Size = Annotated[float, Field(ge=1e-4, le=1000.0)]
Degrees = Annotated[float, Field(ge=-360.0, le=360.0)]
Point = tuple[Metres, Metres]
RobotName = Literal["paper", "tilted", "rolled", "offset", "two-lidars", "low-lidar", "gyro"]
"""The robots of `robot.py`."""
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]*$", max_length=60)]


class MaterialSection(Section):
    """How the sensors see a surface."""

    lidar: Literal["opaque", "clear"] = "opaque"
    depth: Literal["opaque", "invisible"] = "opaque"
    reflectance: float = Field(0.5, ge=0.0, le=1.0)


class LeafSection(Section):
    """The leaf of a door."""

    swing: Literal["left", "right"] = "left"
    hinge: Literal["start", "end"] = "start"
    open_deg: float = Field(0.0, ge=0.0, le=180.0)
    thickness_m: Size = 0.04
    material: Name = "wood"


class PaneSection(Section):
    """A pane in an opening, with a frame around it."""

    material: Name = "glass"
    thickness_m: Size = 0.01
    frame_m: float = Field(0.06, ge=0.0, le=1.0)
    frame_material: Name = "metal"
    bars: int = Field(0, ge=0, le=100)


class OpeningSection(Section):
    """A hole in one segment of a wall: a door, a window, a passage."""

    segment: int = Field(0, ge=0)
    at_m: Metres
    width_m: Size
    sill_m: float = Field(0.0, ge=0.0, le=100.0)
    head_m: Size | None = None
    leaf: LeafSection | None = None
    pane: PaneSection | None = None


class WallSection(Section):
    """A wall along a ring or a line."""

    name: Name
    ring: tuple[Point, ...] | None = Field(None, min_length=4)
    line: tuple[Point, ...] | None = Field(None, min_length=2)
    faces: Literal["inside", "outside"] = "inside"
    thickness_m: Size = 0.2
    height_m: Size
    z_m: Metres = 0.0
    material: Name = "wall"
    openings: tuple[OpeningSection, ...] = ()

    @model_validator(mode="after")
    def _one_outline(self) -> WallSection:
        if (self.ring is None) == (self.line is None):
            raise ValueError("a wall runs along either a ring or a line")
        return self


class BoxSection(Section):
    """A box on its place; x is its length."""

    name: Name
    at_m: Point
    size_m: tuple[Size, Size, Size]
    yaw_deg: Degrees = 0.0
    z_m: Metres = 0.0
    material: Name = "wood"


class CylinderSection(Section):
    """An upright cylinder."""

    name: Name
    at_m: Point
    radius_m: Size
    height_m: Size
    z_m: Metres = 0.0
    material: Name = "wood"


class FurnitureSection(Section):
    """A piece of furniture, put together from boxes."""

    name: Name
    kind: Literal["table", "chair", "swivel-chair", "sofa", "shelf"]
    at_m: Point
    size_m: tuple[Size, Size, Size]
    yaw_deg: Degrees = 0.0
    overhang_m: float = Field(0.05, ge=0.0, le=10.0)
    material: Name = "wood"


class MotionSection(Section):
    """What moves along a path."""

    name: Name
    path_m: tuple[Point, ...] = Field(min_length=2)
    repeat: Literal["circle", "to-and-fro", "once"] = "to-and-fro"
    speed_m_s: float = Field(1.0, gt=0.0, le=10.0)
    start_s: float = Field(0.0, ge=0.0, le=1e6)

    @model_validator(mode="after")
    def _within_a_day(self) -> Self:
        """Each stride is a pose to hold: a path that takes years would have too many."""
        length_m = sum(math.dist(a, b) for a, b in pairwise(self.path_m))
        if length_m > LONGEST_WALK_S * self.speed_m_s:
            raise ValueError("the path takes more than a day at this speed")
        return self


class PersonSection(MotionSection):
    """A person: two legs that step, and a body."""

    height_m: float = Field(1.75, ge=0.5, le=2.5)
    material: Name = "cloth"


class MovingBoxSection(MotionSection):
    """A box that moves, such as a trolley."""

    size_m: tuple[Size, Size, Size]
    z_m: Metres = 0.0
    material: Name = "metal"


class StructureSection(Section):
    """A length in the place that is known."""

    from_m: Point
    to_m: Point


class EventSection(Section):
    """Trouble on a drive, after so many metres of it."""

    at_m: float = Field(gt=0.0, le=1e6)


class CarriedSection(EventSection):
    """Someone lifts the base, carries it and sets it down; it goes on from there."""

    kind: Literal["carried"]
    to: tuple[Metres, Metres, Degrees]
    seconds: float = Field(4.0, ge=0.1, le=3600.0)
    via_m: tuple[Point, ...] = ()
    then_m: tuple[Point, ...] | None = Field(None, min_length=1)


class TurnedSection(EventSection):
    """Someone turns the base on the spot."""

    kind: Literal["turned"]
    by_deg: Degrees
    seconds: float = Field(0.5, ge=0.1, le=3600.0)


class OdometryResetSection(EventSection):
    """The odometry starts at zero again."""

    kind: Literal["odometry_reset"]


class LidarSilentSection(EventSection):
    """No lidar gives a scan for a while."""

    kind: Literal["lidar_silent"]
    seconds: float = Field(20.0, gt=0.0, le=3600.0)


class DoorClosedSection(EventSection):
    """A door that was open is closed."""

    kind: Literal["door_closed"]
    door: Annotated[str, Field(max_length=80)]
    seconds: float = Field(1.0, ge=0.1, le=60.0)


TroubleSection = (
    CarriedSection | TurnedSection | OdometryResetSection | LidarSilentSection | DoorClosedSection
)


class DriveSection(Section):
    """A way for the robot."""

    way_points_m: tuple[Point, ...] = Field(min_length=1)
    closed: bool = False
    start_yaw_deg: Degrees | None = None
    stand_s: float = Field(0.0, ge=0.0, le=86400.0)
    robot: RobotName = "paper"
    trouble: tuple[Annotated[TroubleSection, Field(discriminator="kind")], ...] = ()


class PlaceSection(Section):
    """A whole place file."""

    about: str = ""
    floor: Name | None = None
    ceiling_m: Size | None = None
    materials: dict[Name, MaterialSection] = Field(default_factory=dict)
    walls: tuple[WallSection, ...]
    boxes: tuple[BoxSection, ...] = ()
    cylinders: tuple[CylinderSection, ...] = ()
    furniture: tuple[FurnitureSection, ...] = ()
    people: tuple[PersonSection, ...] = ()
    moving_boxes: tuple[MovingBoxSection, ...] = ()
    structures: dict[Name, StructureSection] = Field(default_factory=dict)
    points: dict[Name, tuple[Metres, Metres, Metres]] = Field(default_factory=dict)
    drives: dict[Name, DriveSection] = Field(default_factory=dict)
