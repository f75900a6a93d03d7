"""Points that a moving base saw one after the other, as of one moment."""

from __future__ import annotations

import numpy as np

from datasets.messages import Array


def deskew(points_base: Array, since_s: Array, velocity_base: Array) -> Array:
    """Points, each in the base frame of its own time, in the base frame at one moment.

    points_base   : (N, 2) m. since_s : (N,) s from that moment to each point's time.
    velocity_base : (3,) m/s, m/s, rad/s, of the base in its own frame: a constant twist.
    """
    turn = velocity_base[2] * since_s
    half = 0.5 * turn  # the chord of an arc lies at half the turn
    along, across = np.cos(half) * since_s, np.sin(half) * since_s
    c, s = np.cos(turn), np.sin(turn)
    x, y = points_base[:, 0], points_base[:, 1]
    vx, vy = velocity_base[0], velocity_base[1]
    return np.column_stack(
        [c * x - s * y + along * vx - across * vy, s * x + c * y + across * vx + along * vy]
    )
