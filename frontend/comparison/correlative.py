"""Improved correlative scan matching, the paper's reference [17], as a front end of its own.

A re-implementation from the one sentence that the paper gives on it, by this project. What it does
otherwise than the front end "scan-matching", all else being the same:

* A pose is refined on a likelihood field, between its cells, by Gauss-Newton; not on the surface
  that the map's points stand for.
* A penalty for moving away from the prediction enters the search and the refinement alike.
* Its covariance comes from the volume of scores around the best pose (Olson, Real-Time Correlative
  Scan Matching, ICRA 2009, section 3.3), not from the Hessian.

The search is Olson's over two levels and more: each is the max-pooling of the finer one, so that a
coarse score bounds the fine ones below it (``search_kernels.branch_and_bound``; both front ends
have it). The refinement's field is drawn of the same map, more finely: see ``likelihood_field``.
Both are of the main layer alone: lower things that a camera saw take no part.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from datasets.messages import Array
from datasets.se2 import se2, transform, wrap_rad, xyyaw
from frontend.comparison import correlative_kernels
from frontend.comparison.correlative_config import CorrelativeConfig
from frontend.kernel_types import Bytes
from frontend.local_map import BLOB_SIGMA_M, CELL_M, LocalMap
from frontend.match import Match, Rejected
from frontend.matching import (
    ALIGN_POINTS,
    INFORMATION_PER_POINT,
    SEARCH_POINTS,
    thinned,
    to_base_axes,
    weakest_direction,
)
from frontend.prepared import SIGMA_M, PreparedScan
from fusion.scan import LIDAR_LAYER

REACH_CELLS: Final = 3
"""Of the field around a point of the map; the search ends within a cell of the answer."""

FEWEST_ON_MAP: Final = 10
"""With fewer points near the map there is no match."""

VOLUME_HALF_STEPS: Final = 3
"""The volume reaches so many expected standard deviations to each side, one a step."""

VOLUME_STEP_M: Final = 0.1
VOLUME_STEP_RAD: Final = 0.05
"""A step is no wider than this where the scan's walls leave a direction open."""

Window = tuple[Bytes, float, float, float]
"""A likelihood field as the kernels take it: cells, lower corner x and y, width of a cell, m."""


class FieldAlignment:
    """Aligns scans to a map's likelihood field; see ``tracker.Align``."""

    def __init__(self, config: CorrelativeConfig) -> None:
        self._penalty = config.penalty

    def __call__(
        self,
        scan: PreparedScan,
        local_map: LocalMap,
        T_frame_base_start: Array,
        T_frame_base_expected: Array,
        expected_sigma: tuple[float, float],
    ) -> Match | Rejected:
        """Refine a pose on the field between its cells, and say how well it is known.

        T_frame_base_start    : where the iteration begins, within a cell and a yaw step.
        T_frame_base_expected : from where the penalty counts, with expected_sigma = (m, rad).

        The penalty enters the pose, not the information of the Match.
        """
        part = scan.part(LIDAR_LAYER)
        points = thinned(scan.points_base[part], ALIGN_POINTS)
        weights = thinned(scan.weights[part], ALIGN_POINTS)
        window = likelihood_field(local_map)
        start = np.array(xyyaw(T_frame_base_start))
        expected = np.array(xyyaw(T_frame_base_expected))
        expected[2] = start[2] + wrap_rad(expected[2] - start[2])
        sigma_m, sigma_rad = expected_sigma
        penalty = self._penalty / np.array([sigma_m, sigma_m, sigma_rad]) ** 2
        pose = np.empty(3)
        correlative_kernels.refine_on_field(
            points, weights, start, expected, penalty, *window, 15, pose
        )
        values = np.empty(len(points))
        correlative_kernels.field_values(points, *pose, *window, values)
        usable = weights * thinned(scan.normals_base[part], ALIGN_POINTS).any(axis=1)
        met = (values >= 1.0 / 255.0) & (usable > 0.0)
        if np.count_nonzero(met) < FEWEST_ON_MAP:
            return Rejected("too little of the scan lies on the map")
        values = np.minimum(values[met], 1.0)
        away_m2 = -2.0 * BLOB_SIGMA_M**2 * np.log(values)
        on_map = usable[met] * values  # a point 6 cm away counts for half
        information = to_base_axes(volume_information(scan, window, pose), pose[2])
        T_frame_base = se2(*pose)
        return Match(
            T_frame_base,
            information,
            local_map.score(points, T_frame_base),
            float(on_map.sum() / usable.sum()),
            math.sqrt(float(np.average(away_m2, weights=on_map))),
            *weakest_direction(information),
        )


def likelihood_field(local_map: LocalMap) -> Window:
    """The field around the map's surface points, by the distance of each cell's centre.

    The search's own field stands for cells in which a point lies, and where many scans scatter
    it is flat over two cells: good enough for the bound of a search, not for its refinement.
    """
    points = local_map.surface_points
    margin_m = (REACH_CELLS + 2) * CELL_M
    corners = points if len(points) else np.zeros((1, 2))
    origin = corners.min(axis=0) - margin_m
    cols, rows = np.ceil((corners.max(axis=0) + margin_m - origin) / CELL_M).astype(int)
    field = np.zeros((rows, cols), dtype=np.uint8)
    correlative_kernels.draw_field(points, *origin, CELL_M, BLOB_SIGMA_M, REACH_CELLS, field)
    return field, float(origin[0]), float(origin[1]), CELL_M


def volume_information(scan: PreparedScan, window: Window, pose: Array) -> Array:
    """(3, 3) information of a scan's pose (x m, y m, yaw rad) in map axes, by its score volume.

    The score is a log-likelihood once it is multiplied by the number of points that err
    independently and by (BLOB_SIGMA_M / SIGMA_M)^2: a field of 1 - d^2 / (2 BLOB_SIGMA_M^2) stands
    for the likelihood of a distance d. Its second moments around the mean are the covariance
    (Olson, section 3.3). The steps of the volume follow what the scan's normals let expect. What a
    volume without any peak would have for its moments is no information, and is taken off.
    """
    part = scan.part(LIDAR_LAYER)
    points = thinned(scan.points_base[part], SEARCH_POINTS)
    weights = thinned(scan.weights[part], SEARCH_POINTS)
    independent = float(scan.weights[part].sum()) * INFORMATION_PER_POINT
    axes = np.linalg.inv(np.linalg.cholesky(_expected_information(scan, float(pose[2])))).T
    side = 2 * VOLUME_HALF_STEPS + 1
    scores = np.empty((side, side, side))
    correlative_kernels.score_volume(points, weights, pose, axes, *window, scores)
    likelihood = np.exp(independent * (BLOB_SIGMA_M / SIGMA_M) ** 2 * (scores - scores.max()))
    steps = np.indices(scores.shape).reshape(3, -1) - float(VOLUME_HALF_STEPS)
    covariance = np.cov(steps, aweights=likelihood.ravel(), bias=True)
    # each sample stands for the cell around it; without a peak the volume is a cube
    covariance += np.eye(3) / 12.0
    values, vectors = np.linalg.eigh(covariance)
    peak = np.maximum(1.0 / values - 12.0 / side**2, 0.0)
    per_step = (vectors * peak) @ vectors.T
    step_of = np.linalg.inv(axes)
    information: Array = step_of.T @ per_step @ step_of
    return information


def _expected_information(scan: PreparedScan, yaw_rad: float) -> Array:
    """(3, 3) in map axes, by the scan's normals; at the least that of the widest step."""
    part = scan.part(LIDAR_LAYER)
    R = se2(0.0, 0.0, yaw_rad)
    p, n = transform(R, scan.points_base[part]), transform(R, scan.normals_base[part])
    J = np.column_stack([n, p[:, 0] * n[:, 1] - p[:, 1] * n[:, 0]])
    known = (J.T * scan.weights[part]) @ J * (INFORMATION_PER_POINT / SIGMA_M**2)
    least: Array = known + np.diag([VOLUME_STEP_M**-2, VOLUME_STEP_M**-2, VOLUME_STEP_RAD**-2])
    return least
