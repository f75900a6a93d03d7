"""What tells a stereo camera's depth images: holes, noise on planes, seams at steps of depth.

All is measured on disparity, f B / z in px, where the camera's own noise is the same everywhere.
Depth images are (H, W) in m with 0 for holes; ``focal_baseline`` is f B in px m.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from datasets.messages import Array
from datasets.simulation.depth_kernels import Float32s

SURFACE_PX = 6
SLOPE_PX = 0.3
GAP_PX = 80


@dataclass(frozen=True, slots=True)
class Patches:
    """Square pieces of an image that lie on a plane.

    depth_m   : (P,) in the middle. rms_px : (P,) of the residuals of the plane, in disparity.
    holes     : (P,) share. residuals : (P, S, S), px; NaN in holes and outliers.
    """

    depth_m: Array
    rms_px: Array
    holes: Array
    residuals: Array


def disparity_of(depth_m: Float32s, focal_baseline: float) -> Array:
    """(H, W) float64, px; NaN in holes."""
    out = np.full(depth_m.shape, np.nan)
    np.divide(focal_baseline, depth_m, out=out, where=depth_m > 0)
    return out


def plane_patches(depth_m: Float32s, focal_baseline: float, size: int) -> Patches:
    """The pieces of a grid that a plane fits, the outermost columns left out.

    A plane's disparity is linear in the pixel. Fitted by least squares, twice again without what
    is off by three sigma; kept if 97 % remain, holes apart, and the rms is below half a pixel.
    """
    disparity = disparity_of(depth_m, focal_baseline)
    height, width = disparity.shape
    v, u = np.mgrid[:size, :size].reshape(2, -1) - (size - 1) / 2
    design = np.column_stack([u, v, np.ones(u.size)])
    rows: list[tuple[float, float, float]] = []
    residuals = []
    for top in range(0, height - size + 1, size):
        for left in range(width // 10, width - size + 1, size):
            values = disparity[top : top + size, left : left + size].ravel()
            kept = valid = np.isfinite(values)
            if valid.mean() < 0.9:
                continue
            for _ in range(3):
                plane = np.linalg.lstsq(design[kept], values[kept], rcond=None)[0]
                off = values - design @ plane
                rms = float(np.sqrt(np.mean(off[kept] ** 2)))
                kept = valid & (np.abs(np.nan_to_num(off)) <= 3 * max(rms, 0.02))
            if kept.sum() < 0.97 * valid.sum() or rms > 0.5 or plane[2] <= 0:
                continue
            rows.append((focal_baseline / plane[2], rms, 1 - float(valid.mean())))
            residuals.append(np.where(kept, off, np.nan).reshape(size, size))
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    stack = np.array(residuals, dtype=np.float64).reshape(-1, size, size)
    return Patches(table[:, 0], table[:, 1], table[:, 2], stack)


def correlation(residuals: Array, lag_px: int, axis: int) -> float:
    """Mean correlation of residuals with those ``lag_px`` beside (axis 1) or below (axis 0)."""
    moved = np.roll(residuals, -lag_px, axis=axis + 1)
    inside = np.arange(residuals.shape[axis + 1] - lag_px)
    product = np.take(residuals * moved, inside, axis=axis + 1)
    return float(np.nanmean(product) / np.nanmean(residuals**2))


def steps(depth_m: Float32s, focal_baseline: float, least_px: float = 3.0) -> Array:
    """Steps of depth along every fourth row, (S, 3): jump px, mixed px, holes px.

    A step lies between two smooth stretches of at least ``SURFACE_PX`` whose disparities differ by
    ``least_px``; jump > 0 goes from far to near, where the shadow is. Mixed are the pixels that
    differ from both sides by more than 15 % of the jump.
    """
    found = []
    for row in disparity_of(depth_m, focal_baseline)[::4]:
        slopes = np.abs(np.diff(row))
        flat = np.append(slopes < SLOPE_PX, False) | np.append(False, slopes < SLOPE_PX)
        turns = np.flatnonzero(np.diff(flat.astype(np.int8), prepend=0, append=0))
        pieces = turns.reshape(-1, 2)
        pieces = pieces[pieces[:, 1] - pieces[:, 0] >= SURFACE_PX]
        for (_, end), (begin, _) in pairwise(pieces):
            before, after = np.median(row[end - 4 : end]), np.median(row[begin : begin + 4])
            jump = after - before
            if begin - end > GAP_PX or abs(jump) < least_px:
                continue
            between = row[end:begin]
            share = (between - before) / jump
            mixed = (share > 0.15) & (share < 0.85)
            found.append((jump, mixed.sum(), np.isnan(between).sum()))
    return np.array(found, dtype=np.float64).reshape(-1, 3)


def left_band(depth_m: Float32s, focal_baseline: float) -> Array:
    """How much wider than the disparity the strip without depth at the left edge is, px, by row."""
    disparity = disparity_of(depth_m, focal_baseline)
    valid = np.isfinite(disparity)
    rows = np.flatnonzero(valid.any(axis=1))
    first = valid[rows].argmax(axis=1)
    return np.asarray(first - disparity[rows, first], dtype=np.float64)


def quantum_px(depth_m: Float32s, focal_baseline: float) -> float:
    """Median step between the disparities that occur from 2.5 to 4 m; NaN without any."""
    depths_m = np.unique(depth_m[(depth_m > 2.5) & (depth_m < 4.0)])
    if depths_m.size < 2:
        return float("nan")
    return float(np.median(-np.diff(focal_baseline / depths_m.astype(np.float64))))
