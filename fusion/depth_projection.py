"""A depth image becomes a pseudo-laser scan: the better mode (paper section 3.1, improved).

Every pixel is placed by its own ray, gated by its height over the floor, and counted in a bin by
bearing and horizontal range. A surface is a cluster of pixels over range, and its range is their
mean, not the minimum, which is short by 2-3 standard deviations. See docs/fusion.md.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datasets.messages import Array, DepthImage, Float32s
from datasets.recording import CameraCalibration
from fusion.depth_config import DepthConfig
from fusion.depth_geometry import EXIT_CELL_M, WAVE_FROM_M, pixel_geometry
from fusion.depth_kernels import find_surfaces, tally
from fusion.pseudo_scan import PseudoScan

CELL_M = 0.02
"""Range cells of a bin."""

WINDOW_DEVIATIONS = 2.5
"""Half a window holds so many standard deviations of a surface's noise."""

LEAST_PIXELS = 4
"""Fewer never make a surface."""

TAIL_SHARE = 0.25
"""What follows a surface at once and has fewer of its pixels is the tail of its noise."""

GRAZING_M = 0.2
"""A plane whose distance from the camera is less is seen at a grazing angle, if at all."""

STEPS_PX = 0.0625
"""Two steps of 1/32 px: neighbouring disparities differ so much by quantisation alone."""

FREE_SHARE = 0.5
"""Of the pixels that see the floor of a place, so many must have seen it."""

NOISE_LENGTH_PX, WAVE_LENGTH_PX = 14.0, 42.0
"""Rows of pixels that err alike: integrals of the correlation, which is Gaussian, of the noise
(4 px) and of the slow waves (12 px)."""

STEADY_PX = 0.02
"""What is left of the disparity's error however many pixels are averaged."""


class DepthProjection:
    """The obstacles in the depth images of one camera.

    Raises ValueError, in words for the report, if the camera's mounting or pinhole is unknown or
    makes no sense.
    """

    def __init__(self, calibration: CameraCalibration, config: DepthConfig) -> None:
        self._config = config
        self._geometry = geometry = pixel_geometry(calibration, config)
        assert calibration.intrinsics is not None  # checked there
        self._size = (calibration.intrinsics.height_px, calibration.intrinsics.width_px)
        self._columns_px = geometry.spacing_rad * calibration.intrinsics.K[0, 0]
        self._steepest = config.baseline_m / GRAZING_M + STEPS_PX
        middles_m = np.arange(0.5 * CELL_M, geometry.gate.reach_m + CELL_M, CELL_M)
        sigma_m = self._disparity_noise(middles_m) * middles_m**2 / geometry.gate.focal_baseline
        self._halves = np.maximum(np.rint(WINDOW_DEVIATIONS * sigma_m / CELL_M), 1).astype(np.int32)
        # Pixels that a strip as wide as a bin fills at this distance, see there.
        density = geometry.gate.focal_baseline / config.baseline_m / geometry.step
        filled = geometry.spacing_rad * config.support_height_m * density**2 / middles_m
        self._needs = np.maximum(filled, LEAST_PIXELS).astype(np.float32)

    def __call__(self, image: DepthImage) -> PseudoScan:
        """What the image shows, in the base frame of its moment.

        Raises ValueError if the image is not of the size that the intrinsics are for.
        """
        if image.depth_m.shape != self._size:
            raise ValueError(
                f"the depth image has {image.depth_m.shape[1]} x {image.depth_m.shape[0]} pixels, "
                f"its intrinsics are for {self._size[1]} x {self._size[0]}"
            )
        geometry, config = self._geometry, self._config
        bearings_rad = geometry.bearings_rad
        bins = bearings_rad.size
        count, total, free = self._tally(image.depth_m)
        ranges_m, suspect_m = np.empty(bins), np.empty(bins)
        members = np.empty(bins, dtype=np.int32)
        surfaces = np.empty((count.size // 2 + bins, 2), dtype=np.float32)
        found = find_surfaces(
            count,
            total,
            self._halves,
            self._needs,
            config.max_range_m,
            CELL_M,
            TAIL_SHARE,
            ranges_m,
            members,
            suspect_m,
            surfaces,
        )
        free_to_m = np.minimum(self._seen_free_to(free), np.minimum(suspect_m, ranges_m))
        unknown = np.isinf(ranges_m) & (free_to_m <= geometry.free_from_m)
        ranges_m[unknown] = np.nan
        at = bearings_rad[surfaces[:found, 0].astype(np.intp)]
        rays = np.column_stack([np.cos(at), np.sin(at)])
        points_base = geometry.origin_base + rays * surfaces[:found, 1:]
        return PseudoScan(
            stamp_ns=image.stamp_ns,
            sensor=image.camera,
            origin_base=geometry.origin_base,
            bearings_rad=bearings_rad,
            ranges_m=ranges_m,
            sigma_m=self._sigma(ranges_m, members),
            free_from_m=geometry.free_from_m,
            free_to_m=free_to_m,
            surfaces_base=points_base.astype(np.float32),
            spacing_rad=geometry.spacing_rad,
        )

    def _tally(
        self, depth_m: Float32s
    ) -> tuple[npt.NDArray[np.int32], Float32s, npt.NDArray[np.int32]]:
        """Pixels of each bin by range, their ranges' sum, and the free ones; see ``tally``."""
        geometry = self._geometry
        count = np.zeros((geometry.bearings_rad.size, self._halves.size), dtype=np.int32)
        total = np.zeros(count.shape, dtype=np.float32)
        free = np.zeros(geometry.expected.shape, dtype=np.int32)
        tally(
            depth_m,
            geometry.step,
            geometry.rows,
            geometry.near,
            geometry.far,
            geometry.deep,
            geometry.planars,
            geometry.bins,
            geometry.exits,
            geometry.gate.focal_baseline,
            self._steepest,
            1.0 / CELL_M,
            count,
            total,
            free,
        )
        return count, total, free

    def _seen_free_to(self, free: npt.NDArray[np.int32]) -> Array:
        """(B,) m up to where the floor was seen, or things beyond max range, without a gap."""
        expected = self._geometry.expected
        lost = free < FREE_SHARE * expected
        lost[self._geometry.blind] = True
        first = np.where(lost.any(axis=1), lost.argmax(axis=1), expected.shape[1])
        return np.minimum(first * EXIT_CELL_M, self._config.max_range_m)

    def _disparity_noise(self, ranges_m: Array) -> Array:
        """px; the formula of the kernel of that name."""
        wave = self._config.wave_px * np.maximum(0.0, ranges_m / WAVE_FROM_M - 1.0)
        noise: Array = np.hypot(self._config.subpixel_px, wave)
        return noise

    def _sigma(self, ranges_m: Array, members: npt.NDArray[np.int32]) -> Array:
        """(B,) m, of the mean of so many pixels, most of which err alike."""
        config, geometry = self._config, self._geometry
        finite = np.isfinite(ranges_m)
        sigma_m = np.full(ranges_m.shape, np.nan)
        rows = members[finite] * geometry.step**2 / self._columns_px
        ranges_m = ranges_m[finite]
        wave = config.wave_px * np.maximum(0.0, ranges_m / WAVE_FROM_M - 1.0)
        variance = (
            config.subpixel_px**2 / np.maximum(rows / NOISE_LENGTH_PX, 1.0)
            + wave**2 / np.maximum(rows / WAVE_LENGTH_PX, 1.0)
            + STEADY_PX**2
        )
        sigma_m[finite] = ranges_m**2 * np.sqrt(variance) / geometry.gate.focal_baseline
        return sigma_m
