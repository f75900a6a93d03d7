"""Which beams of a lidar's turn see one surface, and how it lies."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fusion.kernel_types import Bytes, Floats

FIT_REACH_M = 0.25
FIT_REACH_BEAMS = 6
"""Half the stretch of a surface to which a line is fitted."""
JOINED_M = 0.05
JOINED_SPACINGS = 3.0
"""Neighbouring beams this near to each other see one surface (at 70 deg from its normal);"""
JOINED_SIGMAS = 3.0
"""at more grazing angles three of them must lie on a line, as surely as noise lets one say."""


@njit(cache=True)
def join_beams(
    ranges: Floats,
    bearings: Floats,
    points: Floats,
    offsets: Floats,
    variances: Floats,
    spacing: float,
    joined: Bytes,
) -> None:
    """joined (N,) out: 1 where beam i and the next one counter-clockwise saw one surface.

    On a line 1/r is linear in the bearing (but for the square of the step): a middle range off
    the harmonic mean of its neighbours tells a corner or an edge. Beams next to each other whose
    times are half a turn apart (the seam of the turn) are not joined. Cost: N.
    """
    count = ranges.size
    seam_s = 0.5 * (offsets.max() - offsets.min()) if offsets.size else 0.0
    for i in range(count):
        joined[i] = 0
        j = (i + 1) % count
        if not _neighbours(i, j, ranges, bearings, spacing):
            continue
        if offsets.size and abs(offsets[j] - offsets[i]) > seam_s:
            continue
        gap = math.hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
        if gap <= JOINED_M + JOINED_SPACINGS * spacing * min(ranges[i], ranges[j]):
            joined[i] = 1
            continue
        before = (i - 1) % count
        after = (j + 1) % count
        if (
            _neighbours(before, i, ranges, bearings, spacing)
            and _on_a_line(before, i, j, ranges, bearings, variances)
        ) or (
            _neighbours(j, after, ranges, bearings, spacing)
            and _on_a_line(i, j, after, ranges, bearings, variances)
        ):
            joined[i] = 1


@njit(cache=True)
def _neighbours(i: int, j: int, ranges: Floats, bearings: Floats, spacing: float) -> bool:
    """Beam j follows i without a gap, and both returned."""
    if i == j or not (math.isfinite(ranges[i]) and math.isfinite(ranges[j])):
        return False
    step = bearings[j] - bearings[i]
    if step < 0.0:
        step += 2.0 * math.pi
    return step <= 1.5 * spacing and ranges[i] > 0.0 and ranges[j] > 0.0


@njit(cache=True)
def _on_a_line(a: int, b: int, c: int, ranges: Floats, bearings: Floats, variances: Floats) -> bool:
    span = (bearings[c] - bearings[a]) % (2.0 * math.pi)
    if span == 0.0:
        return False
    share = ((bearings[b] - bearings[a]) % (2.0 * math.pi)) / span
    inverse = (1.0 - share) / ranges[a] + share / ranges[c]
    expected = 1.0 / inverse
    # what the errors of a and c do to the expected range
    da = (1.0 - share) * (expected / ranges[a]) ** 2
    dc = share * (expected / ranges[c]) ** 2
    variance = variances[b] + da * da * variances[a] + dc * dc * variances[c]
    off = ranges[b] - expected
    return off * off <= JOINED_SIGMAS * JOINED_SIGMAS * variance


@njit(cache=True)
def nearest_beam(bearing: float, bearings: Floats) -> int:
    """Index of the nearest of (N,) ascending bearings, N >= 1, the way round as well."""
    count = bearings.size
    after = np.searchsorted(bearings, bearing)
    low = (after - 1) % count
    high = after % count
    to_low = (bearing - bearings[low]) % (2.0 * math.pi)
    to_high = (bearings[high] - bearing) % (2.0 * math.pi)
    return int(low if to_low <= to_high else high)


@njit(cache=True)
def surface_normal(
    k: int, points: Floats, joined: Bytes, origin: Floats
) -> tuple[float, float, int]:
    """Unit normal of the line through the beams around k on its surface, and their number.

    The line is the one with the least sum of squared distances; one beam alone is taken to be
    met square on.
    """
    count = points.shape[0]
    sx = sy = sxx = sxy = syy = 0.0
    fitted = 1
    for side in (-1, 1):
        at = k
        for _ in range(FIT_REACH_BEAMS):
            following = (at + side) % count
            if joined[at if side == 1 else following] == 0 or following == k:
                break
            dx = points[following, 0] - points[k, 0]
            dy = points[following, 1] - points[k, 1]
            far = dx * dx + dy * dy > FIT_REACH_M * FIT_REACH_M
            if far and fitted > 2:
                break
            sx += dx
            sy += dy
            sxx += dx * dx
            sxy += dx * dy
            syy += dy * dy
            fitted += 1
            at = following
            if far:
                break
    if fitted < 3:
        x, y = origin[0] - points[k, 0], origin[1] - points[k, 1]
        length = max(math.sqrt(x * x + y * y), 1e-9)
        return x / length, y / length, fitted
    sxx -= sx * sx / fitted
    sxy -= sx * sy / fitted
    syy -= sy * sy / fitted
    angle = 0.5 * math.atan2(2.0 * sxy, sxx - syy)
    return -math.sin(angle), math.cos(angle), fitted
