"""The hot loops of the back end: scans matched to scans, in pairs, as seen from their sensors."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from frontend.kernel_types import FAST, Floats, Ints
from frontend.match_kernels import add_residual, solve3


@njit(cache=True)
def lower_bound(values: Floats, first: int, last: int, wanted: float) -> int:
    while first < last:
        middle = (first + last) // 2
        if values[middle] < wanted:
            first = middle + 1
        else:
            last = middle
    return first


@njit(cache=True, fastmath=FAST)
def _pair_equations(
    query_first: int,
    query_last: int,
    stride: int,
    surface_first: int,
    surface_last: int,
    points: Floats,
    normals: Floats,
    bearings: Floats,
    sensor_x: float,
    sensor_y: float,
    x: float,
    y: float,
    yaw: float,
    gate_m: float,
    robust_m: float,
    H: Floats,
    g: Floats,
) -> tuple[int, int, float, float]:
    """As imls_normal_equations, with the surface of one scan, whose points are found by bearing,
    and weights (1 - d^2 / gate^2)^8.

    Rows surface_first .. surface_last of points, normals, bearings are the surface: bearings
    ascend, measured at (sensor_x, sensor_y). (x, y, yaw) takes the query's points there.
    H, g are added to. Returns (points tried, points with a partner, sum of w, sum of w e^2).
    """
    c = math.cos(yaw)
    s = math.sin(yaw)
    gate2 = gate_m * gate_m
    inv_gate2 = 1.0 / gate2
    r2 = robust_m * robust_m
    tried = 0
    matched = 0
    weight_sum = 0.0
    error_sum = 0.0
    for i in range(query_first, query_last, stride):
        nx0 = normals[i, 0]
        ny0 = normals[i, 1]
        if nx0 == 0.0 and ny0 == 0.0:
            continue
        tried += 1
        lx = c * points[i, 0] - s * points[i, 1]
        ly = s * points[i, 0] + c * points[i, 1]
        px = x + lx
        py = y + ly
        qx = c * nx0 - s * ny0
        qy = s * nx0 + c * ny0
        vx = px - sensor_x
        vy = py - sensor_y
        r = math.sqrt(vx * vx + vy * vy)
        if r < gate_m:
            continue
        # a surface seen from behind can't have been seen
        if qx * vx + qy * vy > 0.0:
            continue
        middle = math.atan2(vy, vx)
        half = min(0.35, gate_m / r)
        k = lower_bound(bearings, surface_first, surface_last, middle - half)
        sum_w = 0.0
        sum_e = 0.0
        sum_nx = 0.0
        sum_ny = 0.0
        while k < surface_last and bearings[k] <= middle + half:
            mx = normals[k, 0]
            my = normals[k, 1]
            if mx * qx + my * qy > 0.8:
                dx = px - points[k, 0]
                dy = py - points[k, 1]
                d2 = dx * dx + dy * dy
                if d2 < gate2:
                    w = 1.0 - d2 * inv_gate2
                    w *= w
                    w *= w
                    w = w * w + 1e-9
                    sum_w += w
                    sum_e += w * (mx * dx + my * dy)
                    sum_nx += w * mx
                    sum_ny += w * my
            k += 1
        if sum_w <= 0.0:
            continue
        e = sum_e / sum_w
        w = add_residual(e, sum_nx, sum_ny, lx, ly, r2, 1.0, H, g)
        matched += 1
        weight_sum += w
        error_sum += w * e * e
    return tried, matched, weight_sum, error_sum


@njit(cache=True)
def match_pairs(
    from_nodes: Ints,
    to_nodes: Ints,
    poses: Floats,
    starts: Ints,
    points: Floats,
    normals: Floats,
    bearings: Floats,
    sensors: Floats,
    most_points: int,
    gate_m: float,
    robust_first_m: float,
    robust_last_m: float,
    sigma_m: float,
    iterations: int,
    damping: float,
    xyyaw: Floats,
    information: Floats,
    stats: Floats,
) -> None:
    """Match pairs of scans by Gauss-Newton on the surface of the first, from the present poses.

    from_nodes, to_nodes : (M,) which scans; poses : (N, 3) x, y, yaw in the map.
    starts (N + 1,), points, normals (P, 2), bearings (P,), sensors (N, 2) : scans one after the
        other.
    damping : information 1/m^2 and 1/rad^2 of a weak prior at the start, holds null directions.

    Out: xyyaw (M, 3) pose of ``to`` in ``from``; information (M, 3, 3) of the data alone, in the
    axes of ``to``, zero where fewer than ten points matched; stats (M, 4) points tried, matched,
    sum of weights, rms m.
    Cost: M iterations most_points (log P + neighbours).
    """
    H = np.zeros((3, 3))
    A = np.zeros((3, 3))
    g = np.zeros(3)
    b = np.zeros(3)
    step = np.zeros(3)
    pose = np.zeros(3)
    guess = np.zeros(3)
    inv_var = 1.0 / (sigma_m * sigma_m)
    for m in range(from_nodes.shape[0]):
        i = from_nodes[m]
        j = to_nodes[m]
        c = math.cos(poses[i, 2])
        s = math.sin(poses[i, 2])
        dx = poses[j, 0] - poses[i, 0]
        dy = poses[j, 1] - poses[i, 1]
        turn = poses[j, 2] - poses[i, 2]
        guess[0] = c * dx + s * dy
        guess[1] = -s * dx + c * dy
        guess[2] = math.atan2(math.sin(turn), math.cos(turn))
        pose[:] = guess
        stride = max(1, (starts[j + 1] - starts[j] + most_points - 1) // most_points)
        robust = robust_first_m
        tried = 0
        matched = 0
        weight_sum = 0.0
        error_sum = 0.0
        for _ in range(iterations):
            H[:, :] = 0.0
            g[:] = 0.0
            tried, matched, weight_sum, error_sum = _pair_equations(
                starts[j],
                starts[j + 1],
                stride,
                starts[i],
                starts[i + 1],
                points,
                normals,
                bearings,
                sensors[i, 0],
                sensors[i, 1],
                pose[0],
                pose[1],
                pose[2],
                gate_m,
                robust,
                H,
                g,
            )
            if matched < 10:
                H[:, :] = 0.0
                break
            for r in range(3):
                b[r] = -inv_var * g[r] - damping * (pose[r] - guess[r])
                for k in range(3):
                    H[r, k] = inv_var * (H[r, k] if k >= r else H[k, r] / inv_var)
            for r in range(3):
                for k in range(3):
                    A[r, k] = H[r, k]
                A[r, r] += damping
            if not solve3(A, b, step):
                matched = 0
                H[:, :] = 0.0
                break
            shift = math.sqrt(step[0] * step[0] + step[1] * step[1])
            scale = min(1.0, gate_m / max(shift, 1e-12), 0.1 / max(abs(step[2]), 1e-12))
            for r in range(3):
                pose[r] += scale * step[r]
            robust = max(robust_last_m, 0.5 * robust)
        # the information's x and y axes: from those of ``from`` to those of ``to``
        c = math.cos(pose[2])
        s = math.sin(pose[2])
        information[m, 0, 0] = c * c * H[0, 0] + 2.0 * c * s * H[0, 1] + s * s * H[1, 1]
        information[m, 1, 1] = s * s * H[0, 0] - 2.0 * c * s * H[0, 1] + c * c * H[1, 1]
        information[m, 0, 1] = (c * c - s * s) * H[0, 1] + c * s * (H[1, 1] - H[0, 0])
        information[m, 0, 2] = c * H[0, 2] + s * H[1, 2]
        information[m, 1, 2] = -s * H[0, 2] + c * H[1, 2]
        information[m, 2, 2] = H[2, 2]
        information[m, 1, 0] = information[m, 0, 1]
        information[m, 2, 0] = information[m, 0, 2]
        information[m, 2, 1] = information[m, 1, 2]
        for r in range(3):
            xyyaw[m, r] = pose[r]
        stats[m, 0] = tried
        stats[m, 1] = matched
        stats[m, 2] = weight_sum
        stats[m, 3] = math.sqrt(error_sum / weight_sum) if weight_sum > 0.0 else 0.0
