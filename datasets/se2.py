"""Planar poses as 3 x 3 homogeneous matrices or, by the thousand, as rows x m, y m, yaw rad."""

from __future__ import annotations

import math

import numpy as np

from datasets.messages import Array


def se2(x_m: float, y_m: float, yaw_rad: float) -> Array:
    """The (3, 3) matrix T_a_b of a frame b at (x, y) in a, turned by yaw counter-clockwise."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, x_m], [s, c, y_m], [0.0, 0.0, 1.0]])


def yaw_rad(T_a_b: Array) -> float:
    """The angle of b in a, in (-pi, pi]."""
    return math.atan2(T_a_b[1, 0], T_a_b[0, 0])


def xyyaw(T_a_b: Array) -> tuple[float, float, float]:
    """(x m, y m, yaw rad) of b in a."""
    return float(T_a_b[0, 2]), float(T_a_b[1, 2]), yaw_rad(T_a_b)


def inverse(T_a_b: Array) -> Array:
    """T_b_a, without a general matrix inverse."""
    c, s, x, y = T_a_b[0, 0], T_a_b[1, 0], T_a_b[0, 2], T_a_b[1, 2]
    return np.array([[c, s, -c * x - s * y], [-s, c, s * x - c * y], [0.0, 0.0, 1.0]])


def wrap_rad(angle_rad: float) -> float:
    """The same angle in (-pi, pi]."""
    return math.atan2(math.sin(angle_rad), math.cos(angle_rad))


def transform(T_a_b: Array, points_b: Array) -> Array:
    """points_b : (N, 2). Returns points_a, (N, 2)."""
    moved: Array = points_b @ T_a_b[:2, :2].T + T_a_b[:2, 2]
    return moved


def interpolate(T_a_b0: Array, T_a_b1: Array, fraction: float) -> Array:
    """The pose a fraction (0..1, or beyond) of the way from one pose to another.

    Position moves on the straight line, yaw the shorter way round.
    """
    turn = wrap_rad(yaw_rad(T_a_b1) - yaw_rad(T_a_b0))
    x, y = T_a_b0[:2, 2] + fraction * (T_a_b1[:2, 2] - T_a_b0[:2, 2])
    return se2(float(x), float(y), yaw_rad(T_a_b0) + fraction * turn)


def between(a_xyyaw: Array, b_xyyaw: Array) -> Array:
    """Poses b seen from a, row by row, (M, 3), yaw in (-pi, pi]; both given in one frame."""
    d = b_xyyaw - a_xyyaw
    c, s = np.cos(a_xyyaw[:, 2]), np.sin(a_xyyaw[:, 2])
    return np.column_stack(
        [c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1], wrapped_rad(d[:, 2])]
    )


def compose(T_a_b_xyyaw: Array, T_b_c_xyyaw: Array) -> Array:
    """Poses c in a, row by row, (M, 3), yaw in (-pi, pi]."""
    a, b = T_a_b_xyyaw, T_b_c_xyyaw
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    x = a[:, 0] + c * b[:, 0] - s * b[:, 1]
    y = a[:, 1] + s * b[:, 0] + c * b[:, 1]
    return np.column_stack([x, y, wrapped_rad(a[:, 2] + b[:, 2])])


def logarithm(xyyaw: Array) -> Array:
    """Twists (M, 3) whose exponentials are the given poses: vx m, vy m, yaw rad in (-pi, pi]."""
    half = 0.5 * xyyaw[:, 2]
    near = np.abs(half) < 1e-6
    safe = np.where(near, 1.0, half)
    scale = np.where(near, 1.0, safe / np.tan(safe))
    x, y = xyyaw[:, 0], xyyaw[:, 1]
    return np.column_stack([scale * x + half * y, scale * y - half * x, xyyaw[:, 2]])


def adjoints(xyyaw: Array) -> Array:
    """Ad(T_a_b), (M, 3, 3): twists given in the axes of b, as twists in the axes of a."""
    matrices = pose_matrices(xyyaw)
    matrices[:, 0, 2], matrices[:, 1, 2] = xyyaw[:, 1], -xyyaw[:, 0]
    return matrices


def wrapped_rad(angles_rad: Array) -> Array:
    """The same angles in (-pi, pi]."""
    turned: Array = np.pi - np.mod(np.pi - angles_rad, 2.0 * np.pi)
    return turned


def xyyaw_rows(matrices: Array) -> Array:
    """(N, 3, 3) poses as (N, 3): x m, y m, yaw rad."""
    yaws = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    return np.column_stack([matrices[:, 0, 2], matrices[:, 1, 2], yaws])


def pose_matrices(xyyaw: Array) -> Array:
    """(N, 3) x m, y m, yaw rad as matrices (N, 3, 3)."""
    matrices = np.zeros((len(xyyaw), 3, 3))
    c, s = np.cos(xyyaw[:, 2]), np.sin(xyyaw[:, 2])
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 0, 2] = c, -s, xyyaw[:, 0]
    matrices[:, 1, 0], matrices[:, 1, 1], matrices[:, 1, 2] = s, c, xyyaw[:, 1]
    matrices[:, 2, 2] = 1.0
    return matrices


def placed(T_a_b_xyyaw: Array, points_b: Array) -> Array:
    """Points (N, 2), each in the frame of its own pose (N, 3), in the frame of the poses."""
    c, s = np.cos(T_a_b_xyyaw[:, 2]), np.sin(T_a_b_xyyaw[:, 2])
    x = T_a_b_xyyaw[:, 0] + c * points_b[:, 0] - s * points_b[:, 1]
    y = T_a_b_xyyaw[:, 1] + s * points_b[:, 0] + c * points_b[:, 1]
    return np.column_stack([x, y])
