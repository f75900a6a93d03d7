"""How wrong a stereo camera's depth is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from datasets.messages import Array
from fusion.depth_config import DepthConfig

WAVE_FROM_M: Final = 2.5
"""Depth from which the disparity bends in slow waves; twice as far they have the configured rms."""

NOISE_ALIKE_PX: Final = 14.0
WAVES_ALIKE_PX: Final = 42.0
"""Pixels in a row that err alike, of the matcher's noise and of the slow waves: integrals of their
correlations, which are of Gaussians of 4 and 12 px."""

STEADY_PX: Final = 0.02
"""What is left of the disparity's error however many pixels are averaged."""


@dataclass(frozen=True, slots=True)
class StereoNoise:
    """Noise of depth z: z^2 / (f B) times that of the disparity, f B in px m."""

    focal_baseline: float
    subpixel_px: float
    wave_px: float

    @classmethod
    def of(cls, focal_px: float, config: DepthConfig) -> StereoNoise:
        return cls(focal_px * config.baseline_m, config.subpixel_px, config.wave_px)

    def wave(self, depth_m: Array) -> Array:
        """Standard deviation of the slow waves, px."""
        return self.wave_px * np.maximum(0.0, depth_m / WAVE_FROM_M - 1.0)

    def depth_sigma_m(self, depth_m: Array) -> Array:
        """Standard deviation of one pixel's depth."""
        sigma: Array = depth_m**2 * np.hypot(self.subpixel_px, self.wave(depth_m))
        return sigma / self.focal_baseline

    def mean_sigma_m(self, depth_m: Array, rows_px: Array) -> Array:
        """Standard deviation of the mean depth over so many rows of neighbouring pixels."""
        variance = (
            self.subpixel_px**2 / np.maximum(rows_px / NOISE_ALIKE_PX, 1.0)
            + self.wave(depth_m) ** 2 / np.maximum(rows_px / WAVES_ALIKE_PX, 1.0)
            + STEADY_PX**2
        )
        sigma: Array = depth_m**2 * np.sqrt(variance)
        return sigma / self.focal_baseline

    def alike(self, depth_m: Array, spacing_px: float) -> Array:
        """How many pixels of a grid of this spacing err alike, by the variances of both kinds."""
        wave = self.wave(depth_m) ** 2
        fine = max((NOISE_ALIKE_PX / spacing_px) ** 2, 1.0)
        slow = max((WAVES_ALIKE_PX / spacing_px) ** 2, 1.0)
        share: Array = (self.subpixel_px**2 * fine + wave * slow) / (self.subpixel_px**2 + wave)
        return share
