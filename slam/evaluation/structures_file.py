"""Lengths that somebody measured in a real place, from YAML (`docs/measures.md`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from pydantic import Field

from datasets.section import Section
from datasets.simulation.place import Structure
from datasets.simulation.place_file import Name, Point, Size
from datasets.yaml_file import MarkedYaml
from slam.evaluation.restoration import MARGIN_M, WIDTH_M, WINDOW_M

DESCRIBED = "docs/measures.md"


class MeasuredSection(Section):
    """One structure: roughly where its two ends are in the map, and how long it really is."""

    from_m: Point
    to_m: Point
    length_m: Size
    width_m: float = Field(WIDTH_M, gt=2 * MARGIN_M, le=1000.0)


class StructuresSection(Section):
    """A whole file."""

    structures: dict[Name, MeasuredSection] = Field(min_length=1)


@dataclass(frozen=True, slots=True)
class MeasuredStructure:
    """A structure whose ends are in the map frame of the run, and its width."""

    structure: Structure
    width_m: float


def read_structures(path: Path) -> tuple[MeasuredStructure, ...]:
    """The structures of a file, in its order.

    Raises InputError that names file, line, key and remedy. Ends that lie further from the stated
    length than both walls could be found (twice 1.5 m) are an error: nothing would be measured.
    """
    source = MarkedYaml.read(
        path,
        "the structures",
        f"{DESCRIBED} has an example.",
        f"Give the path of a YAML file; {DESCRIBED} has an example.",
    )
    found = []
    for name, section in source.validate(StructuresSection).structures.items():
        apart_m = math.dist(section.from_m, section.to_m)
        if apart_m == 0.0 or abs(apart_m - section.length_m) > 2 * WINDOW_M:
            raise source.error(
                ("structures", name),
                f"the ends of {name} lie {apart_m:.2f} m apart, its length is given as "
                f"{section.length_m:g} m",
                f"Correct one of them; in the map they may differ by {2 * WINDOW_M:g} m.",
            )
        structure = Structure(name, section.length_m, section.from_m, section.to_m)
        found.append(MeasuredStructure(structure, section.width_m))
    return tuple(found)
