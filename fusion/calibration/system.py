"""The equations of a calibration: planes of the base frame as a camera at a mounting sees them.

A block with ray c (optical frame) that lies on the plane n . X = n . p (base frame) has

    1/z = g / h,    g = n . (R c),    h = n . (p - t),    T_base_camera = [R t].

With t + dt and (1 + [w]x) R:    d(1/z) = ((R c) x n) . w / h  +  (g / h^2) n . dt.

What the lidar says of a wall, and the base of the floor, is wrong as a whole, not point by point:
each group of matches has an offset and a tilt of its own, Gaussian, which are eliminated. So a
thousand blocks on one wall say no more than the wall can, and walls that are parallel up to the
noise of their normals say nothing about the way along them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from fusion.calibration.matches import Bools, Indices, Matches

START_ERRORS = np.array([[0.01, *[math.radians(0.3)] * 2], [0.003, *[math.radians(0.15)] * 2]])
"""Common errors of walls and of the floor in one image, as they are taken at first: offset m, and
two tilts rad. A lidar puts a wall where its few beams say, floors are uneven, a base nods."""

LEAST_ERRORS = START_ERRORS / 10.0
START_GROUPS = 1.0
"""How many groups' worth of evidence the first values are, against what the groups show."""

SHARED_NOISE = 2.0
"""Neighbouring blocks have the same noise in part: so many count as one."""

CAUCHY = 2.0
FARTHEST_SIGMA = 5.0
UNKNOWNS = 7
"""Place x, y, z m; turn about the base's axes x, y, z rad; clock of the camera s."""


@dataclass(frozen=True, slots=True)
class System:
    """Normal equations information @ step = gradient, summed over groups.

    information, gradient : (7, 7), (7,); group_gradients : (G, 7); group_views : (G,) int.
    scale_gradient : (7,), what all ranges of the lidar too long by a factor 1 + s add for each s.
    weights : (N,) of the matches, robust, 0..1.
    distances_m : (N,) of the matches from their planes, across these.
    errors  : (2, 3), ``START_ERRORS`` as the groups show them, by expectation and maximisation.
    """

    information: Array
    gradient: Array
    group_gradients: Array
    group_views: Indices
    scale_gradient: Array
    weights: Array
    distances_m: Array
    errors: Array


def equations(
    matches: Matches, T_base_camera: Array, clock_s: float, errors: Array = START_ERRORS
) -> System:
    """The equations at a mounting, and a clock offset: images are of ``clock_s`` after stamps."""
    R, t = T_base_camera[:3, :3], T_base_camera[:3, 3]
    normals, points, sensors = _moved(matches, clock_s)
    c = matches.rays @ R.T
    g = np.einsum("nx,nx->n", normals, c)
    h = np.einsum("nx,nx->n", normals, points - t)
    towards = g / h**2
    J = np.empty((len(matches), UNKNOWNS))
    J[:, :3] = towards[:, None] * normals
    J[:, 3:6] = np.cross(c, normals) / h[:, None]
    # The base moves on by v and turns by w in dt: seen from it, walls go the other way.
    v, w = matches.velocity_base[:, :2], matches.velocity_base[:, 2]
    v, w = np.where(np.isnan(v), 0.0, v), np.where(np.isnan(w), 0.0, w)
    p_rate = np.stack([-v[:, 0] + w * points[:, 1], -v[:, 1] - w * points[:, 0], 0.0 * w], axis=1)
    n_rate = np.stack([w * normals[:, 1], -w * normals[:, 0], 0.0 * w], axis=1)
    h_rate = np.einsum("nx,nx->n", n_rate, points - t) + np.einsum("nx,nx->n", normals, p_rate)
    J[:, 6] = np.einsum("nx,nx->n", n_rate, c) / h - towards * h_rate

    sigmas = errors[matches.floor.astype(np.int64)]
    U = _common(matches.floor, sigmas, normals, points - t, c, towards, h)
    scaled = -towards * np.einsum("nx,nx->n", normals, points - sensors) * ~matches.floor
    residual = matches.inverse_depth - g / h
    total = np.hypot(matches.sigma, towards * sigmas[:, 0])
    in_sigma = residual / total
    robust = np.where(np.abs(in_sigma) < FARTHEST_SIGMA, 1.0 / (1.0 + (in_sigma / CAUCHY) ** 2), 0)
    weights = robust / (SHARED_NOISE * matches.sigma**2)
    return _summed(matches, J, U, residual, scaled, weights, robust, residual / towards, errors)


def _moved(matches: Matches, clock_s: float) -> tuple[Array, Array, Array]:
    """Normals, points and sensors as of ``clock_s`` later, in the base frame of then."""
    if clock_s == 0.0:
        return matches.normals, matches.points, matches.sensors
    step = np.where(np.isnan(matches.velocity_base), 0.0, matches.velocity_base) * clock_s
    c, s = np.cos(step[:, 2]), np.sin(step[:, 2])

    def turned(vectors: Array) -> Array:
        x, y, z = vectors.T
        return np.stack([c * x + s * y, -s * x + c * y, z], axis=1)

    shift = np.column_stack([step[:, :2], np.zeros(len(step))])
    return turned(matches.normals), turned(matches.points - shift), turned(matches.sensors - shift)


def _common(
    floor: Bools, sigmas: Array, normals: Array, apart: Array, c: Array, towards: Array, h: Array
) -> Array:
    """(N, 3): what one sigma of a group's offset and tilts does to each of its matches.

    A wall tilts about its own middle, the floor about the place below the base.
    """
    U = np.empty((len(floor), 3))
    U[:, 0] = -towards
    about_z = np.column_stack([-normals[:, 1], normals[:, 0], np.zeros(len(normals))])
    flat = floor[:, None]
    tilts = (
        np.where(flat, [1.0, 0.0, 0.0], about_z),
        np.where(flat, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]),
    )
    for column, tilt in enumerate(tilts, start=1):
        turned = np.einsum("nx,nx->n", tilt, c) / h
        U[:, column] = turned - towards * np.einsum("nx,nx->n", tilt, apart)
    return U * sigmas


def _summed(
    matches: Matches,
    J: Array,
    U: Array,
    residual: Array,
    scaled: Array,
    weights: Array,
    robust: Array,
    distances_m: Array,
    errors: Array,
) -> System:
    """Add up the groups, their common errors eliminated (Woodbury)."""
    starts = np.flatnonzero(np.diff(matches.groups, prepend=-1))
    stops = np.append(starts, len(matches))[1:]
    columns = np.column_stack([J, U, residual, scaled])
    size = UNKNOWNS
    information = np.zeros((size, size))
    gradients, scale = np.zeros((len(starts), size)), np.zeros(size)
    shown = np.ones((len(starts), 3))
    for index, (start, stop) in enumerate(zip(starts, stops, strict=True)):
        rows = columns[start:stop]
        products = (rows * weights[start:stop, None]).T @ rows
        with_common = products[:size, size : size + 3]
        inner = np.linalg.inv(np.eye(3) + products[size : size + 3, size : size + 3])
        gain = with_common @ inner
        information += products[:size, :size] - gain @ with_common.T
        gradients[index] = products[:size, -2] - gain @ products[size : size + 3, -2]
        scale += products[:size, -1] - gain @ products[size : size + 3, -1]
        shown[index] = (inner @ products[size : size + 3, -2]) ** 2 + np.diag(inner)
    kind = matches.floor[starts].astype(np.int64)
    factors = np.array(
        [
            (shown[kind == k].sum(axis=0) + START_GROUPS * (START_ERRORS[k] / errors[k]) ** 2)
            / ((kind == k).sum() + START_GROUPS)
            for k in (0, 1)
        ]
    )
    return System(
        information,
        gradients.sum(axis=0),
        gradients,
        matches.views[starts],
        scale,
        robust,
        distances_m,
        np.maximum(errors * np.sqrt(factors), LEAST_ERRORS),
    )
