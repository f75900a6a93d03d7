"""The rigid motion that lays one planar trajectory on another.

Source: Umeyama, Least-Squares Estimation of Transformation Parameters, IEEE PAMI 13(4), 1991,
in the plane and without scale, where it has a closed form.
"""

from __future__ import annotations

import math

import numpy as np

from datasets.messages import Array
from datasets.se2 import se2, transform
from slam.evaluation.association import Pairs

STANDING_M = 0.01


def alignment(pairs: Pairs) -> Array:
    """T_truth_map, (3, 3): least squares over the positions of all pairs.

    Positions that all lie within a centimetre (rms) say nothing of the rotation; there the mean
    difference of the headings gives it.
    """
    estimate, truth = pairs.estimate[:, :2], pairs.truth[:, :2]
    centre_estimate, centre_truth = estimate.mean(axis=0), truth.mean(axis=0)
    a, b = estimate - centre_estimate, truth - centre_truth
    if np.sqrt((b**2).sum(axis=1).mean()) < STANDING_M:
        turn = pairs.truth[:, 2] - pairs.estimate[:, 2]
        yaw = math.atan2(float(np.sin(turn).sum()), float(np.cos(turn).sum()))
    else:
        cross = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
        yaw = math.atan2(cross, float((a * b).sum()))
    x, y = centre_truth - transform(se2(0.0, 0.0, yaw), centre_estimate[None])[0]
    return se2(float(x), float(y), yaw)


def residuals_m(pairs: Pairs, T_truth_map: Array) -> Array:
    """The distances left between the positions of each pair, (N,)."""
    difference = transform(T_truth_map, pairs.estimate[:, :2]) - pairs.truth[:, :2]
    distances: Array = np.hypot(difference[:, 0], difference[:, 1])
    return distances
