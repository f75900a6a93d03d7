"""The hot loops over the pixels of a depth image: arrays and scalars in and out."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float64]
Float32s = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
Shorts = npt.NDArray[np.int16]


class Gate(NamedTuple):
    """What lies within the gate. Lengths in m, px of disparity; see ``DepthConfig``.

    camera_m : height of the camera. wave_from : depth at which waves begin.
    reach_m : planar range up to which pixels are looked at. deviations : of the floor's noise.
    """

    camera_m: float
    lower_m: float
    upper_m: float
    tilt: float
    deviations: float
    focal_baseline: float
    subpixel: float
    wave: float
    wave_from: float
    reach_m: float


@njit(cache=True)
def disparity_noise(depth_m: float, gate: Gate) -> float:
    """Standard deviation of the disparity, px: noise of the matcher, and slow waves far away."""
    wave = gate.wave * max(0.0, depth_m / gate.wave_from - 1.0)
    return math.sqrt(gate.subpixel * gate.subpixel + wave * wave)


@njit(cache=True)
def above_floor(depth_m: float, rise: float, planar: float, gate: Gate) -> float:
    """Height over the gate's lower edge of a point on a ray, m.

    The edge lies ``lower_m`` high, or where tilt and noise may lift the floor, if that is higher:
    dz = z^2 sigma / (f B) lifts a point by ``rise`` times that. Concave in depth.
    """
    noise = abs(rise) * depth_m * depth_m * disparity_noise(depth_m, gate) / gate.focal_baseline
    doubt = gate.tilt * planar * depth_m + gate.deviations * noise
    return gate.camera_m + rise * depth_m - max(gate.lower_m, doubt)


@njit(cache=True)
def gate_depths(
    rises: Float32s,
    planars: Float32s,
    gate: Gate,
    near: Float32s,
    far: Float32s,
    deep: Float32s,
) -> None:
    """Depths between which each pixel lies in the gate. Cost: 30 halvings a pixel, once.

    rises, planars : (h, w) height and horizontal length of each ray, per m of depth.
    near, far : (h, w) out; far < near where nothing can be.
    deep : (h, w) out; what is seen between far and deep is the floor (or, on rays that leave the
           gate upwards or by range, anything farther: inf), what is deeper is a pit or a mirror.
    """
    for row in range(rises.shape[0]):
        for column in range(rises.shape[1]):
            rise = rises[row, column]
            planar = planars[row, column]
            low = 0.0
            high = gate.reach_m / max(planar, 1e-3)
            near[row, column] = 0.0
            deep[row, column] = math.inf
            if gate.camera_m > gate.upper_m:
                if rise >= 0.0:
                    near[row, column] = math.inf
                    far[row, column] = 0.0
                    continue
                near[row, column] = (gate.camera_m - gate.upper_m) / -rise
            elif rise > 0.0:
                high = min(high, (gate.upper_m - gate.camera_m) / rise)
            far[row, column] = high
            if above_floor(high, rise, planar, gate) < 0.0:
                for _ in range(30):
                    middle = 0.5 * (low + high)
                    if above_floor(middle, rise, planar, gate) < 0.0:
                        high = middle
                    else:
                        low = middle
                far[row, column] = low
                if rise < 0.0:
                    # As far from the floor's disparity on the other side.
                    inverse = 2.0 * -rise / gate.camera_m - 1.0 / max(low, 1e-6)
                    if inverse > 0.0:
                        deep[row, column] = 1.0 / inverse


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
    near: Float32s,
    far: Float32s,
    deep: Float32s,
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
    """Count each bin's pixels: obstacles by planar range, free ones by where they leave the gate.

    depth_m : (H, W), NaN holes; every ``step``-th pixel is taken, of the rows (from, to) of the
    small images near, far, deep, planars, bins, exits : (h, w), h = ceil(H / step). bins, exits :
    column of ``count`` and ``free``, -1 for none.
    count, total : (B, C) out, zero before: number and sum of the ranges, m. free : (B, E) out.
    Cost: 3-5 ns a pixel.
    """
    for row in range(rows[0], rows[1]):
        for column in range(bins.shape[1]):
            z = depth_m[row * step, column * step]
            bearing = bins[row, column]
            if bearing < 0 or not z > 0.0 or z < near[row, column]:
                continue
            if z > far[row, column]:
                leaves = exits[row, column]
                if leaves >= 0 and z < deep[row, column]:
                    free[bearing, leaves] += 1
                continue
            if is_flying(depth_m, row * step, column * step, focal_baseline, steepest):
                continue
            range_m = z * planars[row, column]
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
    From the first window with enough pixels on, the fullest one within a window's width is taken,
    so that the near tail of the noise does not pass for the surface; its range is the mean. What
    follows at once must have the share ``tail`` of it, or is the far tail.
    ranges_m, members : (B,) out, the nearest cluster's range and pixels; +inf and 0 where none is.
    suspect_m : (B,) out, where the first half-supported window begins; +inf where none does.
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
                suspect_m[bearing] = max(cell - half, 0) * cell_m
            enough = needs[cell]
            if last > 0 and cell <= taken + half:
                enough = max(enough, tail * last)
            if inside < enough:
                cell += 1
                continue
            fullest = cell
            for other in range(cell + 1, min(cell + 2 * half + 1, cells)):
                there = upto[min(other + half + 1, cells)] - upto[max(other - half, taken)]
                if there > inside:
                    inside = there
                    fullest = other
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
