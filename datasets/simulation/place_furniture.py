"""Furniture with legs and overhangs, put together from boxes: x is forward, z up from the floor."""

from __future__ import annotations

import math

import numpy as np

from datasets.simulation.place_file import FurnitureSection
from datasets.simulation.place_geometry import Prism, column, cuboid

Triple = tuple[float, float, float]

TABLE_TOP_M, TABLE_LEG_M = 0.03, 0.05
SEAT_M, CHAIR_LEG_M, BACK_M = 0.05, 0.035, 0.03
SHELF_BOARD_M, SHELF_SPACING_M = 0.02, 0.36


def furniture(item: FurnitureSection) -> tuple[Prism, ...]:
    """The boxes of a piece of furniture, in the place.

    Raises ValueError if its size leaves no room for its legs and boards.
    """
    makers = {
        "table": table,
        "chair": chair,
        "swivel-chair": swivel_chair,
        "sofa": sofa,
        "shelf": shelf,
    }
    least = {"table": (0.2, 0.2, 0.2), "shelf": (0.1, 0.2, 0.2)}.get(item.kind, (0.3, 0.3, 0.6))
    if any(size < needed for size, needed in zip(item.size_m, least, strict=True)):
        raise ValueError(f"a {item.kind} measures at least {list(least)} m")
    room_m = min(item.size_m[:2]) / 2 - TABLE_LEG_M
    if item.kind == "table" and item.overhang_m > room_m:
        raise ValueError(f"the top reaches at most {room_m:.3g} m over the legs of this table")
    overhang_m = item.overhang_m if item.kind == "table" else 0.0
    prisms = makers[item.kind](item.size_m, overhang_m)
    yaw_rad = math.radians(item.yaw_deg)
    return tuple(prism.placed(*item.at_m, yaw_rad) for prism in prisms)


def _legs(length_m: float, width_m: float, leg_m: float, height_m: float) -> list[Prism]:
    x_m, y_m = (length_m - leg_m) / 2, (width_m - leg_m) / 2
    size = (leg_m, leg_m, height_m)
    return [cuboid((sx * x_m, sy * y_m), size) for sx in (-1, 1) for sy in (-1, 1)]


def table(size_m: Triple, overhang_m: float) -> list[Prism]:
    """A top that reaches over four legs."""
    length_m, width_m, height_m = size_m
    under_m = height_m - TABLE_TOP_M
    top = cuboid((0.0, 0.0), (length_m, width_m, TABLE_TOP_M), under_m)
    inset_m = 2 * overhang_m
    return [top, *_legs(length_m - inset_m, width_m - inset_m, TABLE_LEG_M, under_m)]


def _back(size_m: Triple, seat_top_m: float, thickness_m: float) -> Prism:
    """A back along the rear edge: who sits there looks along x."""
    length_m, width_m, height_m = size_m
    size = (thickness_m, width_m, height_m - seat_top_m)
    return cuboid((-(length_m - thickness_m) / 2, 0.0), size, seat_top_m)


def chair(size_m: Triple, _: float) -> list[Prism]:
    """Four thin legs, a seat, a back."""
    length_m, width_m, height_m = size_m
    under_m = 0.53 * height_m - SEAT_M
    seat = cuboid((0.0, 0.0), (length_m, width_m, SEAT_M), under_m)
    legs = _legs(length_m, width_m, CHAIR_LEG_M, under_m)
    return [seat, _back(size_m, under_m + SEAT_M, BACK_M), *legs]


def swivel_chair(size_m: Triple, _: float) -> list[Prism]:
    """Five arms close over the floor, a column, a seat, a back: low things a lidar misses."""
    length_m, width_m, height_m = size_m
    under_m = 0.5 * height_m - SEAT_M
    reach_m = min(length_m, width_m) / 2
    arm = cuboid((reach_m / 2, 0.0), (reach_m, 0.05, 0.05), 0.04)
    arms = [arm.placed(0.0, 0.0, float(yaw)) for yaw in np.arange(5) * 2 * math.pi / 5]
    post = column((0.0, 0.0), 0.03, under_m - 0.09, 0.09, sides=12)
    seat = cuboid((0.0, 0.0), (length_m, width_m, SEAT_M), under_m)
    return [seat, post, _back(size_m, under_m + SEAT_M, BACK_M), *arms]


def sofa(size_m: Triple, _: float) -> list[Prism]:
    """A thick seat and back on short legs, with a gap below."""
    length_m, width_m, height_m = size_m
    gap_m, seat_top_m = 0.12, 0.55 * height_m
    seat = cuboid((0.0, 0.0), (length_m, width_m, seat_top_m - gap_m), gap_m)
    legs = _legs(length_m, width_m, TABLE_LEG_M, gap_m)
    return [seat, _back(size_m, seat_top_m, 0.25 * length_m), *legs]


def shelf(size_m: Triple, _: float) -> list[Prism]:
    """Open to the front: two sides, a back, boards."""
    length_m, width_m, height_m = size_m
    board_m = SHELF_BOARD_M
    y_m = (width_m - board_m) / 2
    sides = [cuboid((0.0, sign * y_m), (length_m, board_m, height_m)) for sign in (-1, 1)]
    inner_m = width_m - 2 * board_m
    back = cuboid((-(length_m - board_m) / 2, 0.0), (board_m, inner_m, height_m))
    count = max(2, round(height_m / SHELF_SPACING_M) + 1)
    deep = (length_m - board_m, inner_m, board_m)
    levels_m = np.linspace(0.0, height_m - board_m, count)
    boards = [cuboid((board_m / 2, 0.0), deep, float(level_m)) for level_m in levels_m]
    return [*sides, back, *boards]
