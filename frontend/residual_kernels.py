"""What single residuals add to a normal system: of a surface, and of points without a normal."""

from __future__ import annotations

import math

from numba import njit

from frontend.kernel_types import FAST, Floats, Links, Surface

SINGLE_WEIGHT = 0.5
"""Of a point without a normal, beside one of a surface."""


@njit(cache=True, fastmath=FAST)
def add_residual(
    e: float,
    normal_x: float,
    normal_y: float,
    lever_x: float,
    lever_y: float,
    robust2: float,
    weight: float,
    H: Floats,
    g: Floats,
) -> float:
    """Add one distance e to the upper half of H and to g. Returns its weight, the robust one times
    the one given.

    The normal need not be unit; the lever goes from the base to the point, in map axes.
    """
    length = math.sqrt(normal_x * normal_x + normal_y * normal_y)
    nx = normal_x / length
    ny = normal_y / length
    root = robust2 / (robust2 + e * e)
    w = weight * (root * root)
    jt = -nx * lever_y + ny * lever_x
    H[0, 0] += w * nx * nx
    H[0, 1] += w * nx * ny
    H[0, 2] += w * nx * jt
    H[1, 1] += w * ny * ny
    H[1, 2] += w * ny * jt
    H[2, 2] += w * jt * jt
    g[0] += w * nx * e
    g[1] += w * ny * e
    g[2] += w * jt * e
    return w


@njit(cache=True, fastmath=FAST)
def _nearest(
    px: float,
    py: float,
    map_points: Floats,
    following: Links,
    head: Links,
    row: int,
    col: int,
    within2: float,
) -> tuple[int, float]:
    """The map point nearest to (px, py) in 3 x 3 list cells, and its squared distance; -1, or."""
    nearest = -1
    for rr in range(row - 1, row + 2):
        for cc in range(col - 1, col + 2):
            j = head[rr, cc]
            while j >= 0:
                dx = px - map_points[j, 0]
                dy = py - map_points[j, 1]
                d2 = dx * dx + dy * dy
                if d2 < within2:
                    within2 = d2
                    nearest = j
                j = following[j]
    return nearest, within2


@njit(cache=True, fastmath=FAST)
def add_single_points(
    points: Floats,
    pose: Floats,
    surface: Surface,
    single: Surface,
    origin_x: float,
    origin_y: float,
    list_cell_m: float,
    gate_m: float,
    robust_m: float,
    weight: float,
    H: Floats,
    g: Floats,
) -> None:
    """Add points (N, 2) that have no normal to the upper half of H and to g.

    Each is laid on what is nearest to it within the gate: on the surface along its normal, or on
    another single point, in both directions. Geman-McClure weights as in ``add_residual``, times
    ``weight``. Cost: N times the points in 3 x 3 list cells; list_cell_m >= gate_m.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    rows, cols = surface[4].shape
    r2 = robust_m * robust_m
    gate2 = gate_m * gate_m
    for i in range(points.shape[0]):
        lx = c * points[i, 0] - s * points[i, 1]
        ly = s * points[i, 0] + c * points[i, 1]
        px = pose[0] + lx
        py = pose[1] + ly
        col = int(math.floor((px - origin_x) / list_cell_m))
        row = int(math.floor((py - origin_y) / list_cell_m))
        if row < 1 or col < 1 or row >= rows - 1 or col >= cols - 1:
            continue
        on, on2 = _nearest(px, py, surface[0], surface[3], surface[4], row, col, gate2)
        at, at2 = _nearest(px, py, single[0], single[3], single[4], row, col, on2)
        if at >= 0:
            dx = px - single[0][at, 0]
            dy = py - single[0][at, 1]
            root = r2 / (r2 + at2)
            w = weight * (root * root)
            H[0, 0] += w
            H[0, 2] -= w * ly
            H[1, 1] += w
            H[1, 2] += w * lx
            H[2, 2] += w * (lx * lx + ly * ly)
            g[0] += w * dx
            g[1] += w * dy
            g[2] += w * (lx * dy - ly * dx)
        elif on >= 0:
            nx = surface[1][on, 0]
            ny = surface[1][on, 1]
            e = nx * (px - surface[0][on, 0]) + ny * (py - surface[0][on, 1])
            add_residual(e, nx, ny, lx, ly, r2, weight, H, g)
