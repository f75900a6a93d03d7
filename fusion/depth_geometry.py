"""What each pixel of a mounted camera looks at: heights, bearings, and where it meets the floor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from datasets.messages import Array, Float32s
from datasets.recording import CameraCalibration
from fusion.depth_config import DepthConfig
from fusion.depth_kernels import Shorts

LEAST_PLANAR: Final = 0.05
"""Rays steeper than 87 deg have no bearing to speak of."""

LEAST_RANGE_M: Final = 0.15
"""Rays that leave the gate before can't meet anything but the robot."""

EXIT_CELL_M: Final = 0.1
"""Step in which it is looked how far the floor was seen."""


@dataclass(frozen=True, slots=True)
class PixelGeometry:
    """The rays of every ``step``-th pixel of one camera, (h, w) each, and the bins they fall into.

    rises       : (3,) of a ray, per m of depth: at column 0 and row 0 (of the small image), and how
                  it changes with a column and with a row. aheads, lefts : the same along x and y.
    floor_depths_m : where the ray meets the nominal floor; inf where it doesn't.
    planars     : horizontal length per m of depth; range = depth * planar.
    bins        : bearing bin; -1 for pixels that don't count.
    exits       : range cell of EXIT_CELL_M where the ray meets the floor, the last cell if it is
                  still within the gate at max range; -1 if it leaves upwards.
    rows        : (from, to) that hold all pixels that count.
    bearings_rad: (B,) ascending, around ``origin_base``, (2,).
    expected    : (B, E) pixels that end in each cell of a bare floor: all of them seen is free.
    free_from_m : see ``PseudoScan``. blind : (B,) bins that see low things only from farther on.
    """

    step: int
    camera_m: float
    focal_px: float
    focal_columns_px: float
    rises: Array
    aheads: Array
    lefts: Array
    floor_depths_m: Array
    planars: Float32s
    bins: Shorts
    exits: Shorts
    rows: tuple[int, int]
    origin_base: Array
    bearings_rad: Array
    expected: Array
    free_from_m: float
    spacing_rad: float
    blind: npt.NDArray[np.bool_]


def pixel_geometry(calibration: CameraCalibration, config: DepthConfig) -> PixelGeometry:
    """Work out once what stays the same from image to image.

    Raises ValueError, in words for the report, if the mounting or the pinhole is unknown or makes
    no sense.
    """
    T_base_camera, K, (height, width) = checked(calibration, config)
    focal_px = math.sqrt(K[0, 0] * K[1, 1])
    camera_m = float(T_base_camera[2, 3])
    # Neighbouring pixels err alike (by some 4 px), so more than 1.5 of them side by side in a bin
    # tell no more.
    step = max(1, int(config.spacing_rad * focal_px / 1.5))
    inverse = np.linalg.inv(K)
    small = inverse @ np.array([[0.0, step, 0.0], [0.0, 0.0, step], [1.0, 0.0, 0.0]])
    aheads, lefts, rises = T_base_camera[:3, :3] @ small
    columns, rows = np.meshgrid(np.arange(-(-width // step)), np.arange(-(-height // step)))
    ahead, left, rise = (c[0] + c[1] * columns + c[2] * rows for c in (aheads, lefts, rises))
    planars = np.hypot(ahead, left)
    floor_m, ceiling_m = _leaving(planars, rise, camera_m, config.upper_m)
    if camera_m > config.upper_m:
        counts = ceiling_m < config.max_range_m
    else:
        counts = ceiling_m > LEAST_RANGE_M
    counts &= planars > LEAST_PLANAR
    if not counts.any():
        raise ValueError("the camera looks at nothing within the height gate: check its mounting")

    middle = math.atan2(left[counts].mean(), ahead[counts].mean())
    turned = np.remainder(np.arctan2(left, ahead) - middle + np.pi, 2 * np.pi) - np.pi
    first = float(turned[counts].min())
    spacing = max(config.spacing_rad, 1.0 / focal_px)  # a finer bin may have no column
    bins = np.where(counts, (turned - first) / spacing, -1).astype(np.int16)
    count = int(bins.max()) + 1

    cells = math.ceil(config.max_range_m / EXIT_CELL_M)
    exits = np.minimum(floor_m / EXIT_CELL_M, cells)
    exits[~counts | ((rise > 0.0) & (ceiling_m < config.max_range_m))] = -1
    exits = exits.astype(np.int16)
    expected = np.zeros((count, cells + 1))
    np.add.at(expected, (bins[exits >= 0], exits[exits >= 0]), 1.0)
    sees_low_m = np.full(count, np.inf)
    np.minimum.at(sees_low_m, bins[exits >= 0], floor_m[exits >= 0])
    free_from_m = float(np.quantile(sees_low_m, 0.9, method="lower"))
    used = np.flatnonzero(counts.any(axis=1))
    return PixelGeometry(
        step=step,
        camera_m=camera_m,
        focal_px=focal_px,
        focal_columns_px=float(K[0, 0]),
        rises=rises,
        aheads=aheads,
        lefts=lefts,
        floor_depths_m=floor_m / planars,
        planars=planars.astype(np.float32),
        bins=bins,
        exits=exits,
        rows=(int(used[0]), int(used[-1]) + 1),
        origin_base=T_base_camera[:2, 3].copy(),
        bearings_rad=np.asarray(middle + first + (np.arange(count) + 0.5) * spacing),
        expected=expected,
        free_from_m=free_from_m,
        spacing_rad=spacing,
        blind=sees_low_m > free_from_m + EXIT_CELL_M,
    )


def _leaving(planars: Array, rise: Array, camera_m: float, upper_m: float) -> tuple[Array, Array]:
    """Planar ranges at which rays meet the floor, and the gate's top; inf where they never do.

    A camera over the gate sees into it from the top on, others out of it.
    """
    never = np.full(planars.shape, np.inf)
    floor_m = np.divide(-camera_m * planars, rise, out=never.copy(), where=rise < 0.0)
    up = (upper_m - camera_m) * planars
    ceiling_m = np.divide(up, rise, out=never, where=(rise * (upper_m - camera_m)) > 0.0)
    return floor_m, ceiling_m


def checked(
    calibration: CameraCalibration, config: DepthConfig
) -> tuple[Array, Array, tuple[int, int]]:
    """Mounting, camera matrix and size (height, width) that a camera can have, or ValueError."""
    T_base_camera, intrinsics = calibration.T_base_camera, calibration.intrinsics
    if T_base_camera is None:
        raise ValueError("nothing says where the camera stands on the base")
    if intrinsics is None:
        raise ValueError("nothing says the camera's intrinsics")
    K = intrinsics.K
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0.0 or K[1, 1] <= 0.0:
        raise ValueError("the camera's intrinsics are no pinhole: focal lengths must be positive")
    if intrinsics.height_px < 1 or intrinsics.width_px < 1:
        raise ValueError("the camera's intrinsics have no image size")
    if T_base_camera.shape != (4, 4) or not np.isfinite(T_base_camera).all():
        raise ValueError("the camera's mounting is no finite (4, 4) matrix")
    R = T_base_camera[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0.0:
        raise ValueError("the camera's mounting is no rotation and translation")
    height_m = float(T_base_camera[2, 3])
    if height_m <= config.lower_m:
        raise ValueError(
            f"the camera's mounting puts it at a height of {height_m:.3f} m: it must stand above "
            f"the floor, higher than {config.lower_m} m"
        )
    return T_base_camera, K, (intrinsics.height_px, intrinsics.width_px)
