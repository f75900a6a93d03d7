"""The hot loops of improved correlative matching: a likelihood field between its cells.

The field is (rows, cols) uint8, 255 for certain; the cell (row, col) has its centre at
origin + (col + 1/2, row + 1/2) cell_m.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from frontend.kernel_types import Bytes, Floats
from frontend.match_kernels import solve3


@njit(cache=True)
def draw_field(
    points: Floats,
    origin_x: float,
    origin_y: float,
    cell_m: float,
    sigma_m: float,
    reach_cells: int,
    field: Bytes,
) -> None:
    """255 exp(-d^2 / 2 sigma^2), d from a cell's centre to the nearest point, 0 beyond the reach.

    points (N, 2), at least reach_cells + 1 cells inside the field. field : zeros, drawn in place.
    Cost: N (2 reach + 1)^2.
    """
    for i in range(points.shape[0]):
        col_0 = int(math.floor((points[i, 0] - origin_x) / cell_m))
        row_0 = int(math.floor((points[i, 1] - origin_y) / cell_m))
        for row in range(row_0 - reach_cells, row_0 + reach_cells + 1):
            dy = origin_y + (row + 0.5) * cell_m - points[i, 1]
            for col in range(col_0 - reach_cells, col_0 + reach_cells + 1):
                dx = origin_x + (col + 0.5) * cell_m - points[i, 0]
                value = 255.0 * math.exp(-(dx * dx + dy * dy) / (2.0 * sigma_m * sigma_m))
                if value > field[row, col]:
                    field[row, col] = int(value + 0.5)


@njit(cache=True)
def _cubic(t: float) -> tuple[float, float, float, float]:
    """Weights of four cells for a place a share t (0..1) of the way from the 2nd to the 3rd."""
    return (
        0.5 * t * (t * (2.0 - t) - 1.0),
        0.5 * (t * t * (3.0 * t - 5.0) + 2.0),
        0.5 * t * (t * (4.0 - 3.0 * t) + 1.0),
        0.5 * t * t * (t - 1.0),
    )


@njit(cache=True)
def _cubic_slope(t: float) -> tuple[float, float, float, float]:
    """Their derivatives by t."""
    return (
        0.5 * (t * (4.0 - 3.0 * t) - 1.0),
        0.5 * t * (9.0 * t - 10.0),
        0.5 * (t * (8.0 - 9.0 * t) + 1.0),
        0.5 * t * (3.0 * t - 2.0),
    )


@njit(cache=True)
def field_between(field: Bytes, row: float, col: float) -> tuple[float, float, float]:
    """The field, in 0..1, and its slopes (a row up, a col up) between the centres of cells.

    Cubic convolution (Keys 1981, a = -1/2, the Catmull-Rom spline) of 4 x 4 cells, as Cartographer
    refines. row, col : in cells, whole numbers at the centres. 0 at the border and outside.
    """
    row_0 = int(math.floor(row))
    col_0 = int(math.floor(col))
    if row_0 < 1 or col_0 < 1 or row_0 >= field.shape[0] - 2 or col_0 >= field.shape[1] - 2:
        return 0.0, 0.0, 0.0
    across, along = _cubic(row - row_0), _cubic(col - col_0)
    across_slope, along_slope = _cubic_slope(row - row_0), _cubic_slope(col - col_0)
    value = 0.0
    by_row = 0.0
    by_col = 0.0
    for k in range(4):
        here = 0.0
        slope = 0.0
        for m in range(4):
            cell = float(field[row_0 - 1 + k, col_0 - 1 + m])
            here += along[m] * cell
            slope += along_slope[m] * cell
        value += across[k] * here
        by_row += across_slope[k] * here
        by_col += across[k] * slope
    return value / 255.0, by_row / 255.0, by_col / 255.0


@njit(cache=True)
def field_values(
    points: Floats,
    x: float,
    y: float,
    yaw: float,
    field: Bytes,
    origin_x: float,
    origin_y: float,
    cell_m: float,
    values: Floats,
) -> None:
    """values (N,) out: the field under each point at a pose, between cells."""
    c = math.cos(yaw)
    s = math.sin(yaw)
    for i in range(points.shape[0]):
        col = (x + c * points[i, 0] - s * points[i, 1] - origin_x) / cell_m - 0.5
        row = (y + s * points[i, 0] + c * points[i, 1] - origin_y) / cell_m - 0.5
        values[i] = field_between(field, row, col)[0]


@njit(cache=True)
def field_equations(
    points: Floats,
    weights: Floats,
    x: float,
    y: float,
    yaw: float,
    field: Bytes,
    origin_x: float,
    origin_y: float,
    cell_m: float,
    H: Floats,
    g: Floats,
) -> float:
    """One linearisation of the weighted mean of (1 - field)^2. Returns that mean.

    H (3, 3), g (3,) out: J^T J and J^T e of its root, for (x, y, yaw) in map axes.
    Cost: 16 N cells.
    """
    H[:, :] = 0.0
    g[:] = 0.0
    c = math.cos(yaw)
    s = math.sin(yaw)
    total = 0.0
    weight_sum = 0.0
    J = np.empty(3)
    for i in range(points.shape[0]):
        lever_x = c * points[i, 0] - s * points[i, 1]
        lever_y = s * points[i, 0] + c * points[i, 1]
        value, by_row, by_col = field_between(
            field, (y + lever_y - origin_y) / cell_m - 0.5, (x + lever_x - origin_x) / cell_m - 0.5
        )
        J[0] = by_col / cell_m
        J[1] = by_row / cell_m
        J[2] = J[1] * lever_x - J[0] * lever_y
        e = 1.0 - value
        w = weights[i]
        total += w * e * e
        weight_sum += w
        for r in range(3):
            g[r] -= w * e * J[r]
            for k in range(3):
                H[r, k] += w * J[r] * J[k]
    if weight_sum <= 0.0:
        return 1.0
    for r in range(3):
        g[r] /= weight_sum
        for k in range(3):
            H[r, k] /= weight_sum
    return total / weight_sum


@njit(cache=True)
def refine_on_field(
    points: Floats,
    weights: Floats,
    start: Floats,
    expected: Floats,
    penalty: Floats,
    field: Bytes,
    origin_x: float,
    origin_y: float,
    cell_m: float,
    iterations: int,
    pose: Floats,
) -> int:
    """Gauss-Newton on the field between cells; a step that does not help is halved.

    Least: the mean of (1 - field)^2 plus sum penalty (pose - expected)^2.
    start, expected : (3,) x, y, yaw on one branch. penalty (3,) : per m^2, m^2, rad^2.
    pose (3,) out. Returns the steps taken.
    """
    H = np.empty((3, 3))
    g = np.empty(3)
    A = np.empty((3, 3))
    b = np.empty(3)
    step = np.empty(3)
    tried = np.empty(3)
    H_tried = np.empty((3, 3))
    g_tried = np.empty(3)
    pose[:] = start
    cost = field_equations(
        points, weights, pose[0], pose[1], pose[2], field, origin_x, origin_y, cell_m, H, g
    )
    for r in range(3):
        cost += penalty[r] * (pose[r] - expected[r]) ** 2
    taken = 0
    for _ in range(iterations):
        for r in range(3):
            b[r] = -g[r] - penalty[r] * (pose[r] - expected[r])
            for k in range(3):
                A[r, k] = H[r, k]
            A[r, r] += penalty[r]
        if not solve3(A, b, step):
            break
        # the field's slope says nothing about what is farther away than a cell
        shift = math.sqrt(step[0] * step[0] + step[1] * step[1])
        scale = min(1.0, cell_m / max(shift, 1e-12), 0.05 / max(abs(step[2]), 1e-12))
        better = False
        for _half in range(5):
            for r in range(3):
                tried[r] = pose[r] + scale * step[r]
            cost_tried = field_equations(
                points,
                weights,
                tried[0],
                tried[1],
                tried[2],
                field,
                origin_x,
                origin_y,
                cell_m,
                H_tried,
                g_tried,
            )
            for r in range(3):
                cost_tried += penalty[r] * (tried[r] - expected[r]) ** 2
            if cost_tried < cost:
                better = True
                break
            scale *= 0.5
        if not better:
            break
        taken += 1
        pose[:] = tried
        H[:, :] = H_tried
        g[:] = g_tried
        cost = cost_tried
        if scale * shift < 2e-4 and scale * abs(step[2]) < 1e-4:
            break
    return taken


@njit(cache=True)
def score_volume(
    points: Floats,
    weights: Floats,
    pose: Floats,
    axes: Floats,
    field: Bytes,
    origin_x: float,
    origin_y: float,
    cell_m: float,
    scores: Floats,
) -> None:
    """The weighted mean of the field at poses around one: the score volume of Olson, section 3.3.

    axes : (3, 3), its columns one step of the volume each, (m, m, rad) in map axes.
    scores : (2 h + 1, 2 h + 1, 2 h + 1) out, the pose itself in the middle.
    Cost: (2 h + 1)^3 times 16 N cells.
    """
    half = scores.shape[0] // 2
    weight_sum = 0.0
    for i in range(points.shape[0]):
        weight_sum += weights[i]
    for a in range(-half, half + 1):
        for b in range(-half, half + 1):
            for d in range(-half, half + 1):
                x = pose[0] + a * axes[0, 0] + b * axes[0, 1] + d * axes[0, 2] - origin_x
                y = pose[1] + a * axes[1, 0] + b * axes[1, 1] + d * axes[1, 2] - origin_y
                yaw = pose[2] + a * axes[2, 0] + b * axes[2, 1] + d * axes[2, 2]
                c = math.cos(yaw)
                s = math.sin(yaw)
                total = 0.0
                for i in range(points.shape[0]):
                    col = (x + c * points[i, 0] - s * points[i, 1]) / cell_m - 0.5
                    row = (y + s * points[i, 0] + c * points[i, 1]) / cell_m - 0.5
                    total += weights[i] * field_between(field, row, col)[0]
                scores[a + half, b + half, d + half] = total / max(weight_sum, 1e-12)
