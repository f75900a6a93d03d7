"""The hot loops of scan matching: arrays and scalars in and out, compiled once by Numba.

A local map is two things over the same window of the plane: the points themselves, in a grid of
linked lists (``head`` by cell, ``following`` by point), and a pyramid of likelihood fields.
Level 0 of the pyramid holds, for each cell, 255 exp(-d^2 / 2 sigma^2) with d the distance from the
cell's centre to the nearest point; a cell of level L holds the maximum over the 2^(L+1) x 2^(L+1)
cells of level 0 that begin at its corner. So its value bounds whatever a point can
meet that starts in this cell and is moved by less than 2^L cells towards +x and +y.
All levels lie one after the other in one flat array of uint8.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

FAST = {"reassoc", "contract", "arcp", "nsz"}

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Links = npt.NDArray[np.int32]
Bytes = npt.NDArray[np.uint8]


@njit(cache=True)
def estimate_normals(
    points: Floats,
    origin_x: float,
    origin_y: float,
    gap_m: float,
    gap_ratio: float,
    radius_m: float,
    most: int,
    normals: Floats,
) -> None:
    """Line fits through the neighbours of each beam. Cost: N (2 most + 1) at the most.

    points : (N, 2) end points in the order of the beams, seen from the origin.
    A neighbour counts while consecutive points are nearer than gap_m + gap_ratio * range; on each
    side two count at any distance, then those within radius_m, up to ``most``.
    normals : (N, 2) out, unit, towards the sensor; zero where no line fits (fewer than 3 points,
              or as thick as long).
    """
    n = points.shape[0]
    radius2 = radius_m * radius_m
    for i in range(n):
        normals[i, 0] = 0.0
        normals[i, 1] = 0.0
        vx = origin_x - points[i, 0]
        vy = origin_y - points[i, 1]
        r = math.sqrt(vx * vx + vy * vy)
        gap = gap_m + gap_ratio * r
        gap2 = gap * gap
        sx = 0.0
        sy = 0.0
        sxx = 0.0
        sxy = 0.0
        syy = 0.0
        count = 1
        for side in range(2):
            step = 1 if side == 0 else -1
            j = i
            for taken in range(most):
                k = j + step
                if k < 0 or k >= n:
                    break
                dx = points[k, 0] - points[j, 0]
                dy = points[k, 1] - points[j, 1]
                if dx * dx + dy * dy > gap2:
                    break
                ex = points[k, 0] - points[i, 0]
                ey = points[k, 1] - points[i, 1]
                if taken >= 2 and ex * ex + ey * ey > radius2:
                    break
                sx += ex
                sy += ey
                sxx += ex * ex
                sxy += ex * ey
                syy += ey * ey
                count += 1
                j = k
        if count < 3:
            continue
        mx = sx / count
        my = sy / count
        a = sxx / count - mx * mx
        b = sxy / count - mx * my
        c = syy / count - my * my
        half_trace = 0.5 * (a + c)
        root = math.sqrt(max(0.0, 0.25 * (a - c) * (a - c) + b * b))
        small = half_trace - root
        large = half_trace + root
        if large < 1e-8 or small > 0.09 * large:
            continue
        # eigenvector of the smaller eigenvalue
        angle = 0.5 * math.atan2(2.0 * b, a - c) + 0.5 * math.pi
        nx = math.cos(angle)
        ny = math.sin(angle)
        if nx * vx + ny * vy < 0.0:
            nx = -nx
            ny = -ny
        # a surface seen at less than 8 degrees is mostly mixed pixels
        if (nx * vx + ny * vy) < 0.14 * r:
            continue
        normals[i, 0] = nx
        normals[i, 1] = ny


@njit(cache=True)
def insert_points(
    points: Floats,
    normals: Floats,
    x: float,
    y: float,
    yaw: float,
    map_points: Floats,
    map_normals: Floats,
    map_weights: Floats,
    following: Links,
    count: int,
    head: Links,
    origin_x: float,
    origin_y: float,
    list_cell_m: float,
    merge_m: float,
) -> int:
    """Add a scan's points that have a normal to the linked lists. Returns the new count.

    A point nearer than merge_m to a map point of the same list cell and of nearly the same normal
    is averaged into it, so that the density of the map is bounded however often a wall is seen.
    map_weights counts what was averaged. The caller sees to room for all points.
    """
    c = math.cos(yaw)
    s = math.sin(yaw)
    rows, cols = head.shape
    merge2 = merge_m * merge_m
    for i in range(points.shape[0]):
        if normals[i, 0] == 0.0 and normals[i, 1] == 0.0:
            continue
        px = x + c * points[i, 0] - s * points[i, 1]
        py = y + s * points[i, 0] + c * points[i, 1]
        col = int(math.floor((px - origin_x) / list_cell_m))
        row = int(math.floor((py - origin_y) / list_cell_m))
        if row < 1 or col < 1 or row >= rows - 1 or col >= cols - 1:
            continue
        nx = c * normals[i, 0] - s * normals[i, 1]
        ny = s * normals[i, 0] + c * normals[i, 1]
        best = -1
        best2 = merge2
        j = head[row, col]
        while j >= 0:
            if nx * map_normals[j, 0] + ny * map_normals[j, 1] > 0.95:
                dx = px - map_points[j, 0]
                dy = py - map_points[j, 1]
                d2 = dx * dx + dy * dy
                if d2 < best2:
                    best2 = d2
                    best = j
            j = following[j]
        if best >= 0:
            w = map_weights[best]
            share = 1.0 / (w + 1.0)
            map_points[best, 0] += share * (px - map_points[best, 0])
            map_points[best, 1] += share * (py - map_points[best, 1])
            mx = map_normals[best, 0] + share * (nx - map_normals[best, 0])
            my = map_normals[best, 1] + share * (ny - map_normals[best, 1])
            length = math.sqrt(mx * mx + my * my)
            map_normals[best, 0] = mx / length
            map_normals[best, 1] = my / length
            if w < 20.0:
                map_weights[best] = w + 1.0
            continue
        map_points[count, 0] = px
        map_points[count, 1] = py
        map_normals[count, 0] = nx
        map_normals[count, 1] = ny
        map_weights[count] = 1.0
        following[count] = head[row, col]
        head[row, col] = count
        count += 1
    return count


@njit(cache=True)
def stamp_field(
    points: Floats,
    x: float,
    y: float,
    yaw: float,
    field: Bytes,
    level_starts: Ints,
    rows: int,
    cols: int,
    origin_x: float,
    origin_y: float,
    cell_m: float,
    blob: Bytes,
) -> None:
    """Raise the likelihood pyramid around a scan's points. Cost: N (blob + levels).

    field : flat uint8, all levels; level_starts : (levels + 1,) where each begins.
    rows, cols : of level 0, multiples of 2^(levels - 1). blob : (2 h + 1, 2 h + 1) uint8.
    """
    c = math.cos(yaw)
    s = math.sin(yaw)
    half = blob.shape[0] // 2
    levels = level_starts.shape[0] - 1
    margin = half + (1 << levels)
    for i in range(points.shape[0]):
        px = x + c * points[i, 0] - s * points[i, 1]
        py = y + s * points[i, 0] + c * points[i, 1]
        col = int(math.floor((px - origin_x) / cell_m))
        row = int(math.floor((py - origin_y) / cell_m))
        if row < margin or col < margin or row >= rows - margin or col >= cols - margin:
            continue
        if field[row * cols + col] == 255:
            continue
        for dr in range(-half, half + 1):
            at = (row + dr) * cols + col
            for dc in range(-half, half + 1):
                value = blob[dr + half, dc + half]
                if field[at + dc] < value:
                    field[at + dc] = value
        for level in range(1, levels):
            span = 1 << level
            level_cols = cols >> level
            # the cells whose window [k span, (k + 2) span) meets the blob
            row_first = (row - half) // span - 1
            row_last = (row + half) // span
            col_first = (col - half) // span - 1
            col_last = (col + half) // span
            for lr in range(row_first, row_last + 1):
                for lc in range(col_first, col_last + 1):
                    # nearest cell of that window to the point, for the tightest bound
                    dr = max(0, max(lr * span - row, row - ((lr + 2) * span - 1)))
                    dc = max(0, max(lc * span - col, col - ((lc + 2) * span - 1)))
                    value = blob[half + dr, half + dc]
                    at = level_starts[level] + lr * level_cols + lc
                    if field[at] < value:
                        field[at] = value


@njit(cache=True, fastmath=FAST)
def field_score(
    points: Floats,
    x: float,
    y: float,
    yaw: float,
    field: Bytes,
    rows: int,
    cols: int,
    origin_x: float,
    origin_y: float,
    cell_m: float,
) -> float:
    """Mean of level 0 under the points at a pose, in 0..1; points outside count as 0."""
    c = math.cos(yaw)
    s = math.sin(yaw)
    total = 0
    n = points.shape[0]
    for i in range(n):
        col = int(math.floor((x + c * points[i, 0] - s * points[i, 1] - origin_x) / cell_m))
        row = int(math.floor((y + s * points[i, 0] + c * points[i, 1] - origin_y) / cell_m))
        if 0 <= row < rows and 0 <= col < cols:
            total += field[row * cols + col]
    return total / (255.0 * max(n, 1))


@njit(cache=True)
def _box_score(
    cells: Ints,
    n: int,
    d_row: int,
    d_col: int,
    level: int,
    field: Bytes,
    start: int,
    level_rows: int,
    level_cols: int,
    wanted: float,
) -> int:
    """Sum of a level under the points; -1 as soon as it can't be more than wanted."""
    total = 0
    most = 255 * n
    for i in range(n):
        row = (cells[i, 0] + d_row) >> level
        col = (cells[i, 1] + d_col) >> level
        value = 0
        if 0 <= row < level_rows and 0 <= col < level_cols:
            value = int(field[start + row * level_cols + col])
            total += value
        most -= 255 - value
        if most <= wanted:
            return -1
    return total


@njit(cache=True)
def branch_and_bound(
    points: Floats,
    x0: float,
    y0: float,
    yaw0: float,
    half_x_cells: int,
    half_yaw_steps: int,
    yaw_step: float,
    field: Bytes,
    level_starts: Ints,
    rows: int,
    cols: int,
    origin_x: float,
    origin_y: float,
    cell_m: float,
    xy_weight: float,
    yaw_weight: float,
    min_score: float,
    budget: int,
    avoid_x: float,
    avoid_y: float,
    avoid_yaw: float,
    avoid_m: float,
    avoid_rad: float,
) -> tuple[bool, float, float, float, float, int]:
    """The pose in a window around a guess that lays the points best on a field.

    Olson, Real-Time Correlative Scan Matching (ICRA 2009), with the depth-first branch and bound
    of Hess et al. (ICRA 2016). Score: mean field under the points, less a penalty
    xy_weight d^2 + yaw_weight a^2 for moving d metres and a radians away from the guess.
    The window is a square of half_x_cells cells and half_yaw_steps yaw steps each way.
    budget : after so many scored boxes the search ends with what it has; no more than the coarsest
              boxes of one yaw come on top.
    avoid_* : poses nearer to this one than avoid_m and avoid_rad don't count: to look for a second
              peak after the first. A negative avoid_m counts all.

    Returns (found, x, y, yaw, penalised score, boxes scored).
    """
    n = points.shape[0]
    levels = level_starts.shape[0] - 1
    top = 0
    while top < levels - 1 and (1 << top) < half_x_cells + 1:
        top += 1
    side = 2 * half_x_cells + 1
    cells = np.empty((n, 2), dtype=np.int64)
    norm = 255.0 * max(n, 1)
    best = min_score
    best_row = 0
    best_col = 0
    best_step = 0
    found = False
    scored = 0
    # depth-first stack: level, d_row, d_col, bound
    stack = np.empty((4 * (levels + 1) + ((side >> top) + 2) ** 2, 3), dtype=np.int64)
    bounds = np.empty(stack.shape[0])
    child_bound = np.empty(4)
    child_cell = np.empty((4, 2), dtype=np.int64)
    for k in range(2 * half_yaw_steps + 1):
        # from the guess outwards: the likely answer first makes the bound tight early
        step = (k + 1) // 2 if k % 2 == 1 else -(k // 2)
        turn = step * yaw_step
        turn_penalty = yaw_weight * turn * turn
        if 1.0 - turn_penalty <= best:
            continue
        c = math.cos(yaw0 + turn)
        s = math.sin(yaw0 + turn)
        for i in range(n):
            px = x0 + c * points[i, 0] - s * points[i, 1]
            py = y0 + s * points[i, 0] + c * points[i, 1]
            cells[i, 0] = int(math.floor((py - origin_y) / cell_m))
            cells[i, 1] = int(math.floor((px - origin_x) / cell_m))
        depth = 0
        span = 1 << top
        first = 0
        for d_row in range(-half_x_cells, half_x_cells + 1, span):
            for d_col in range(-half_x_cells, half_x_cells + 1, span):
                near_row = _nearest_zero(d_row, span)
                near_col = _nearest_zero(d_col, span)
                away2 = (near_row * near_row + near_col * near_col) * cell_m * cell_m
                penalty = turn_penalty + xy_weight * away2
                total = _box_score(
                    cells,
                    n,
                    d_row,
                    d_col,
                    top,
                    field,
                    level_starts[top],
                    rows >> top,
                    cols >> top,
                    (best + penalty) * norm,
                )
                scored += 1
                bound = total / norm - penalty
                if total >= 0 and bound > best:
                    # keep the roots in order of their bound, best on top
                    at = depth
                    while at > first and bounds[at - 1] > bound:
                        bounds[at] = bounds[at - 1]
                        stack[at, 0] = stack[at - 1, 0]
                        stack[at, 1] = stack[at - 1, 1]
                        stack[at, 2] = stack[at - 1, 2]
                        at -= 1
                    bounds[at] = bound
                    stack[at, 0] = top
                    stack[at, 1] = d_row
                    stack[at, 2] = d_col
                    depth += 1
        while depth > 0:
            depth -= 1
            if bounds[depth] <= best:
                continue
            if scored >= budget:
                break
            level = stack[depth, 0]
            row = stack[depth, 1]
            col = stack[depth, 2]
            if level == 0:
                if (
                    math.hypot(x0 + col * cell_m - avoid_x, y0 + row * cell_m - avoid_y) < avoid_m
                    and abs(yaw0 + turn - avoid_yaw) < avoid_rad
                ):
                    continue
                best = bounds[depth]
                best_row = row
                best_col = col
                best_step = step
                found = True
                continue
            level -= 1
            span = 1 << level
            children = 0
            for a in range(2):
                for b in range(2):
                    d_row = row + a * span
                    d_col = col + b * span
                    if d_row > half_x_cells or d_col > half_x_cells:
                        continue
                    near_row = _nearest_zero(d_row, span)
                    near_col = _nearest_zero(d_col, span)
                    away2 = (near_row * near_row + near_col * near_col) * cell_m * cell_m
                    penalty = turn_penalty + xy_weight * away2
                    total = _box_score(
                        cells,
                        n,
                        d_row,
                        d_col,
                        level,
                        field,
                        level_starts[level],
                        rows >> level,
                        cols >> level,
                        (best + penalty) * norm,
                    )
                    scored += 1
                    bound = total / norm - penalty
                    if total < 0 or bound <= best:
                        continue
                    at = children
                    while at > 0 and child_bound[at - 1] > bound:
                        child_bound[at] = child_bound[at - 1]
                        child_cell[at, 0] = child_cell[at - 1, 0]
                        child_cell[at, 1] = child_cell[at - 1, 1]
                        at -= 1
                    child_bound[at] = bound
                    child_cell[at, 0] = d_row
                    child_cell[at, 1] = d_col
                    children += 1
            for a in range(children):
                stack[depth, 0] = level
                stack[depth, 1] = child_cell[a, 0]
                stack[depth, 2] = child_cell[a, 1]
                bounds[depth] = child_bound[a]
                depth += 1
        if scored >= budget:
            break
    return (
        found,
        x0 + best_col * cell_m,
        y0 + best_row * cell_m,
        yaw0 + best_step * yaw_step,
        best,
        scored,
    )


@njit(cache=True)
def _nearest_zero(first: int, span: int) -> int:
    """The offset nearest to zero among first .. first + span - 1."""
    if first > 0:
        return first
    last = first + span - 1
    if last < 0:
        return last
    return 0


@njit(cache=True, fastmath=FAST)
def imls_normal_equations(
    points: Floats,
    normals: Floats,
    x: float,
    y: float,
    yaw: float,
    map_points: Floats,
    map_normals: Floats,
    map_weights: Floats,
    following: Links,
    head: Links,
    origin_x: float,
    origin_y: float,
    list_cell_m: float,
    kernel_m: float,
    gate_m: float,
    robust_m: float,
    H: Floats,
    g: Floats,
) -> tuple[int, float, float]:
    """One linearisation of a scan against the implicit surface of the map's points.

    The distance of a point q to the surface is the weighted mean of n_i . (q - p_i) over the map
    points p_i near it, w_i = exp(-|q - p_i|^2 / kernel^2) (implicit moving least squares, as in
    Deschaud, IMLS-SLAM, ICRA 2018, eq. 2), over points whose normals agree. Each residual e
    is weighted by Geman-McClure, (r^2 / (r^2 + e^2))^2.

    H (3, 3), g (3,) out: sum w J^T J and sum w J^T e, for (x, y, yaw) in map axes.
    Returns (points with a partner, sum of weights, sum of w e^2).
    Cost: N times the points in 3 x 3 list cells; list_cell_m >= gate_m.
    """
    H[:, :] = 0.0
    g[:] = 0.0
    c = math.cos(yaw)
    s = math.sin(yaw)
    rows, cols = head.shape
    gate2 = gate_m * gate_m
    inv_kernel2 = 1.0 / (kernel_m * kernel_m)
    r2 = robust_m * robust_m
    matched = 0
    weight_sum = 0.0
    error_sum = 0.0
    for i in range(points.shape[0]):
        nx0 = normals[i, 0]
        ny0 = normals[i, 1]
        if nx0 == 0.0 and ny0 == 0.0:
            continue
        lx = c * points[i, 0] - s * points[i, 1]
        ly = s * points[i, 0] + c * points[i, 1]
        px = x + lx
        py = y + ly
        col = int(math.floor((px - origin_x) / list_cell_m))
        row = int(math.floor((py - origin_y) / list_cell_m))
        if row < 1 or col < 1 or row >= rows - 1 or col >= cols - 1:
            continue
        qx = c * nx0 - s * ny0
        qy = s * nx0 + c * ny0
        sum_w = 0.0
        sum_e = 0.0
        sum_nx = 0.0
        sum_ny = 0.0
        for rr in range(row - 1, row + 2):
            for cc in range(col - 1, col + 2):
                j = head[rr, cc]
                while j >= 0:
                    mx = map_normals[j, 0]
                    my = map_normals[j, 1]
                    if mx * qx + my * qy > 0.8:
                        dx = px - map_points[j, 0]
                        dy = py - map_points[j, 1]
                        d2 = dx * dx + dy * dy
                        if d2 < gate2:
                            w = map_weights[j] * (math.exp(-d2 * inv_kernel2) + 1e-9)
                            sum_w += w
                            sum_e += w * (mx * dx + my * dy)
                            sum_nx += w * mx
                            sum_ny += w * my
                    j = following[j]
        if sum_w <= 0.0:
            continue
        length = math.sqrt(sum_nx * sum_nx + sum_ny * sum_ny)
        nx = sum_nx / length
        ny = sum_ny / length
        e = sum_e / sum_w
        root = r2 / (r2 + e * e)
        w = root * root
        jt = -nx * ly + ny * lx
        H[0, 0] += w * nx * nx
        H[0, 1] += w * nx * ny
        H[0, 2] += w * nx * jt
        H[1, 1] += w * ny * ny
        H[1, 2] += w * ny * jt
        H[2, 2] += w * jt * jt
        g[0] += w * nx * e
        g[1] += w * ny * e
        g[2] += w * jt * e
        matched += 1
        weight_sum += w
        error_sum += w * e * e
    H[1, 0] = H[0, 1]
    H[2, 0] = H[0, 2]
    H[2, 1] = H[1, 2]
    return matched, weight_sum, error_sum


@njit(cache=True)
def solve3(A: Floats, b: Floats, out: Floats) -> bool:
    """Solve a symmetric positive definite 3 x 3 system by Cholesky. False if it is not."""
    a00 = A[0, 0]
    if a00 <= 1e-12:
        return False
    l00 = math.sqrt(a00)
    l10 = A[1, 0] / l00
    l20 = A[2, 0] / l00
    d1 = A[1, 1] - l10 * l10
    if d1 <= 1e-12:
        return False
    l11 = math.sqrt(d1)
    l21 = (A[2, 1] - l20 * l10) / l11
    d2 = A[2, 2] - l20 * l20 - l21 * l21
    if d2 <= 1e-12:
        return False
    l22 = math.sqrt(d2)
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    y2 = (b[2] - l20 * y0 - l21 * y1) / l22
    out[2] = y2 / l22
    out[1] = (y1 - l21 * out[2]) / l11
    out[0] = (y0 - l10 * out[1] - l20 * out[2]) / l00
    return True


@njit(cache=True)
def imls_match(
    points: Floats,
    normals: Floats,
    start: Floats,
    expected: Floats,
    prior: Floats,
    map_points: Floats,
    map_normals: Floats,
    map_weights: Floats,
    following: Links,
    head: Links,
    origin_x: float,
    origin_y: float,
    list_cell_m: float,
    kernel_m: float,
    gate_m: float,
    robust_first_m: float,
    robust_last_m: float,
    sigma_m: float,
    iterations: int,
    pose: Floats,
    H: Floats,
) -> tuple[int, float, float, int]:
    """Gauss-Newton on the implicit surface, with a Gaussian prior.

    start (3,) x, y, yaw where the iteration begins; expected (3,) the prior's mean (its yaw on
    the same branch) and prior (3, 3) its information, both in map axes.
    The robust scale shrinks from robust_first_m to robust_last_m, a factor 0.6 an iteration.
    pose (3,) out; H (3, 3) out: the data's information alone (without the prior), 1/m^2.

    Returns (points matched, sum of weights, rms of weighted residuals m, iterations done);
    no iterations done means that the system could not be solved.
    """
    g = np.zeros(3)
    A = np.zeros((3, 3))
    b = np.zeros(3)
    step = np.zeros(3)
    pose[:] = start
    robust = robust_first_m
    inv_var = 1.0 / (sigma_m * sigma_m)
    matched = 0
    weight_sum = 0.0
    error_sum = 0.0
    done = 0
    for _ in range(iterations):
        matched, weight_sum, error_sum = imls_normal_equations(
            points,
            normals,
            pose[0],
            pose[1],
            pose[2],
            map_points,
            map_normals,
            map_weights,
            following,
            head,
            origin_x,
            origin_y,
            list_cell_m,
            kernel_m,
            gate_m,
            robust,
            H,
            g,
        )
        for r in range(3):
            b[r] = -inv_var * g[r]
            for k in range(3):
                H[r, k] *= inv_var
                A[r, k] = H[r, k] + prior[r, k]
                b[r] -= prior[r, k] * (pose[k] - expected[k])
        if not solve3(A, b, step):
            break
        # a step beyond the gate can only be a jump to other partners
        shift = math.sqrt(step[0] * step[0] + step[1] * step[1])
        scale = min(1.0, gate_m / max(shift, 1e-12), 0.2 / max(abs(step[2]), 1e-12))
        for r in range(3):
            pose[r] += scale * step[r]
        done += 1
        at_last = robust <= robust_last_m
        robust = max(robust_last_m, 0.6 * robust)
        if at_last and shift < 2e-4 and abs(step[2]) < 1e-4:
            break
    rms = math.sqrt(error_sum / weight_sum) if weight_sum > 0.0 else 0.0
    return matched, weight_sum, rms, done
