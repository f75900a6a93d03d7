"""Absolute and relative error of a trajectory against ground truth (ATE and RPE).

Source: Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.se2 import between, yaw_rad
from datasets.trajectory import Trajectory
from slam.evaluation.alignment import alignment, residuals_m
from slam.evaluation.association import Pairs, associate
from slam.evaluation.time_offset import TimeOffset, estimate_time_offset

Indices = npt.NDArray[np.intp]
RPE_WAYS_M = (1.0, 5.0)
RPE_TIMES_S = (1.0, 10.0)
RPE_TOLERANCE = 0.1


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Statistics of errors that are >= 0."""

    rmse: float
    mean: float
    median: float
    maximum: float


@dataclass(frozen=True, slots=True)
class RelativeError:
    """RPE over stretches of one length, of ``delta`` metres of true way or of ``delta`` seconds.

    A stretch counts if its length is within a tenth of ``delta``; stretches overlap.
    """

    delta: float
    unit: Literal["m", "s"]
    count: int
    translation_m: ErrorStatistics
    rotation_deg: ErrorStatistics


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """The error of a trajectory against ground truth.

    count        : pairs that were compared, of ``poses`` in the estimate.
    T_truth_map  : the SE(2) alignment that lays the estimate on the ground truth.
    translation_m, rotation_deg : ATE after alignment.
    relative     : RPE; needs no alignment. Stretches that occur nowhere have no entry.
    time_offset  : the clock offset that was used.
    """

    count: int
    poses: int
    T_truth_map: Array
    translation_m: ErrorStatistics
    rotation_deg: ErrorStatistics
    relative: tuple[RelativeError, ...]
    time_offset: TimeOffset


def trajectory_error(
    estimate: Trajectory,
    ground_truth: Trajectory,
    time_offset: float | Literal["auto"] = 0.0,
) -> TrajectoryError:
    """Compare a trajectory to ground truth at the estimate's stamps.

    time_offset : seconds to add to a stamp of the estimate to get the ground truth's, or "auto".
    Raises TooFewPairsError if the two hardly share a time.
    """
    offset = (
        estimate_time_offset(estimate, ground_truth)
        if time_offset == "auto"
        else TimeOffset(float(time_offset), estimated=False)
    )
    pairs = associate(estimate, ground_truth, offset.offset_s)
    T_truth_map = alignment(pairs)
    error_m = residuals_m(pairs, T_truth_map)
    difference_rad = yaw_rad(T_truth_map) + pairs.estimate[:, 2] - pairs.truth[:, 2]
    error_rad = np.abs(np.arctan2(np.sin(difference_rad), np.cos(difference_rad)))
    return TrajectoryError(
        count=pairs.stamps_ns.size,
        poses=len(estimate),
        T_truth_map=T_truth_map,
        translation_m=_statistics(error_m),
        rotation_deg=_statistics(np.degrees(error_rad)),
        relative=_relative_errors(pairs),
        time_offset=offset,
    )


def _relative_errors(pairs: Pairs) -> tuple[RelativeError, ...]:
    steps_m = np.hypot(*np.diff(pairs.truth[:, :2], axis=0).T)
    way_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    time_s: Array = (pairs.stamps_ns - pairs.stamps_ns[0]) * 1e-9
    lengths: list[tuple[Array, float, Literal["m", "s"]]] = [
        *((way_m, delta, "m") for delta in RPE_WAYS_M),
        *((time_s, delta, "s") for delta in RPE_TIMES_S),
    ]
    found = []
    for along, delta, unit in lengths:
        first, second = stretches(along, delta)
        if first.size:
            translation_m, rotation_rad = _relative_error(pairs, first, second)
            found.append(
                RelativeError(
                    delta=delta,
                    unit=unit,
                    count=first.size,
                    translation_m=_statistics(translation_m),
                    rotation_deg=_statistics(np.degrees(rotation_rad)),
                )
            )
    return tuple(found)


def _relative_error(pairs: Pairs, first: Indices, second: Indices) -> tuple[Array, Array]:
    """How the estimated motion over each stretch differs from the true one: m and rad, >= 0."""
    moved = between(pairs.estimate[first], pairs.estimate[second])
    truly_moved = between(pairs.truth[first], pairs.truth[second])
    error = between(truly_moved, moved)
    return np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])


def stretches(along: Array, delta: float) -> tuple[Indices, Indices]:
    """Indices (first, second) of the stretches nearest to a length, and within a tenth of it.

    along : (N,), the way or the time at each pair, not decreasing.
    The first of equally near ends is taken, as evo does it.
    """
    first = np.arange(max(along.size - 1, 0))
    target = along[first] + delta
    above = np.clip(np.searchsorted(along, target), first + 1, along.size - 1)
    below = np.maximum(above - 1, first + 1)
    nearer = np.abs(along[below] - target) <= np.abs(along[above] - target)
    second = np.where(nearer, below, above)
    second = np.maximum(np.searchsorted(along, along[second]), first + 1)
    fits = np.abs(along[second] - target) <= RPE_TOLERANCE * delta
    return first[fits], second[fits]


def _statistics(values: Array) -> ErrorStatistics:
    return ErrorStatistics(
        rmse=float(np.sqrt((values**2).mean())),
        mean=float(values.mean()),
        median=float(np.median(values)),
        maximum=float(values.max()),
    )
