"""A depth image becomes a pseudo-laser scan: the better mode (paper section 3.1, improved).

Every pixel is placed by its own ray, gated by its height over the floor, and counted in a bin by
bearing and horizontal range. A surface is a cluster of pixels over range, and its range is their
mean, not the minimum, which is short by 2-3 standard deviations. See docs/fusion.md.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from datasets.messages import Array, DepthImage, Float32s
from datasets.recording import CameraCalibration
from fusion.depth_config import DepthConfig
from fusion.depth_floor import Floor, fit_floor
from fusion.depth_geometry import EXIT_CELL_M, pixel_geometry
from fusion.depth_kernels import Gate, find_surfaces, tally
from fusion.depth_labels import label_pixels
from fusion.depth_noise import StereoNoise
from fusion.image_size import require_size
from fusion.pseudo_scan import PseudoScan

CELL_M: Final = 0.02
"""Range cells of a bin."""

WINDOW_DEVIATIONS: Final = 2.5
"""Half a window holds so many standard deviations of a surface's noise."""

FLOOR_DEVIATIONS: Final = 3.5
"""Standard deviations of noise that the floor may reach above itself without being an obstacle."""

LEAST_PIXELS: Final = 4
"""Fewer never make a surface."""

TAIL_SHARE: Final = 0.25
"""What follows a surface at once and has fewer of its pixels is the tail of its noise."""

GRAZING_M: Final = 0.2
"""A plane whose distance from the camera is less is seen at a grazing angle, if at all."""

STEPS_PX: Final = 0.0625
"""Two steps of 1/32 px: neighbouring disparities differ so much by quantisation alone."""

FREE_SHARE: Final = 0.5
"""Of the pixels that see the floor of a place, so many must have seen it."""

FLOOR_SAMPLES: Final = 5000
"""Pixels to find the floor by, evenly spread."""

FLOOR_TO_M: Final = 3.5
"""Depth up to which they count: farther on, slow waves tell more of themselves."""


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
        self._noise = StereoNoise.of(geometry.focal_px, config)
        self._steepest = config.baseline_m / GRAZING_M + STEPS_PX
        # A surface at the last range is noise around it, both sides of which must be seen.
        last_m = np.array(config.max_range_m)
        self._reach_m = float(last_m + WINDOW_DEVIATIONS * self._noise.depth_sigma_m(last_m))
        middles_m = np.arange(0.5 * CELL_M, self._reach_m + CELL_M, CELL_M)
        half = WINDOW_DEVIATIONS * self._noise.depth_sigma_m(middles_m) / CELL_M
        self._halves = np.maximum(np.rint(half), 1).astype(np.int32)
        # Pixels that a strip as wide as a bin fills at this distance, see there.
        density = geometry.focal_px / geometry.step
        filled = geometry.spacing_rad * config.support_height_m * density**2 / middles_m
        self._needs = np.maximum(filled, LEAST_PIXELS).astype(np.float32)
        # Noise lifts the floor by as much as it has where the floor is, not where it seems to be.
        floor_m = np.minimum(geometry.floor_depths_m, self._reach_m / geometry.planars)
        margins = FLOOR_DEVIATIONS * self._noise.depth_sigma_m(floor_m) / floor_m**2
        self._margins = margins.astype(np.float32)

    def __call__(self, image: DepthImage) -> PseudoScan:
        """What the image shows, in the base frame of its moment.

        Raises ValueError if the image is not of the size that the intrinsics are for.
        """
        require_size(image, self._size)
        geometry, config = self._geometry, self._config
        depth_m = image.depth_m
        bearings_rad = geometry.bearings_rad
        bins = bearings_rad.size
        gate = self._gate(self.floor(depth_m))
        count, total, free = self._tally(depth_m, gate)
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

    def used_pixels(self, image: DepthImage) -> npt.NDArray[np.uint8]:
        """(H, W) what became of each pixel, one of the constants of ``depth_labels``.

        For pictures: slower than the projection itself. Raises ValueError as that does.
        """
        ranges_m = self(image).ranges_m
        depth_m = image.depth_m
        known_m = np.where(np.isfinite(ranges_m), ranges_m, -np.inf)
        cells = np.clip(known_m / CELL_M, 0, self._halves.size - 1).astype(np.intp)
        return label_pixels(
            self._geometry,
            self._gate(self.floor(depth_m)),
            self._margins,
            (self._noise.focal_baseline, self._steepest),
            depth_m,
            known_m,
            np.asarray((self._halves[cells] + 0.5) * CELL_M),
        )

    def bins_of_pixels(self) -> npt.NDArray[np.int16]:
        """(H, W) index of the bearing that each pixel belongs to; -1 for those that don't count."""
        step, (height, width) = self._geometry.step, self._size
        return self._geometry.bins.repeat(step, axis=0).repeat(step, axis=1)[:height, :width]

    def floor(self, depth_m: Float32s) -> Floor:
        """Where the floor of this image lies; see ``fit_floor``."""
        geometry, tilt = self._geometry, self._config.tilt_error_rad
        spacing = math.ceil(math.sqrt(geometry.bins.size / FLOOR_SAMPLES))
        every = np.s_[::spacing, ::spacing]
        depth = depth_m[:: geometry.step, :: geometry.step][every].astype(np.float64)
        row, column = np.nonzero((depth > 0.0) & (depth < FLOOR_TO_M))
        z = depth[row, column]
        at = np.column_stack([np.ones(z.size), column * spacing, row * spacing])
        rise = at @ geometry.rises
        points = np.column_stack([at @ geometry.aheads, at @ geometry.lefts, rise]) * z[:, None]
        points[:, 2] += geometry.camera_m
        noise_m = np.abs(rise) * self._noise.depth_sigma_m(z)
        band_m = self._config.lower_m + 2.0 * tilt * np.hypot(*points[:, :2].T) + 3.0 * noise_m
        alike = self._noise.alike(z, spacing * geometry.step)
        return fit_floor(points, noise_m, alike, tilt, band_m)

    def _gate(self, floor: Floor) -> Gate:
        """Heights over the floor as it is, linear in pixel and depth like the nominal ones."""
        geometry, config = self._geometry, self._config
        tilts = floor.tilt_x * geometry.aheads + floor.tilt_y * geometry.lefts
        rise, per_column, per_row = geometry.rises - tilts
        return Gate(
            height=geometry.camera_m - floor.height_m,
            rise=float(rise),
            per_column=float(per_column),
            per_row=float(per_row),
            lower=config.lower_m,
            upper=config.upper_m,
            tilt=floor.doubt_rad,
            reach=self._reach_m,
        )

    def _tally(
        self, depth_m: Float32s, gate: Gate
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
            gate,
            self._margins,
            geometry.planars,
            geometry.bins,
            geometry.exits,
            self._noise.focal_baseline,
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
        first[first <= (expected > 0).argmax(axis=1)] = 0  # not even the nearest floor in view
        return np.minimum(first * EXIT_CELL_M, self._config.max_range_m)

    def _sigma(self, ranges_m: Array, members: npt.NDArray[np.int32]) -> Array:
        """(B,) m, of the mean of so many pixels, most of which err alike."""
        geometry = self._geometry
        finite = np.isfinite(ranges_m)
        rows_px = (
            members[finite] * geometry.step**2 / (geometry.spacing_rad * geometry.focal_columns_px)
        )
        sigma_m = np.full(ranges_m.shape, np.nan)
        sigma_m[finite] = self._noise.mean_sigma_m(ranges_m[finite], rows_px)
        return sigma_m
