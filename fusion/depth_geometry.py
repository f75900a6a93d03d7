"""What each pixel of a mounted camera looks at: heights, bearings and the depths of the gate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.messages import Array, Float32s
from datasets.recording import CameraCalibration
from fusion.depth_config import DepthConfig
from fusion.depth_kernels import Gate, Shorts, gate_depths

WAVE_FROM_M = 2.5
"""Depth from which a stereo camera's disparity bends in slow waves; twice as far they have the rms
that the configuration names."""

FLOOR_DEVIATIONS = 4.0
"""Standard deviations of noise that the floor may reach above itself without being an obstacle."""

LEAST_PLANAR = 0.05
"""Rays steeper than 87 deg have no bearing to speak of."""

EXIT_CELL_M = 0.1
"""Step in which it is looked how far the floor was seen."""


@dataclass(frozen=True, slots=True)
class PixelGeometry:
    """The rays of every ``step``-th pixel of one camera, (h, w) each, and the bins they fall into.

    planars     : horizontal length per m of depth; range = depth * planar.
    near, far, deep : depths m, see ``gate_depths``.
    bins        : bearing bin; -1 for pixels that don't count.
    exits       : range cell of EXIT_CELL_M where the ray leaves the gate downwards, the last cell
                  if it is still inside at max range; -1 if it leaves upwards.
    rows        : (from, to) that hold all pixels that count.
    bearings_rad: (B,) ascending, around ``origin_base``, (2,).
    expected    : (B, E) pixels that leave the gate in each cell: what is seen of them is free.
    free_from_m : see ``PseudoScan``. blind : (B,) bins that see low things only from farther on.
    """

    step: int
    gate: Gate
    planars: Float32s
    near: Float32s
    far: Float32s
    deep: Float32s
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
    # Neighbouring pixels err alike (by some 4 px), so more than 1.5 of them side by side in a bin
    # tell no more.
    step = max(1, int(config.spacing_rad * focal_px / 1.5))
    gate = camera_gate(T_base_camera, focal_px * config.baseline_m, config)
    columns, rows = np.meshgrid(np.arange(0, width, step), np.arange(0, height, step))
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    ahead, left, rises = (row[0] * x + row[1] * y + row[2] for row in T_base_camera[:3, :3])
    planars = np.hypot(ahead, left)
    near, far, deep = (np.empty(planars.shape, dtype=np.float32) for _ in range(3))
    gate_depths(rises.astype(np.float32), planars.astype(np.float32), gate, near, far, deep)
    counts = (far > near) & (planars > LEAST_PLANAR)
    if not counts.any():
        raise ValueError("the camera looks at nothing within the height gate: check its mounting")

    middle = math.atan2(left[counts].mean(), ahead[counts].mean())
    turned = np.remainder(np.arctan2(left, ahead) - middle + np.pi, 2 * np.pi) - np.pi
    first = float(turned[counts].min())
    spacing = max(config.spacing_rad, 1.0 / focal_px)  # a finer bin may have no column
    bins = np.where(counts, ((turned - first) / spacing).astype(np.int16), np.int16(-1))
    count = int(bins.max()) + 1

    leaves_m = far * planars
    cells = math.ceil(config.max_range_m / EXIT_CELL_M)
    downwards = np.isfinite(deep) | ((rises < 0) & (leaves_m < config.max_range_m))
    exits = np.where(downwards, leaves_m / EXIT_CELL_M, -1.0)
    exits = np.where(leaves_m >= config.max_range_m, cells, np.minimum(exits, cells))
    exits = np.where(counts, exits, -1).astype(np.int16)
    expected = np.zeros((count, cells + 1))
    np.add.at(expected, (bins[exits >= 0], exits[exits >= 0]), 1.0)

    sees_low_m = np.full(count, np.inf)
    np.minimum.at(sees_low_m, bins[exits >= 0], leaves_m[exits >= 0])
    free_from_m = float(np.quantile(sees_low_m, 0.9, method="lower"))
    used = np.flatnonzero(counts.any(axis=1))
    return PixelGeometry(
        step=step,
        gate=gate,
        planars=planars.astype(np.float32),
        near=near,
        far=far,
        deep=deep,
        bins=bins.astype(np.int16),
        exits=exits,
        rows=(int(used[0]), int(used[-1]) + 1),
        origin_base=T_base_camera[:2, 3].copy(),
        bearings_rad=np.asarray(middle + first + (np.arange(count) + 0.5) * spacing),
        expected=expected,
        free_from_m=free_from_m,
        spacing_rad=spacing,
        blind=sees_low_m > free_from_m + EXIT_CELL_M,
    )


def camera_gate(T_base_camera: Array, focal_baseline: float, config: DepthConfig) -> Gate:
    """The gate as the kernels take it, and how far beyond the last range they have to look."""
    margin = 4.0 * config.max_range_m**2 * config.subpixel_px / focal_baseline
    return Gate(
        camera_m=float(T_base_camera[2, 3]),
        lower_m=config.lower_m,
        upper_m=config.upper_m,
        tilt=config.tilt_error_rad,
        deviations=FLOOR_DEVIATIONS,
        focal_baseline=focal_baseline,
        subpixel=config.subpixel_px,
        wave=config.wave_px,
        wave_from=WAVE_FROM_M,
        # A surface at the last range is noise around it, both sides of which must be seen.
        reach_m=config.max_range_m + margin,
    )


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
