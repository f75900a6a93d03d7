"""The bilateral filter of the paper (section 3.2), made to fit a stereo camera's noise."""

from __future__ import annotations

from typing import Final

import numpy as np

from datasets.messages import Float32s

SIGMA_PX: Final = 4.5
"""Of the distance weight, (5)."""

DIAMETER_PX: Final = 7

SIGMA_NOISES: Final = 3.0
"""Of the value weight, (6), in standard deviations of the noise."""


def smooth(depth_m: Float32s, focal_baseline: float, subpixel_px: float) -> Float32s:
    """Smooth the disparity d = f B / z, whose noise is the same near and far.

    depth_m : (H, W), NaN holes, which stay holes: as disparity they are 0, infinitely far, so that
    the value weight keeps them out of their neighbours.
    """
    import cv2  # noqa: PLC0415

    seen = depth_m > 0.0
    disparity = np.divide(focal_baseline, depth_m, out=np.zeros_like(depth_m), where=seen)
    smoothed = cv2.bilateralFilter(disparity, DIAMETER_PX, SIGMA_NOISES * subpixel_px, SIGMA_PX)
    out = np.full_like(depth_m, np.nan)
    return np.divide(focal_baseline, smoothed, out=out, where=seen, dtype=np.float32)
