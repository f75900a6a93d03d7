"""The hot loop that compares points with what another scan saw in their directions."""

from __future__ import annotations

import math

from numba import njit

from frontend.kernel_types import Bytes, Floats

HIDDEN, AGREES, CONTRADICTS = 0, 1, 2


@njit(cache=True)
def compare_with_view(
    points: Floats,
    view_points: Floats,
    view_bearings: Floats,
    origin_x: float,
    origin_y: float,
    margin_m: float,
    margin_ratio: float,
    gap_rad: float,
    verdicts: Bytes,
) -> None:
    """Tell for each point whether a view agrees with it, contradicts it or knows nothing of it.

    points        : (N, 2) m, in the frame of the view.
    view_points   : (M, 2) m, its end points around (origin_x, origin_y), by ascending bearing.
    view_bearings : (M,) rad, ascending, in -pi..pi.
    verdicts      : (N,) in and out. CONTRADICTS: the point stands in the free space in front of
        both of the view's points beside it, by more than margin_m + margin_ratio * range. AGREES:
        it stands between them, give or take that margin. What agreed before stays so; what lies
        behind, or where the view has no two points within gap_rad, leaves a verdict as it is.
    Cost: N log M.
    """
    count = view_bearings.shape[0]
    if count < 2:
        return
    for i in range(points.shape[0]):
        if verdicts[i] == AGREES:
            continue
        dx = points[i, 0] - origin_x
        dy = points[i, 1] - origin_y
        bearing = math.atan2(dy, dx)
        low = 0
        high = count
        while low < high:  # the first point of the view beyond the bearing
            middle = (low + high) // 2
            if view_bearings[middle] > bearing:
                high = middle
            else:
                low = middle + 1
        if low == 0 or low == count or view_bearings[low] - view_bearings[low - 1] > gap_rad:
            continue
        range_m = math.sqrt(dx * dx + dy * dy)
        margin = margin_m + margin_ratio * range_m
        first = math.hypot(view_points[low - 1, 0] - origin_x, view_points[low - 1, 1] - origin_y)
        second = math.hypot(view_points[low, 0] - origin_x, view_points[low, 1] - origin_y)
        if range_m < min(first, second) - margin:
            verdicts[i] = CONTRADICTS
        elif range_m < max(first, second) + margin:
            verdicts[i] = AGREES
