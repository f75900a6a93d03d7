"""The hot loops of the alignment: Gauss-Newton of a scan on the surface of a local map."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from frontend.kernel_types import FAST, Cloud, Floats, Links, Surface
from frontend.residual_kernels import SINGLE_WEIGHT, add_single_points
from frontend.residual_kernels import add_residual as add_residual  # noqa: PLC0414 (for backend)


@njit(cache=True, fastmath=FAST)
def imls_normal_equations(
    points: Floats,
    normals: Floats,
    weights: Floats,
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
    gate_m: float,
    robust_m: float,
    H: Floats,
    g: Floats,
) -> tuple[int, float, float]:
    """One linearisation of a scan against the implicit surface of the map's points.

    The distance of a point q to the surface is the weighted mean of n_i . (q - p_i) over the map
    points p_i near it, w_i = (1 - |q - p_i|^2 / gate^2)^12 (implicit moving least squares, as in
    Deschaud, IMLS-SLAM, ICRA 2018, eq. 2), over points whose normals agree. Each residual e
    is weighted by Geman-McClure, (r^2 / (r^2 + e^2))^2, times the point's own weight.

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
    inv_gate2 = 1.0 / gate2
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
                            w = 1.0 - d2 * inv_gate2
                            w *= w
                            w *= w
                            w = map_weights[j] * (w * w * w + 1e-9)
                            sum_w += w
                            sum_e += w * (mx * dx + my * dy)
                            sum_nx += w * mx
                            sum_ny += w * my
                    j = following[j]
        if sum_w <= 0.0:
            continue
        e = sum_e / sum_w
        w = add_residual(e, sum_nx, sum_ny, lx, ly, r2, weights[i], H, g)
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
def share_error(common: Floats, H: Floats, g: Floats) -> bool:
    """Take out of a system what an error that all its points share makes believe, in place.

    The points are all displaced by the same unknown b ~ N(0, P^-1), P = diag(common), so that
    J (d + b) is what they observe of d. With b eliminated (Schur complement):
    H' = P - P (H + P)^-1 P, g' = P (H + P)^-1 g. However many points: H' < P.
    """
    A = np.empty((3, 3))
    b = np.empty(3)
    out = np.empty(3)
    for r in range(3):
        for k in range(3):
            A[r, k] = H[r, k]
        A[r, r] += common[r]
    if not solve3(A, g, out):
        return False
    for r in range(3):
        g[r] = common[r] * out[r]
    for k in range(3):
        b[:] = 0.0
        b[k] = common[k]
        if not solve3(A, b, out):
            return False
        for r in range(3):
            H[r, k] = (common[r] if r == k else 0.0) - common[r] * out[r]
    return True


@njit(cache=True)
def imls_match(
    cloud: Cloud,
    surface: Surface,
    low_cloud: Cloud,
    low_surface: Surface,
    single_points: Floats,
    single_surface: Surface,
    common: Floats,
    start: Floats,
    expected: Floats,
    prior: Floats,
    origin_x: float,
    origin_y: float,
    list_cell_m: float,
    gate_m: float,
    robust_first_m: float,
    robust_last_m: float,
    sigma_m: float,
    iterations: int,
    pose: Floats,
    H: Floats,
    H_low: Floats,
) -> tuple[int, float, float, float, float, int]:
    """Gauss-Newton on the implicit surfaces of two layers, with a Gaussian prior.

    cloud, surface : points of the main layer and what they are laid on; low_cloud, low_surface :
        those of the camera's, laid on each other alone. An empty low_cloud costs nothing.
    single_points, single_surface : points without a normal, and such points of the map: they move
        the pose, see ``add_single_points``, but are in no information. None cost nothing.
    common (3,) : information of the error that all low points share: see ``share_error``.
    start (3,) x, y, yaw where the iteration begins; expected (3,) the prior's mean (its yaw on
    the same branch) and prior (3, 3) its information, both in map axes.
    The robust scale shrinks from robust_first_m to robust_last_m, a factor 0.6 an iteration.
    pose (3,) out; H, H_low (3, 3) out: the information of each layer's points alone (without the
    prior, as if they shared no error), 1/m^2.

    Returns (points of the main layer matched, sum of the weights that all with a normal would have
    on the surface, sum of those they have, sum of the weights in the low layer, rms of weighted
    residuals of the main layer m, iterations done);
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
    low_weight_sum = 0.0
    done = 0
    usable = 0.0
    for i in range(cloud[0].shape[0]):
        if cloud[1][i, 0] != 0.0 or cloud[1][i, 1] != 0.0:
            usable += cloud[2][i]
    with_single = single_points.shape[0] > 0
    if with_single:
        H_single = np.zeros((3, 3))
        g_single = np.zeros(3)
    both = low_cloud[0].shape[0] > 0
    if both:
        H_shared = np.zeros((3, 3))
        g_shared = np.zeros(3)
    for _ in range(iterations):
        matched, weight_sum, error_sum = imls_normal_equations(
            cloud[0],
            cloud[1],
            cloud[2],
            pose[0],
            pose[1],
            pose[2],
            surface[0],
            surface[1],
            surface[2],
            surface[3],
            surface[4],
            origin_x,
            origin_y,
            list_cell_m,
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
        if both:
            _, low_weight_sum, _ = imls_normal_equations(
                low_cloud[0],
                low_cloud[1],
                low_cloud[2],
                pose[0],
                pose[1],
                pose[2],
                low_surface[0],
                low_surface[1],
                low_surface[2],
                low_surface[3],
                low_surface[4],
                origin_x,
                origin_y,
                list_cell_m,
                gate_m,
                robust,
                H_low,
                g_shared,
            )
            for r in range(3):
                g_shared[r] *= inv_var
                for k in range(3):
                    H_low[r, k] *= inv_var
                    H_shared[r, k] = H_low[r, k]
            if share_error(common, H_shared, g_shared):
                for r in range(3):
                    b[r] -= g_shared[r]
                    for k in range(3):
                        A[r, k] += H_shared[r, k]
        if with_single:
            H_single[:, :] = 0.0
            g_single[:] = 0.0
            add_single_points(
                single_points,
                pose,
                surface,
                single_surface,
                origin_x,
                origin_y,
                list_cell_m,
                gate_m,
                robust,
                SINGLE_WEIGHT,
                H_single,
                g_single,
            )
            for r in range(3):
                b[r] -= inv_var * g_single[r]
                for k in range(r, 3):
                    A[r, k] += inv_var * H_single[r, k]
                    A[k, r] = A[r, k]
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
    return matched, usable, weight_sum, low_weight_sum, rms, done
