"""The mounting that lays walls and floor of the images on those of lidar and base."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from datasets.messages import Array
from fusion.calibration.blocks import DepthNoise
from fusion.calibration.matches import Matches, match
from fusion.calibration.system import START_ERRORS, UNKNOWNS, System, equations
from fusion.calibration.views import View

GATES_M = (0.6, 0.45, 0.35, 0.25, 0.2, 0.15, 0.12, 0.1, 0.1, 0.1)
"""Walls are looked for ever nearer."""

SEARCH_RAD = np.radians(sorted(range(-30, 31, 3), key=abs))
SEARCH_GATE_M = 0.3
SEARCH_VIEWS = 15
SEARCH_GAIN = 1.03

DETERMINED = np.array([0.03, 0.03, 0.03, *[math.radians(1.0)] * 3, 0.02])
"""What is less certain than this (one sigma: m, rad, s) counts as not determined."""

SCALE_SIGMA = 0.0012
"""Of the lidar's scale; a G4's is within 0.2 %."""

STRETCH_S = 1.0
"""Images this near in time see the same things in the same way: their errors are one error."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A mounting, and how sure it is.

    covariance : (7, 7), of place m, turn about the base's axes rad, clock s; 0 in directions that
                 are not determined.
    loose      : (L, 7) unit directions, in units of ``DETERMINED``, that are not.
    """

    T_base_camera: Array
    clock_s: float
    covariance: Array
    loose: Array
    matches: Matches
    system: System


def fit(
    views: list[View],
    T_start: Array,
    floor_z_m: float,
    noise: DepthNoise,
    *,
    floor: bool,
    clock: bool,
) -> Fit:
    """Fit the mounting from a start; directions that turn out to be loose keep the start's values.

    clock : whether the camera's clock against the lidars' is an unknown as well.
    """
    loose = np.empty((0, UNKNOWNS))
    if not clock:
        loose = np.eye(UNKNOWNS)[-1:]
    for _ in range(4):
        result = _fitted(views, T_start, floor_z_m, noise, loose, floor=floor)
        found = _loose(result.system.information, loose)
        if len(found) == len(loose):
            break
        # Begin again: on the way here these may have moved.
        loose = found
    return replace(result, covariance=_covariance(result, views), loose=loose)


def turned_onto_walls(
    views: list[View], T_start: Array, floor_z_m: float, noise: DepthNoise
) -> Array:
    """The start turned about the vertical to where most of what stands upright lies on walls.

    The fit finds its way from 10 deg; a camera that was put on by eye may be further off. Of turns
    that are nearly as good the smallest is taken.
    """
    seen = views[:: max(1, len(views) // SEARCH_VIEWS)]
    best, best_score = T_start, 0.0
    for turn in SEARCH_RAD:
        T = stepped(T_start, np.array([0.0, 0.0, 0.0, 0.0, 0.0, turn]))
        matches = match(seen, T, floor_z_m, SEARCH_GATE_M, noise, floor=False)
        apart = equations(matches, T, 0.0).distances_m
        score = float(np.exp(-0.5 * (apart / (SEARCH_GATE_M / 2.0)) ** 2).sum())
        if score > SEARCH_GAIN * best_score:
            best, best_score = T, score
    return best


def _fitted(
    views: list[View],
    T_start: Array,
    floor_z_m: float,
    noise: DepthNoise,
    loose: Array,
    *,
    floor: bool,
) -> Fit:
    T, clock_s, errors = T_start.copy(), 0.0, START_ERRORS
    for gate_m in GATES_M:
        matches = match(views, T, floor_z_m, gate_m, noise, floor=floor)
        for _ in range(2):
            system = equations(matches, T, clock_s, errors)
            errors = system.errors
            bound = _loose(system.information, loose)
            step = _solved(system.information, bound) @ system.gradient
            T, clock_s = stepped(T, step), clock_s + float(step[6])
    matches = match(views, T, floor_z_m, GATES_M[-1], noise, floor=floor)
    system = equations(matches, T, clock_s, errors)
    return Fit(T, clock_s, np.zeros((UNKNOWNS, UNKNOWNS)), loose, matches, system)


def stepped(T_base_camera: Array, step: Array) -> Array:
    """The mounting moved by step[:3] m and turned by step[3:6] rad, both in the base's axes."""
    import cv2  # noqa: PLC0415

    T = T_base_camera.copy()
    T[:3, :3] = cv2.Rodrigues(np.asarray(step[3:6], dtype=np.float64))[0] @ T[:3, :3]
    T[:3, 3] += step[:3]
    return T


def _loose(information: Array, known: Array) -> Array:
    """The known loose directions, and those of the rest in which the information is too little."""
    scaled = DETERMINED[:, None] * information * DETERMINED
    rest = _complement(known)
    values, vectors = np.linalg.eigh(rest.T @ scaled @ rest)
    weak = rest @ vectors[:, values < 1.0]
    return np.concatenate([known, weak.T])


def _complement(loose: Array) -> Array:
    """(7, 7 - L): a basis of what is orthogonal to the rows."""
    if not len(loose):
        return np.eye(UNKNOWNS)
    return np.asarray(np.linalg.svd(loose)[2][len(loose) :].T)


def _solved(information: Array, loose: Array) -> Array:
    """The inverse of the information within what is not loose; 0 outside."""
    basis = DETERMINED[:, None] * _complement(loose)
    if not basis.shape[1]:
        return np.zeros((UNKNOWNS, UNKNOWNS))
    inner = basis.T @ information @ basis
    return np.asarray(basis @ np.linalg.solve(inner, basis.T))


def _covariance(result: Fit, views: list[View]) -> Array:
    """What the noise explains, how the gradients scatter over stretches of time, the lidar's scale.

    The scatter (a sandwich) holds what the same cabinet does to many images, but is too small where
    few stretches say anything; the noise alone knows nothing of cabinets. Their sum came nearest to
    the true errors of simulated drives (`docs/calibration.md`).
    """
    system = result.system
    inverse = _solved(system.information, result.loose)
    stamps_s = np.array([view.stamp_ns for view in views], dtype=np.int64)[system.group_views]
    stretch = ((stamps_s - stamps_s.min()) // round(STRETCH_S * 1e9)) if len(stamps_s) else stamps_s
    number, index = np.unique(stretch, return_inverse=True)
    sums = np.zeros((len(number), UNKNOWNS))
    np.add.at(sums, index, system.group_gradients)
    spread = sums.T @ sums * (len(number) / max(1, len(number) - 1))
    scale = inverse @ system.scale_gradient * SCALE_SIGMA
    cov: Array = inverse + inverse @ spread @ inverse + np.outer(scale, scale)
    return cov
