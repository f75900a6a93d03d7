"""Planar poses as 3 x 3 homogeneous matrices, and the few operations on them."""

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
