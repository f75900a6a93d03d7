"""What fills an opening of a wall: the leaf of a door, a pane with its frame."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from datasets.messages import Array
from datasets.simulation.place_file import LeafSection, PaneSection
from datasets.simulation.place_geometry import Part, Prism
from datasets.simulation.place_outline import Outline


def _slab(
    outline: Outline,
    segment: int,
    from_to_m: tuple[float, float],
    right_left_m: tuple[float, float],
    low_high_m: tuple[float, float],
) -> Prism:
    (start_m, end_m), (right_m, left_m) = from_to_m, right_left_m
    corners = ((start_m, right_m), (end_m, right_m), (end_m, left_m), (start_m, left_m))
    return Prism(np.array([outline.at(segment, s, d) for s, d in corners]), *low_high_m)


def leaf_prism(
    leaf: LeafSection,
    outline: Outline,
    segment: int,
    from_to_m: tuple[float, float],
    low_high_m: tuple[float, float],
) -> Prism:
    """The leaf, flush with the side it swings to, turned about its corner there."""
    left = leaf.swing == "left"
    side_m = outline.left_m if left else outline.right_m
    thick = (side_m - leaf.thickness_m, side_m) if left else (side_m, side_m + leaf.thickness_m)
    closed = _slab(outline, segment, from_to_m, thick, low_high_m)
    hinge = outline.at(segment, from_to_m[0 if leaf.hinge == "start" else 1], side_m)
    turn_rad = math.radians(leaf.open_deg) * (1 if left == (leaf.hinge == "start") else -1)
    about_hinge = Prism(closed.footprint - hinge, *low_high_m)
    return about_hinge.placed(float(hinge[0]), float(hinge[1]), turn_rad)


def leaf_hinge(
    leaf: LeafSection, outline: Outline, segment: int, at_m: float, width_m: float
) -> tuple[Array, Array, float]:
    """Hinge and, when it is closed, tip of a leaf, (2,) m each; the turn by which it is open."""
    left, at_start = leaf.swing == "left", leaf.hinge == "start"
    side_m = outline.left_m if left else outline.right_m
    start, end = (outline.at(segment, at_m + half, side_m) for half in (-width_m / 2, width_m / 2))
    turn_rad = math.radians(leaf.open_deg) * (1 if left == at_start else -1)
    return (start, end, turn_rad) if at_start else (end, start, turn_rad)


def pane_parts(
    pane: PaneSection,
    outline: Outline,
    segment: int,
    from_to_m: tuple[float, float],
    low_high_m: tuple[float, float],
    names: tuple[str, str],
    keys: tuple[str | int, ...],
) -> Iterator[Part]:
    """The glass in the middle of the wall, then frame and bars around it."""
    middle_m = (outline.left_m + outline.right_m) / 2
    (start_m, end_m), (low_m, high_m), frame_m = from_to_m, low_high_m, pane.frame_m
    depth = (middle_m - pane.thickness_m / 2, middle_m + pane.thickness_m / 2)
    count, free_m = pane.bars + 1, end_m - start_m - (pane.bars + 2) * frame_m
    glass, frame = [], []
    frame_depth_m = max(frame_m, pane.thickness_m) / 2
    thick = (middle_m - frame_depth_m, middle_m + frame_depth_m)
    for field in range(count):
        from_m = start_m + frame_m + field * (free_m / count + frame_m)
        to_m = from_m + free_m / count
        glass.append(
            _slab(outline, segment, (from_m, to_m), depth, (low_m + frame_m, high_m - frame_m))
        )
        # A bar ends at the frame above and below it; the first one is the frame's side.
        inset_m = frame_m if field else 0.0
        tall_m = (low_m + inset_m, high_m - inset_m)
        frame.append(_slab(outline, segment, (from_m - frame_m, from_m), thick, tall_m))
    yield Part(names[0], pane.material, tuple(glass), keys, wall=True)
    if frame_m > 0.0:
        frame.append(_slab(outline, segment, (end_m - frame_m, end_m), thick, low_high_m))
        inner_m = (start_m + frame_m, end_m - frame_m)
        for low_high in ((low_m, low_m + frame_m), (high_m - frame_m, high_m)):
            frame.append(_slab(outline, segment, inner_m, thick, low_high))
        yield Part(names[1], pane.frame_material, tuple(frame), keys, True, "frame_material")
