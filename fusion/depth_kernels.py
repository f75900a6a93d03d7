"""The hot loops over the pixels of a depth image: arrays and scalars in and out."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from fusion.kernel_types import Float32s, Floats

Ints = npt.NDArray[np.int32]
Shorts = npt.NDArray[np.int16]


class Gate(NamedTuple):
    """What lies between floor and top, as one image is looked at. Lengths in m, heights over the
    nominal floor, of which the camera's ground point is the origin.

    height, per_column, per_row, rise : a pixel of the small image at depth z lies at
        height + (rise + column per_column + row per_row) z.
    tilt : what may be wrong with that, rad. reach : planar, up to which pixels count.
    """

    height: float
    rise: float
    per_column: float
    per_row: float
    lower: float
    upper: float
    tilt: float
    reach: float


@njit(cache=True)
def is_flying(
    depth_m: Float32s, row: int, column: int, focal_baseline: float, steepest: float
) -> bool:
    """Whether the disparity changes here faster than on any plane, to one of the 4 neighbours.

    Disparity d = f B / z is linear in the image on a plane, and changes by B / D px a pixel at the
    most, D being the plane's distance from the camera. |f B / z - f B / z'| > steepest, without
    dividing. Holes (NaN) say nothing.
    """
    z = depth_m[row, column]
    bound = steepest / focal_baseline * z
    if column > 0:
        other = depth_m[row, column - 1]
        if abs(z - other) > bound * other:
            return True
    if column + 1 < depth_m.shape[1]:
        other = depth_m[row, column + 1]
        if abs(z - other) > bound * other:
            return True
    if row > 0:
        other = depth_m[row - 1, column]
        if abs(z - other) > bound * other:
            return True
    if row + 1 < depth_m.shape[0]:
        other = depth_m[row + 1, column]
        if abs(z - other) > bound * other:
            return True
    return False


@njit(cache=True)
def tally(
    depth_m: Float32s,
    step: int,
    rows: tuple[int, int],
    gate: Gate,
    margins: Float32s,
    planars: Float32s,
    bins: Shorts,
    exits: Shorts,
    focal_baseline: float,
    steepest: float,
    cells_per_m: float,
    count: Ints,
    total: Float32s,
    free: Ints,
) -> None:
    """Count each bin's pixels: obstacles by planar range, free ones by where they meet the floor.

    depth_m : (H, W), NaN holes; every ``step``-th pixel is taken, of the rows (from, to) of the
    small images margins, planars, bins, exits : (h, w), h = ceil(H / step). bins, exits : columns
    of ``count`` and ``free``, -1 for none. margins : 1/m, how much larger than it is noise may make
    the inverse depth of the floor.
    The gate's lower edge lies ``gate.lower`` high, or where tilt and noise may lift the floor, if
    that is higher. As far below the floor, what is seen is a pit or a mirror: unknown.
    count, total : (B, C) out, zero before: number and sum of the ranges, m. free : (B, E) out.
    Cost: 5-10 ns a pixel.
    """
    lower, upper, tilt = np.float32(gate.lower), np.float32(gate.upper), np.float32(gate.tilt)
    height, reach = np.float32(gate.height), np.float32(gate.reach)
    per_column = np.float32(gate.per_column)
    for row in range(rows[0], rows[1]):
        first_rise = np.float32(gate.rise + row * gate.per_row)
        for column in range(bins.shape[1]):
            z = depth_m[row * step, column * step]
            bearing = bins[row, column]
            if bearing < 0 or not z > 0.0:
                continue
            rise = first_rise + np.float32(column) * per_column
            high = height + rise * z
            if high > upper:
                continue
            range_m = z * planars[row, column]
            # The floor's own ray: (1 / z - 1 / z_floor) < margin, without dividing.
            edge = max(lower, tilt * range_m + height * z * margins[row, column])
            if high <= edge or range_m > reach:
                leaves = exits[row, column]
                if leaves >= 0 and high > -edge:
                    free[bearing, leaves] += 1
                continue
            if is_flying(depth_m, row * step, column * step, focal_baseline, steepest):
                continue
            cell = int(range_m * cells_per_m)
            if cell < count.shape[1]:
                count[bearing, cell] += 1
                total[bearing, cell] += range_m


@njit(cache=True)
def find_surfaces(
    count: Ints,
    total: Float32s,
    halves: Ints,
    needs: Float32s,
    max_range_m: float,
    cell_m: float,
    tail: float,
    ranges_m: Floats,
    members: Ints,
    suspect_m: Floats,
    surfaces: Float32s,
) -> int:
    """Clusters of pixels over range in each bin, nearest first; returns how many. Cost: B C.

    count, total : (B, C) as ``tally`` fills them. halves : (C,) half a window in cells, as wide as
    the noise there. needs : (C,) pixels in a window that make a surface.
    From the first window with enough pixels on, the fullest one within 5/4 of a window's width is
    taken (as it is there), so that the near tail of the noise does not pass for the surface; its
    range is the mean.
    What follows at once must have the share ``tail`` of it, or is the far tail.
    ranges_m, members : (B,) out, the nearest cluster's range and pixels; +inf and 0 where none is.
    suspect_m : (B,) out, where the first half-supported window ends; +inf where none is.
    surfaces : (>= B C / 2, 2) out, bin and range of each cluster.
    """
    found = 0
    cells = count.shape[1]
    upto = np.zeros(cells + 1, dtype=np.int32)
    for bearing in range(count.shape[0]):
        ranges_m[bearing] = math.inf
        suspect_m[bearing] = math.inf
        members[bearing] = 0
        for cell in range(cells):
            upto[cell + 1] = upto[cell] + count[bearing, cell]
        if upto[cells] == 0:
            continue
        cell = 0
        taken = 0
        last = 0
        while cell < cells:
            half = halves[cell]
            inside = upto[min(cell + half + 1, cells)] - upto[max(cell - half, taken)]
            if inside >= 0.5 * needs[cell] and suspect_m[bearing] == math.inf:
                suspect_m[bearing] = (cell + half) * cell_m
            enough = needs[cell]
            if last > 0 and cell <= taken + half:
                enough = max(enough, tail * last)
            if inside < enough:
                cell += 1
                continue
            fullest = cell
            last_tried = cell
            reach = cell + 5 * half // 2
            while last_tried < min(reach, cells - 1):
                last_tried += 1
                wide = halves[last_tried]
                there = (
                    upto[min(last_tried + wide + 1, cells)] - upto[max(last_tried - wide, taken)]
                )
                if there > inside:
                    inside = there
                    fullest = last_tried
                    reach = max(reach, cell + 5 * wide // 2)  # farther away the noise is wider
            half = halves[fullest]
            first = max(fullest - half, taken)
            taken = min(fullest + half + 1, cells)
            sum_m = 0.0
            for other in range(first, taken):
                sum_m += total[bearing, other]
            range_m = sum_m / inside
            last = inside
            cell = taken
            if range_m > max_range_m:
                break
            if members[bearing] == 0:
                ranges_m[bearing] = range_m
                members[bearing] = inside
            surfaces[found, 0] = bearing
            surfaces[found, 1] = range_m
            found += 1
    return found
