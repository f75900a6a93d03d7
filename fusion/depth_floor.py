"""How the floor lies in one depth image: what the calibration leaves, and how the robot nods.

Half a degree lifts the floor by 2 cm at 2 m, as much as a low obstacle stands out. The floor itself
tells, image by image.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from datasets.messages import Array

HEIGHT_ERROR_M: Final = 0.01
"""Standard deviation of the camera's height as calibrated."""

ROUGHNESS_M: Final = 0.003
"""By how much a floor is uneven."""

FAR_M: Final = 3.0
"""Where the doubt of the tilt is asked for."""

LEAST_SAMPLES: Final = 30


class Floor(NamedTuple):
    """The floor's height over the plane z = 0 of the base: height + tilt . (x, y).

    x, y : m, from the camera's ground point, in the base's axes. doubt_rad : what is left
    unknown of its tilt, over the ranges that matter.
    """

    height_m: float
    tilt_x: float
    tilt_y: float
    doubt_rad: float


def fit_floor(
    points: Array, noise_m: Array, alike: Array, tilt_error_rad: float, band_m: Array
) -> Floor:
    """The plane through what lies near the nominal floor, robustly, with the calibration as prior.

    points  : (N, 3) m, from the camera's ground point, base's axes.
    noise_m : (N,) of their heights. alike : (N,) how many of the points err alike.
    band_m  : (N,) how far from the nominal floor a point may lie and still count.

    What stands on the floor only ever lies above it; annealed Cauchy weights leave it out. A plane
    that the calibration does not allow (three times its error) isn't the floor: then
    the nominal one holds, with all its doubt.
    """
    nominal = Floor(0.0, 0.0, 0.0, tilt_error_rad)
    near = np.abs(points[:, 2]) < band_m
    if tilt_error_rad == 0.0 or near.sum() < LEAST_SAMPLES:
        return nominal
    x, y, z = points[near].T
    design = np.column_stack([np.ones(x.size), x, y])
    sigma = np.hypot(noise_m[near], ROUGHNESS_M)
    allowed = np.array([HEIGHT_ERROR_M, tilt_error_rad, tilt_error_rad])
    prior = np.diag(allowed**-2.0)
    information = 1.0 / (sigma**2 * alike[near])
    plane = np.zeros(3)
    normal = prior
    for wide in (16.0, 8.0, 4.0, 2.0, 2.0, 2.0, 2.0):
        off = (z - design @ plane) / (wide * sigma)
        weights = information / (1.0 + off**2)
        normal = design.T @ (design * weights[:, None]) + prior
        plane = np.linalg.solve(normal, design.T @ (weights * z))
    if (np.abs(plane) > 3.0 * allowed).any():
        return nominal
    covariance = np.linalg.inv(normal)
    places = _far_places(x, y)
    deviations_m = np.sqrt(np.einsum("ij,jk,ik->i", places, covariance, places))
    doubt_rad = float(np.max(deviations_m)) / FAR_M
    height_m, tilt_x, tilt_y = (float(part) for part in plane)
    return Floor(height_m, tilt_x, tilt_y, min(3.0 * doubt_rad, tilt_error_rad))


def _far_places(x: Array, y: Array) -> Array:
    """(3, 3) rows 1, x, y: FAR_M away in the direction of the middle of the points, and of the
    outermost to both sides of it."""
    ahead = np.arctan2(y.mean(), x.mean())
    turned = np.remainder(np.arctan2(y, x) - ahead + np.pi, 2 * np.pi) - np.pi
    at = ahead + np.array([turned.min(), 0.0, turned.max()])
    return np.column_stack([np.ones(3), FAR_M * np.cos(at), FAR_M * np.sin(at)])
