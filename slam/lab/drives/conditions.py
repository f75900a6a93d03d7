"""What makes a drive harder than those of the tables: one thing at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

from datasets.simulation.place import DriveSpec, Place, load_place
from datasets.simulation.robot import ROBOTS, SLIPPERY, Robot

GLASS_DOORS = "the leaves of all its doors are of glass"


@dataclass(frozen=True, slots=True)
class Condition:
    """A drive and what differs from the tables' own. settings : of every system."""

    name: str
    what: str
    place: str = "ring-corridor"
    laps: int = 1
    settings: tuple[str, ...] = ()


CONDITIONS = (
    Condition(
        "no odometry", "`ring-corridor`, the wheels tell nothing", settings=("odometry=false",)
    ),
    Condition(
        "slip",
        "`ring-corridor`, every 5 m the wheels lose up to half of some 0.5 m",
    ),
    Condition("glass", f"`ring-corridor`, {GLASS_DOORS}"),
    Condition(
        "bare corridor",
        "`ring-corridor` without doors, windows and cabinets",
        place="bare-ring",
    ),
    Condition("five more laps", "`ring-corridor`, six laps without a stop", laps=6),
    Condition(
        "people",
        "`office`, three people walking; its structure `open-plan` ends at a window, which the "
        "lidar looks through, so that its length says little",
        place="office",
    ),
    Condition("nobody", "`office` without them, to compare with", place="office"),
)


def setting_of(condition: Condition) -> tuple[Place, DriveSpec, Robot]:
    """The place, the drive and the robot of a condition."""
    ring = load_place("ring-corridor")
    if condition.place == "bare-ring":
        path = files("slam.lab").joinpath("places", "bare-ring.yaml")
        place, spec = load_place(Path(str(path))), ring.drives["circle"]
    elif condition.place == "office":
        place = load_place("office")
        spec = place.drives["tour"]
    else:
        place, spec = ring, ring.drives["circle"]
    if condition.name == "glass":
        place = _glass_doors(place)
    if condition.name == "nobody":
        place = replace(place, movers=())
    robot = ROBOTS[spec.robot]
    return place, spec, replace(robot, wheels=SLIPPERY) if condition.name == "slip" else robot


def _glass_doors(place: Place) -> Place:
    """All leaves of doors of the material of the windows."""
    glass = next(solid.material for solid in place.solids if solid.material.name == "glass")
    solids = tuple(
        replace(solid, material=glass) if "/leaf" in solid.name else solid for solid in place.solids
    )
    return replace(place, solids=solids)
