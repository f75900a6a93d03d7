"""From the poses of a few nodes to those of everything that hangs from them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.se2 import between, compose, pose_matrices, wrapped_rad, xyyaw_rows


def spread(
    fixed: npt.NDArray[np.int64], T_map_fixed: Array, T_odom_base: Array, way: Array
) -> Array:
    """Poses in the map of a whole sequence of which a few are known.

    fixed       : (F,) ascending places in the sequence whose poses are known; F >= 1.
    T_map_fixed : (F, 3, 3) those poses. T_odom_base : (N, 3, 3) local SLAM's poses of all.
    way         : (N,) ascending, by which the correction is shared out (metres, seconds, count).

    Each pose is reached from the known one before and from the one after along local SLAM, and the
    two are averaged by the way to either, so that nothing jumps where a correction begins.
    """
    odom = xyyaw_rows(T_odom_base)
    known = xyyaw_rows(T_map_fixed)
    places = np.arange(len(odom))
    after = np.clip(np.searchsorted(fixed, places, side="right"), 0, len(fixed) - 1)
    before = np.clip(np.searchsorted(fixed, places, side="right") - 1, 0, len(fixed) - 1)
    forwards = compose(known[before], between(odom[fixed[before]], odom))
    backwards = compose(known[after], between(odom[fixed[after]], odom))
    span = way[fixed[after]] - way[fixed[before]]
    gone = way - way[fixed[before]]
    share = np.clip(np.where(span > 0.0, gone / np.where(span > 0.0, span, 1.0), 0.0), 0.0, 1.0)
    out = forwards.copy()
    out[:, :2] += share[:, None] * (backwards[:, :2] - forwards[:, :2])
    out[:, 2] += share * wrapped_rad(backwards[:, 2] - forwards[:, 2])
    return pose_matrices(out)
