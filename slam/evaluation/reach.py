"""Poses between the scans: from the poses of the neighbouring scans, along the odometry.

The choice matters where scans are sparse. One and the same good trajectory of ``intel`` scores over
all relations 0.040 m this way, 0.040 m if both ways are only blended, 0.046 m from the nearest scan
alone and 0.085 m interpolated (0.015 m over the relations whose stamps are scans); on ``fr079``,
which has a scan every 0.24 s, 0.036 m by each. So compare only what one evaluator scored.
"""

from __future__ import annotations

import numpy as np

from datasets.messages import Array
from datasets.se2 import between, compose, wrapped_rad
from datasets.trajectory import Stamps, Trajectory

YAW_LEVER_M = 0.5
"""A turn by one radian counts as this much way when a correction is spread along the way."""


def reach(trajectory: Trajectory, odometry: Trajectory | None, stamps_ns: Stamps) -> Array:
    """The poses (x m, y m, yaw rad) of a trajectory at any stamps, (M, 3).

    Between two poses of the trajectory the odometry is followed, and what it got wrong over the
    stretch is taken back in proportion to the way driven (by odometry) since the pose before:
    first its turn, as of a base that steers to one side throughout, then what is left of the
    translation. Both poses are met exactly, and the turn of a steady bias is taken back whole.
    Before the first pose and after the last one the odometry is followed as it is. Without
    odometry the trajectory is interpolated, and held at its ends.
    """
    if odometry is None:
        return trajectory.at(stamps_ns)
    following = np.searchsorted(trajectory.stamps_ns, stamps_ns)
    before = np.maximum(following - 1, 0)
    after = np.minimum(following, len(trajectory) - 1)
    at_scans, at_stamps = odometry.at(trajectory.stamps_ns), odometry.at(stamps_ns)
    way = between(at_scans[before], at_stamps)
    stretch = between(at_scans[before], at_scans[after])
    true_stretch = between(trajectory.xyyaw[before], trajectory.xyyaw[after])
    fraction = _fraction(
        _length_m(way),
        _length_m(between(at_scans[after], at_stamps)),
        stamps_ns - trajectory.stamps_ns[before],
        trajectory.stamps_ns[after] - stamps_ns,
    )
    turn = wrapped_rad(true_stretch[:, 2] - stretch[:, 2])
    rest = true_stretch[:, :2] - _rotated(stretch[:, :2], turn / 2)
    xy = _rotated(way[:, :2], fraction * turn / 2) + fraction[:, None] * rest
    return compose(trajectory.xyyaw[before], np.column_stack([xy, way[:, 2] + fraction * turn]))


def _fraction(way_0_m: Array, way_1_m: Array, time_0_ns: Stamps, time_1_ns: Stamps) -> Array:
    """How far along each stamp is from its neighbour before (0) to the one after (1), (M,).

    Standing still there is no way to go by: a hundredth of a millimetre per second stands in.
    """
    from_0 = np.where(time_0_ns > 0, way_0_m + 1e-14 * time_0_ns, 0.0)
    from_1 = np.where(time_1_ns > 0, way_1_m + 1e-14 * time_1_ns, 0.0)
    total = from_0 + from_1
    fraction: Array = np.divide(from_0, total, out=np.zeros_like(total), where=total > 0.0)
    return fraction


def _length_m(way: Array) -> Array:
    length: Array = np.hypot(way[:, 0], way[:, 1]) + YAW_LEVER_M * np.abs(way[:, 2])
    return length


def _rotated(xy: Array, angle_rad: Array) -> Array:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.column_stack([cos * xy[:, 0] - sin * xy[:, 1], sin * xy[:, 0] + cos * xy[:, 1]])
