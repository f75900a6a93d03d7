"""Depth images as small blocks of inverse depth, which a calibration works with.

A stereo camera measures disparity, so its noise is even in inverse depth, and there a plane is
linear: n . X = d with X = z (x, y, 1) is 1/z = (n/d) . (x, y, 1). Fits and residuals in depth are
biased, and far things would pull on them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
from pydantic import Field

from datasets.messages import Array, Float32s
from datasets.recording import Intrinsics
from datasets.section import Section

BLOCK_RAD = 8 / 384
"""Width of a block: 8 px of a camera with 384 px focal length."""

WINDOW = 5
"""Blocks in a row over which a plane is fitted for the normal of the middle one."""

LEAST_FILLED = 0.6
"""Share of a block's pixels, and of a window's blocks, that must be measured."""

LINK_SIGMA = 4.0
"""A block further than so many sigma from the plane of its window lies on an edge."""

FARTHEST = 2.0
"""Blocks are measured so many times farther than walls may stand: to cut by what was measured
would take the near half of the noise and leave the far half."""


class DepthNoise(Section):
    """What is assumed of a depth camera: disparity = focal length x baseline / depth."""

    baseline_m: float = Field(0.05, gt=0.0, le=1.0)
    subpixel_px: float = Field(0.08, gt=0.0, le=5.0, description="noise of disparity, one sigma")
    waves_from_m: float = Field(2.5, gt=0.0, description="beyond it disparity has slow waves")
    farthest_m: float = Field(6.0, gt=0.0, description="what stands farther is left out")

    def of_inverse_depth(self, inverse_depth: Array, focal_px: float) -> Array:
        """Standard deviation, 1/m, of measured 1/z (N,) 1/m.

        Without waves it is that of sigma_z = z^2 subpixel / (f B); they grow with the square of z.
        """
        waves = 1.0 / np.maximum(inverse_depth * self.waves_from_m, 1e-3) ** 2
        sigma: Array = self.subpixel_px / (focal_px * self.baseline_m) * np.hypot(1.0, waves)
        return sigma


@dataclass(frozen=True, slots=True)
class DepthBlocks:
    """Blocks of one image that lie on smooth surfaces; optical frame throughout.

    rays          : (N, 3) float64, (x, y, 1): the point is ray / inverse_depth.
    inverse_depth : (N,) 1/m, mean over the block.
    sigma         : (N,) 1/m, its standard deviation; not smaller for the mean, since the noise of
                    neighbouring pixels is the same noise.
    normals       : (N, 3) unit, of the surface around, towards the camera.
    focal_px      : of the camera.
    """

    rays: Array
    inverse_depth: Array
    sigma: Array
    normals: Array
    focal_px: float

    def __len__(self) -> int:
        return len(self.inverse_depth)

    def chosen(self, which: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> Self:
        """Only these."""
        kept = (self.rays[which], self.inverse_depth[which])
        return type(self)(*kept, self.sigma[which], self.normals[which], self.focal_px)


def depth_blocks(depth_m: Float32s, intrinsics: Intrinsics, noise: DepthNoise) -> DepthBlocks:
    """The blocks of an image. depth_m : (H, W) float32, m along the optical axis, NaN for holes.

    An image that shows no surface gives none. Raises ValueError if the intrinsics are of another
    size.
    """
    if depth_m.shape != (intrinsics.height_px, intrinsics.width_px):
        size = f"{intrinsics.width_px} x {intrinsics.height_px}"
        raise ValueError(f"a depth image of {depth_m.shape} has intrinsics of {size}")
    K = intrinsics.K
    side = max(2, round(BLOCK_RAD * K[0, 0]))
    step = max(1, side // 4)
    share, mean = _block_means(depth_m, side, step, FARTHEST * noise.farthest_m)
    rows, columns = mean.shape
    middle = ((side // step - 1) * step) / 2.0
    x = (np.arange(columns) * side + middle - K[0, 2]) / K[0, 0]
    y = (np.arange(rows) * side + middle - K[1, 2]) / K[1, 1]
    x, y = np.broadcast_to(x, mean.shape), np.broadcast_to(y[:, None], mean.shape)
    filled = share >= LEAST_FILLED
    planes, rms = _window_planes(x, y, np.where(filled, mean, 0.0), filled)

    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    sigma = noise.of_inverse_depth(np.maximum(mean, 1e-3), K[0, 0])
    with np.errstate(invalid="ignore"):
        off = np.abs(np.einsum("rcx,rcx->rc", planes, rays) - mean)
        smooth = filled & (off < LINK_SIGMA * sigma) & (rms < LINK_SIGMA / 2 * sigma)
    chosen = np.zeros_like(smooth)
    chosen[::2, ::2] = True  # those between share their noise and their window
    smooth &= chosen
    normals = -planes[smooth] / np.linalg.norm(planes[smooth], axis=1)[:, None]
    return DepthBlocks(rays[smooth], mean[smooth], sigma[smooth], normals, float(K[0, 0]))


def _block_means(depth_m: Float32s, side: int, step: int, farthest_m: float) -> tuple[Array, Array]:
    """Share of measured pixels, and mean of 1/z, of each block; each step-th pixel is looked at."""
    rows, columns, looks = depth_m.shape[0] // side, depth_m.shape[1] // side, side // step
    grid = depth_m[: rows * side, : columns * side].reshape(rows, side, columns, side)
    looked = grid[:, : looks * step : step, :, : looks * step : step].astype(np.float64)
    with np.errstate(invalid="ignore"):
        good = (looked > 1e-3) & (looked < farthest_m)
    inverse = np.where(good, 1.0 / np.where(good, looked, 1.0), 0.0)
    count = good.sum(axis=(1, 3))
    mean: Array = inverse.sum(axis=(1, 3)) / np.maximum(count, 1)
    return count / looks**2, mean


def _window_planes(
    x: Array, y: Array, q: Array, filled: npt.NDArray[np.bool_]
) -> tuple[Array, Array]:
    """For each block a least-squares plane q = p . (x, y, 1) of its window: p, (R, C, 3), and rms.

    NaN where too little of the window is measured.
    """
    import cv2  # noqa: PLC0415

    w = filled.astype(np.float64)
    size = (WINDOW, WINDOW)

    def total(values: Array) -> Array:
        return np.asarray(
            cv2.boxFilter(
                np.ascontiguousarray(values * w),
                -1,
                size,
                normalize=False,
                borderType=cv2.BORDER_CONSTANT,
            )
        )

    count = total(w)
    enough = count >= math.ceil(LEAST_FILLED * WINDOW**2)
    n = np.where(enough, count, np.nan)
    mx, my, mq = total(x) / n, total(y) / n, total(q) / n
    xx, yy, xy = total(x * x) / n - mx**2, total(y * y) / n - my**2, total(x * y) / n - mx * my
    xq, yq, qq = total(x * q) / n - mx * mq, total(y * q) / n - my * mq, total(q * q) / n - mq**2
    determinant = xx * yy - xy**2  # never 0: so many blocks of a window are not in one line
    a, b = (xq * yy - yq * xy) / determinant, (yq * xx - xq * xy) / determinant
    rms = np.sqrt(np.maximum(qq - a * xq - b * yq, 0.0))
    return np.stack([a, b, mq - a * mx - b * my], axis=-1), rms
