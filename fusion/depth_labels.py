"""What became of each pixel of a depth image: for a picture to tune by, not for the hot path."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from datasets.messages import Array, Float32s
from fusion.depth_geometry import PixelGeometry
from fusion.depth_kernels import Gate

HOLE: Final = 0
"""No depth, or a direction that doesn't count."""
TOO_HIGH: Final = 1
"""Above the gate, or farther than it reaches."""
FREE: Final = 2
"""The floor, within what tilt and noise may lift it."""
PIT: Final = 3
"""As far below the floor: a pit, stairs, a mirror."""
FLYING: Final = 4
"""Within the gate, but where disparity changes faster than on any plane."""
BEHIND: Final = 5
"""Within the gate, not of the nearest surface: behind it, or without support."""
NEAREST: Final = 6
"""Of the surface that is the pseudo-laser's range."""

NAMES: Final = ("hole", "out of the gate", "floor", "below floor", "flying", "behind", "nearest")


def label_pixels(
    geometry: PixelGeometry,
    gate: Gate,
    margins: Float32s,
    limit_px: tuple[float, float],
    depth_m: Float32s,
    ranges_m: Array,
    halves_m: Array,
) -> npt.NDArray[np.uint8]:
    """(H, W) one of the constants above for each pixel, as ``tally`` and ``find_surfaces`` see it.

    limit_px : f B in px m, and the steepest change of disparity. ranges_m, halves_m : (B,) the
    nearest surface of each bin, and half of the window that it was taken from.
    """
    step = geometry.step
    z = depth_m[::step, ::step].astype(np.float64)
    columns, rows = np.meshgrid(np.arange(z.shape[1]), np.arange(z.shape[0]))
    rise = gate.rise + columns * gate.per_column + rows * gate.per_row
    seen = (z > 0.0) & (geometry.bins >= 0)
    z = np.where(seen, z, 1.0)
    high, range_m = gate.height + rise * z, z * geometry.planars
    edge = np.maximum(gate.lower, gate.tilt * range_m + gate.height * z * margins)
    nearest = np.abs(range_m - ranges_m[geometry.bins]) <= halves_m[geometry.bins]
    labels = np.select(
        [
            ~seen,
            high > gate.upper,
            high < -edge,
            high <= edge,
            range_m > gate.reach,
            _flying(depth_m, *limit_px)[::step, ::step],
            nearest,
        ],
        [HOLE, TOO_HIGH, PIT, FREE, TOO_HIGH, FLYING, NEAREST],
        BEHIND,
    ).astype(np.uint8)
    full = labels.repeat(step, axis=0).repeat(step, axis=1)
    return full[: depth_m.shape[0], : depth_m.shape[1]]


def _flying(depth_m: Float32s, focal_baseline: float, steepest: float) -> npt.NDArray[np.bool_]:
    """(H, W) the rule of ``is_flying``, in disparities."""
    disparity = focal_baseline / np.where(depth_m > 0.0, depth_m, np.nan).astype(np.float64)
    flying = np.zeros(depth_m.shape, dtype=np.bool_)
    across, down = np.abs(np.diff(disparity, axis=1)), np.abs(np.diff(disparity, axis=0))
    flying[:, 1:] |= across > steepest
    flying[:, :-1] |= across > steepest
    flying[1:] |= down > steepest
    flying[:-1] |= down > steepest
    return flying
