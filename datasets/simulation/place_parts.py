"""The things of a place file as parts: what stands there, and what moves."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from datasets.simulation.place_file import PlaceSection
from datasets.simulation.place_furniture import furniture
from datasets.simulation.place_geometry import Part, column, cuboid
from datasets.simulation.place_movers import Track, box_track, person_tracks
from datasets.simulation.place_outline import Outline
from datasets.simulation.place_walls import wall_parts
from datasets.simulation.yaml_marks import MarkedYaml

FLOOR_M = 0.5
"""How thick the floor is, and how far it reaches beyond the walls."""


def static_parts(
    spec: PlaceSection, outlines: Sequence[Outline], source: MarkedYaml
) -> Iterator[Part]:
    """All that stands, the floor first. outlines : one for each wall."""
    if spec.floor is not None and outlines:
        corners = np.concatenate([outline.points for outline in outlines])
        low, high = corners.min(0) - FLOOR_M, corners.max(0) + FLOOR_M
        middle, size = (low + high) / 2, high - low
        slab = cuboid((middle[0], middle[1]), (size[0], size[1], FLOOR_M), -FLOOR_M)
        yield Part("floor", spec.floor, (slab,), (), wall=True, material_key="floor")
    for index, (wall, outline) in enumerate(zip(spec.walls, outlines, strict=True)):
        yield from wall_parts(wall, outline, ("walls", index), source)
    for index, box in enumerate(spec.boxes):
        prism = cuboid((0.0, 0.0), box.size_m, box.z_m)
        prism = prism.placed(*box.at_m, math.radians(box.yaw_deg))
        yield Part(box.name, box.material, (prism,), ("boxes", index))
    for index, cylinder in enumerate(spec.cylinders):
        prism = column(cylinder.at_m, cylinder.radius_m, cylinder.height_m, cylinder.z_m)
        yield Part(cylinder.name, cylinder.material, (prism,), ("cylinders", index))
    for index, item in enumerate(spec.furniture):
        try:
            prisms = furniture(item)
        except ValueError as error:
            raise source.error(
                ("furniture", index, "size_m"), str(error), "Correct its size_m or overhang_m."
            ) from error
        yield Part(item.name, item.material, prisms, ("furniture", index))


def moving_parts(spec: PlaceSection) -> Iterator[tuple[Part, Track]]:
    """All that moves, with its way; a person is several."""
    for index, person in enumerate(spec.people):
        for limb, track in person_tracks(person):
            name = f"{person.name}/{limb}"
            yield Part(name, person.material, track.prisms, ("people", index)), track
    for index, box in enumerate(spec.moving_boxes):
        track = box_track(cuboid((0.0, 0.0), box.size_m, box.z_m), box)
        yield Part(box.name, box.material, track.prisms, ("moving_boxes", index)), track
