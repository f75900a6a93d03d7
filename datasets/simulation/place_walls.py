"""Walls with mitred corners and openings."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from datasets.simulation.place_file import OpeningSection, WallSection
from datasets.simulation.place_geometry import Part, Prism
from datasets.simulation.place_openings import leaf_prism, pane_parts
from datasets.simulation.place_outline import Outline
from datasets.yaml_file import MarkedYaml


def wall_parts(
    wall: WallSection, outline: Outline, keys: tuple[str | int, ...], source: MarkedYaml
) -> Iterator[Part]:
    """The wall itself, then the leaves, panes and frames in its openings."""
    bottom_m, top_m = wall.z_m, wall.z_m + wall.height_m
    by_segment: dict[int, list[tuple[float, float, OpeningSection]]] = {}
    for index, opening in enumerate(wall.openings):
        here = (*keys, "openings", index)
        start_m, end_m = _checked(opening, wall, outline, here, source)
        by_segment.setdefault(opening.segment, []).append((start_m, end_m, opening))
        for other_start_m, other_end_m, _ in by_segment[opening.segment][:-1]:
            if start_m < other_end_m - 1e-9 and other_start_m < end_m - 1e-9:
                raise source.error(
                    here,
                    f"two openings of {wall.name} overlap",
                    f"On segment {opening.segment} another one reaches from "
                    f"{other_start_m:.2f} to {other_end_m:.2f} m.",
                )
    prisms: list[Prism] = []
    for segment in range(outline.segments):
        done_m: float | None = None
        for start_m, end_m, opening in sorted(by_segment.get(segment, []), key=lambda o: o[0]):
            prisms += _piece(outline, segment, (done_m, start_m), (bottom_m, top_m))
            head_m = top_m if opening.head_m is None else bottom_m + opening.head_m
            for low_m, high_m in ((bottom_m, bottom_m + opening.sill_m), (head_m, top_m)):
                prisms += _piece(outline, segment, (start_m, end_m), (low_m, high_m))
            done_m = end_m
        prisms += _piece(outline, segment, (done_m, None), (bottom_m, top_m))
    yield Part(wall.name, wall.material, tuple(prisms), keys, wall=True)
    for index, opening in enumerate(wall.openings):
        here = (*keys, "openings", index)
        start_m, end_m = opening.at_m - opening.width_m / 2, opening.at_m + opening.width_m / 2
        head_m = top_m if opening.head_m is None else bottom_m + opening.head_m
        low_high_m = (bottom_m + opening.sill_m, head_m)
        if opening.leaf is not None:
            leaf = leaf_prism(opening.leaf, outline, opening.segment, (start_m, end_m), low_high_m)
            yield Part(
                f"{wall.name}/leaf {index}",
                opening.leaf.material,
                (leaf,),
                (*here, "leaf"),
                wall=opening.leaf.open_deg == 0.0,
            )
        if opening.pane is not None:
            yield from pane_parts(
                opening.pane,
                outline,
                opening.segment,
                (start_m, end_m),
                low_high_m,
                (f"{wall.name}/pane {index}", f"{wall.name}/frame {index}"),
                (*here, "pane"),
            )


def _checked(
    opening: OpeningSection,
    wall: WallSection,
    outline: Outline,
    keys: tuple[str | int, ...],
    source: MarkedYaml,
) -> tuple[float, float]:
    """From where to where along its segment an opening reaches."""
    if opening.segment >= outline.segments:
        raise source.error(
            (*keys, "segment"),
            f"the wall {wall.name} has no segment {opening.segment}",
            f"Its segments are 0 to {outline.segments - 1}.",
        )
    head_m = wall.height_m if opening.head_m is None else opening.head_m
    if not opening.sill_m < head_m <= wall.height_m:
        raise source.error(
            (*keys, "head_m" if opening.head_m is not None else "sill_m"),
            f"the opening reaches from {opening.sill_m:g} to {head_m:g} m "
            f"in a wall {wall.height_m:g} m high",
            "Its head must be above its sill and not above the wall.",
        )
    start_m, end_m = opening.at_m - opening.width_m / 2, opening.at_m + opening.width_m / 2
    first_m, last_m = outline.span(opening.segment)
    if start_m < first_m - 1e-9 or end_m > last_m + 1e-9:
        raise source.error(
            (*keys, "at_m"),
            f"the opening reaches from {start_m:.2f} to {end_m:.2f} m along its segment",
            f"There is wall from {first_m:.2f} to {last_m:.2f} m; at_m is the opening's middle.",
        )
    pane, width_m = opening.pane, min(opening.width_m, head_m - opening.sill_m)
    if pane is not None and pane.frame_m * (pane.bars + 2) >= width_m:
        raise source.error(
            (*keys, "pane"),
            f"frame and bars leave nothing of the opening of {width_m:g} m",
            "Make frame_m smaller, or 0 for a pane without a frame.",
        )
    return start_m, end_m


def _piece(
    outline: Outline,
    segment: int,
    from_to_m: tuple[float | None, float | None],
    low_high_m: tuple[float, float],
) -> list[Prism]:
    """A piece of wall along a segment, None for the corner there; empty if it has no size."""
    corners = (segment, (segment + 1) % len(outline.points))
    right, left = (
        [
            outline.corner(corner, offset_m) if s is None else outline.at(segment, s, offset_m)
            for corner, s in zip(corners, from_to_m, strict=True)
        ]
        for offset_m in (outline.right_m, outline.left_m)
    )
    footprint = np.array([right[0], right[1], left[1], left[0]])
    x, y = footprint.T
    area_m2 = float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    if area_m2 < 1e-9 or low_high_m[1] - low_high_m[0] < 1e-9:
        return []
    return [Prism(footprint, *low_high_m)]
