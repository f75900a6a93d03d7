"""The hot loop that asks which scans looked through a point: free space as they saw it."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from backend._kernels import lower_bound
from frontend.kernel_types import Floats, Ints


@njit(cache=True)
def seen_through(
    points: Floats,
    viewers: Floats,
    starts: Ints,
    bearings: Floats,
    ranges: Floats,
    gap_rad: float,
    margin_m: float,
    margin_share: float,
    out: Ints,
) -> None:
    """How many scans saw free space where each point is: their beams on both sides of it end well
    behind it.

    points   : (N, 2) m. viewers : (V, 3), where each scan's sensor stands and how its base is
               turned, x m, y m, yaw rad, in the frame of the points.
    starts   : (V + 1,) where each scan's beams begin in bearings (ascending, in the base's axes,
               around the sensor) and ranges: returns only, so that where nothing came back nothing
               is free.
    gap_rad  : beams farther apart than this have nothing between them.
    margin_m, margin_share : how far behind a point, and how much of its distance, counts as behind.
    out      : (N,) counts, written.
    """
    for i in range(points.shape[0]):
        out[i] = 0
    for v in range(viewers.shape[0]):
        first = starts[v]
        last = starts[v + 1]
        if last - first < 4:
            continue
        for i in range(points.shape[0]):
            dx = points[i, 0] - viewers[v, 0]
            dy = points[i, 1] - viewers[v, 1]
            beyond = math.sqrt(dx * dx + dy * dy) * (1.0 + margin_share) + margin_m
            angle = math.atan2(dy, dx) - viewers[v, 2]
            angle -= 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
            low = lower_bound(bearings, first, last, angle)
            if low <= first or low >= last:
                continue
            if bearings[low] - bearings[low - 1] > gap_rad:
                continue
            nearest = np.inf
            for j in range(max(first, low - 2), min(last, low + 2)):
                if ranges[j] < nearest:
                    nearest = ranges[j]
            if nearest > beyond:
                out[i] += 1


@njit(cache=True)
def compare_views(
    from_nodes: Ints,
    to_nodes: Ints,
    sensors: Floats,
    starts: Ints,
    bearings: Floats,
    ranges: Floats,
    within_m: float,
    gap_rad: float,
    margin_m: float,
    margin_share: float,
    out: Ints,
) -> None:
    """Of each pair of scans, how the points of one lie against the beams of the other.

    from_nodes, to_nodes : (M,) whose points, and whose beams.
    sensors  : (N, 3), where each scan's sensor stands, and how its base is turned: x m, y m, rad.
    starts, bearings, ranges : all scans' returns, see ``seen_through``.
    within_m : points farther from their own sensor than this don't count.
    out      : (M, 3) written: points that the other saw as well, points that it saw through, points
               that something hid from it.
    """
    for k in range(from_nodes.shape[0]):
        a = from_nodes[k]
        b = to_nodes[k]
        same = 0
        through = 0
        hidden = 0
        first = starts[b]
        last = starts[b + 1]
        for i in range(starts[a], starts[a + 1]):
            if ranges[i] > within_m or last - first < 4:
                continue
            yaw = sensors[a, 2] + bearings[i]
            dx = sensors[a, 0] + ranges[i] * math.cos(yaw) - sensors[b, 0]
            dy = sensors[a, 1] + ranges[i] * math.sin(yaw) - sensors[b, 1]
            distance = math.sqrt(dx * dx + dy * dy)
            if distance > 1.5 * within_m:
                continue
            angle = math.atan2(dy, dx) - sensors[b, 2]
            angle -= 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
            low = lower_bound(bearings, first, last, angle)
            if low <= first or low >= last or bearings[low] - bearings[low - 1] > gap_rad:
                continue
            least = np.inf
            most = 0.0
            for j in range(max(first, low - 2), min(last, low + 2)):
                least = min(least, ranges[j])
                most = max(most, ranges[j])
            margin = margin_m + margin_share * distance
            if least > distance + margin:
                through += 1
            elif most < distance - margin:
                hidden += 1
            else:
                same += 1
        out[k, 0] = same
        out[k, 1] = through
        out[k, 2] = hidden
