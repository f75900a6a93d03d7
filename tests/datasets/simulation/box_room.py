"""A room whose ranges are known in closed form, and mountings of a lidar in it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from datasets.messages import Array
from datasets.simulation.lidar import Float32s


@dataclass(frozen=True)
class Distances:
    distance_m: Float32s


@dataclass(frozen=True)
class BoxRoom:
    """A room seen from inside, boxes in it, a pane that only lidars pass, a box that moves.

    room, boxes, pane : (low corner, high corner), m, map frame. mover_m_s : of the first box.
    """

    room: tuple[tuple[float, float, float], tuple[float, float, float]]
    boxes: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    pane: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    mover_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def cast(
        self,
        origins: Float32s,
        directions: Float32s,
        sensor: Literal["lidar", "depth"],
        time_s: float,
    ) -> Distances:
        assert origins.dtype == directions.dtype == np.float32
        start, along = origins.astype(np.float64), directions.astype(np.float64)
        np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1.0, atol=1e-6)
        best = slabs(start, along, *self.room)[1]
        solids = list(self.boxes) + ([self.pane] if self.pane and sensor == "depth" else [])
        for index, (low, high) in enumerate(solids):
            shift = np.array(self.mover_m_s) * time_s if index == 0 else np.zeros(3)
            enter, leave = slabs(start, along, low + shift, high + shift)
            best = np.where((enter > 0) & (enter <= leave), np.minimum(best, enter), best)
        return Distances(best.astype(np.float32))


def slabs(start: Array, along: Array, low: object, high: object) -> tuple[Array, Array]:
    """Where rays enter and leave a box, m along them."""
    along = np.where(along == 0.0, 1e-30, along)
    one = (np.asarray(low, dtype=float) - start) / along
    two = (np.asarray(high, dtype=float) - start) / along
    return np.minimum(one, two).max(axis=1), np.maximum(one, two).min(axis=1)


def mounting(
    x_m: float = 0.0,
    y_m: float = 0.0,
    z_m: float = 0.895,
    *,
    roll_deg: float = 0.0,
    pitch_deg: float = 0.0,
    yaw_deg: float = 0.0,
) -> Array:
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(math.radians(a)), math.sin(math.radians(a)))
        for a in (roll_deg, pitch_deg, yaw_deg)
    )
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    T_base_lidar = np.eye(4)
    T_base_lidar[:3, :3] = yaw @ pitch @ roll
    T_base_lidar[:3, 3] = x_m, y_m, z_m
    return T_base_lidar
