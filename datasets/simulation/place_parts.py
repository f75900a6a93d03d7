"""The things of a place file as parts: what stands there, and what moves."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from datasets.messages import Array
from datasets.simulation.place_file import PlaceSection
from datasets.simulation.place_furniture import furniture
from datasets.simulation.place_geometry import Part, column, cuboid
from datasets.simulation.place_movers import Track, box_track, person_tracks
from datasets.simulation.place_outline import Outline
from datasets.simulation.place_walls import wall_parts
from datasets.yaml_file import MarkedYaml

SLAB_M = 0.5
"""How thick floor and ceiling are, and how far they reach beyond the walls."""


def static_parts(
    spec: PlaceSection, outlines: Sequence[Outline], source: MarkedYaml
) -> Iterator[Part]:
    """All that stands, floor and ceiling first. outlines : one for each wall."""
    if outlines:
        yield from _slabs(spec, np.concatenate([outline.points for outline in outlines]))
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


def _slabs(spec: PlaceSection, corners: Array) -> Iterator[Part]:
    low, high = corners.min(0) - SLAB_M, corners.max(0) + SLAB_M
    middle, size = (low + high) / 2, high - low
    levels_m = (("floor", spec.floor, -SLAB_M), ("ceiling", "wall", spec.ceiling_m))
    for name, material, bottom_m in levels_m:
        if material is not None and bottom_m is not None:
            slab = cuboid((middle[0], middle[1]), (size[0], size[1], SLAB_M), bottom_m)
            yield Part(name, material, (slab,), (), wall=True, material_key=name)


def moving_parts(spec: PlaceSection) -> Iterator[tuple[Part, Track]]:
    """All that moves, with its way; a person is several."""
    for index, person in enumerate(spec.people):
        for limb, track in person_tracks(person):
            name = f"{person.name}/{limb}"
            yield Part(name, person.material, track.prisms, ("people", index)), track
    for index, box in enumerate(spec.moving_boxes):
        track = box_track(cuboid((0.0, 0.0), box.size_m, box.z_m), box)
        yield Part(box.name, box.material, track.prisms, ("moving_boxes", index)), track
