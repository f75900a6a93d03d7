"""The paper's own method, sections 3.1 to 3.4, with nothing made better.

Depth images are taken as they come, a bin keeps the smallest of its rows' ranges, a beam the
smaller of the two sensors'; what moved between image and scan is not made up for. The rows know
nothing of the floor: the camera's mounting and ``scan_height_px`` must keep it out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from pydantic import Field

from datasets.messages import Array, DepthImage, Float32s
from datasets.recording import CameraCalibration
from datasets.section import Section
from fusion.image_size import require_size
from fusion.pseudo_scan import PseudoScan
from fusion.scan import BOTH, CAMERA, LIDAR, LIDAR_LAYER, FusedScan
from fusion.sweep import Sweep

SIGMA_D_PX = 4.5
SIGMA_R_M = 0.04
NEIGHBOURHOOD_PX = 7
"""The bilateral filter, (5) to (8). The paper gives no figures: a common choice."""

DEPTH_ERROR_SHARE = 0.02
"""The camera's depth error is less than this share; taken as two sigmas."""


class PaperConfig(Section):
    """How the paper makes a pseudo-laser scan."""

    scan_height_px: int = Field(
        10, ge=1, le=2000, description="rows of the depth image that count, centred on v0"
    )
    bins: int | None = Field(
        None, ge=2, le=10000, description="parts of the camera's view; none: as many as columns"
    )


class PaperProjection:
    """Depth images of one camera as pseudo-laser scans (paper, sections 3.1 and 3.2).

    Raises ValueError, in words for the report, if mounting or intrinsics are unknown, or if the
    image has no rows around its principal point.
    """

    def __init__(self, calibration: CameraCalibration, config: PaperConfig) -> None:
        if calibration.T_base_camera is None or calibration.intrinsics is None:
            raise ValueError("the camera's mounting or its intrinsics are not known")
        pinhole, self._T_base_camera = calibration.intrinsics, calibration.T_base_camera
        self._size = (pinhole.height_px, pinhole.width_px)
        self._fx, self._fy = float(pinhole.K[0, 0]), float(pinhole.K[1, 1])
        self._u0, self._v0 = float(pinhole.K[0, 2]), float(pinhole.K[1, 2])
        first = math.ceil(self._v0 - config.scan_height_px / 2)
        self._top = max(first, 0)
        self._end = min(first + config.scan_height_px, pinhole.height_px)
        if self._top >= self._end:
            raise ValueError("the depth image has no rows around its principal point")
        self._alpha = math.atan((-0.5 - self._u0) / self._fx)
        self._beta = math.atan((pinhole.width_px - 0.5 - self._u0) / self._fx)
        self._parts = config.bins or pinhole.width_px
        middles = self._alpha + (self._beta - self._alpha) * (
            (np.arange(self._parts) + 0.5) / self._parts
        )
        # where a part looks that shows nothing
        self._ahead = np.column_stack([np.sin(middles), np.zeros(self._parts), np.cos(middles)])

    def __call__(self, image: DepthImage) -> PseudoScan:
        """The pseudo-laser scan, in the base frame of the image's moment.

        Its bearings are those of the pixels that the ranges are of. Raises ValueError if the image
        is not of the size that the intrinsics are for.
        """
        from fusion.paper.paper_kernels import column_minimum  # noqa: PLC0415

        require_size(image, self._size)
        sense = np.empty(self._parts)
        points_camera = self._ahead.copy()
        column_minimum(
            self._filtered(image.depth_m),
            self._top,
            self._fx,
            self._fy,
            self._u0,
            self._v0,
            self._alpha,
            self._beta,
            sense,
            points_camera,
        )
        return self._in_the_plane(image, np.isfinite(sense), points_camera)

    def _filtered(self, depth_m: Float32s) -> Float32s:
        """(5) to (8) for the rows that count; holes stay 0.

        A neighbour that is a hole lies far off in range and so counts nothing, (6).
        """
        import cv2  # noqa: PLC0415

        reach = NEIGHBOURHOOD_PX // 2
        above = min(reach, self._top)
        rows = np.nan_to_num(
            depth_m[self._top - above : self._end + reach], nan=0.0, posinf=0.0, neginf=0.0
        )
        smooth = cv2.bilateralFilter(rows, NEIGHBOURHOOD_PX, SIGMA_R_M, SIGMA_D_PX)
        return np.asarray(smooth[above : above + self._end - self._top], dtype=np.float32)

    def _in_the_plane(
        self, image: DepthImage, hit: npt.NDArray[np.bool_], points_camera: Array
    ) -> PseudoScan:
        """Pixels (N, 3) by bearing around the camera; those without ``hit`` are directions only."""
        T = self._T_base_camera
        planar = points_camera @ T[:2, :3].T
        lengths = np.hypot(planar[:, 0], planar[:, 1])
        bearings = np.arctan2(planar[:, 1], planar[:, 0])
        order = np.argsort(bearings, kind="stable")
        ranges = np.where(hit, lengths, np.nan)[order]
        spacing = (self._beta - self._alpha) / self._parts
        return PseudoScan(
            stamp_ns=image.stamp_ns,
            sensor=image.camera,
            origin_base=T[:2, 3].copy(),
            bearings_rad=bearings[order],
            ranges_m=ranges,
            sigma_m=0.5 * DEPTH_ERROR_SHARE * ranges,
            free_from_m=0.0,
            free_to_m=np.where(hit, lengths, 0.0)[order],
            surfaces_base=(T[:2, 3] + planar[hit]).astype(np.float32),
            spacing_rad=spacing,
        )


def paper_fuse(sweep: Sweep, pseudo_scans: Sequence[PseudoScan]) -> FusedScan:
    """Data association and Algorithm 1 (paper, sections 3.3 and 3.4): at most one point a beam.

    Each pseudo-laser beam goes to the lidar beam of its bearing around the lidar, (13) to (16),
    for any mounting: see ``docs/fusion.md``. There ``if s1 < lidar[i]: lidar[i] = s1``. No return
    is +inf: it is filled. Invalid (NaN) and too near (-inf) beams fail the comparison and stay
    empty. An associated beam keeps the smaller range too, and is of source BOTH.
    """
    from fusion.compensation_kernels import GAMMA2  # noqa: PLC0415

    count = sweep.ranges_m.size
    if not count:
        return sweep.returns()
    camera_m, sigma_m = np.full(count, np.inf), np.full(count, np.nan)
    for pseudo in pseudo_scans:
        beams, s1, sigmas = _beams_of(sweep, pseudo)
        nearest_first = np.lexsort((s1, beams))
        beams, first = np.unique(beams[nearest_first], return_index=True)
        s1, sigmas = s1[nearest_first][first], sigmas[nearest_first][first]
        shorter = s1 < camera_m[beams]
        camera_m[beams[shorter]], sigma_m[beams[shorter]] = s1[shorter], sigmas[shorter]
    lidar_m = sweep.ranges_m
    returned, seen = np.isfinite(lidar_m), np.isfinite(camera_m)
    tau = np.where(returned & seen, lidar_m, np.nan) - np.where(seen, camera_m, np.nan)  # (12)
    with np.errstate(invalid="ignore"):
        associated = tau**2 / (sweep.variance_m2 + sigma_m**2) < GAMMA2  # (11)
        nearer = camera_m < lidar_m
    ranges = np.where(nearer, camera_m, lidar_m)
    variance = np.where(nearer, sigma_m**2, sweep.variance_m2)
    source = np.where(associated, BOTH, np.where(nearer, CAMERA, LIDAR)).astype(np.uint8)
    kept = np.isfinite(ranges)
    rays = np.column_stack([np.cos(sweep.bearings_rad[kept]), np.sin(sweep.bearings_rad[kept])])
    return FusedScan(
        sweep.stamp_ns,
        sweep.sensor,
        sweep.origin_base,
        sweep.origin_base + rays * ranges[kept, None],
        sweep.offsets_s[kept] if sweep.offsets_s.size else sweep.offsets_s,
        source[kept],
        sweep.spacing_rad,
        np.full(int(np.count_nonzero(kept)), LIDAR_LAYER, dtype=np.uint8),
        variance[kept],
        np.where(returned, lidar_m, np.nan)[kept],
        np.where(seen, camera_m, np.nan)[kept],
    )


def _beams_of(sweep: Sweep, pseudo: PseudoScan) -> tuple[npt.NDArray[np.intp], Array, Array]:
    """Index of the lidar's beam (16), range s1 from the lidar (14), sigma, of each finite range.

    What lies in no beam's direction is left out.
    """
    bearings = sweep.bearings_rad
    seen = pseudo.points_base - sweep.origin_base
    s1, phi = np.hypot(seen[:, 0], seen[:, 1]), np.arctan2(seen[:, 1], seen[:, 0])
    after = np.searchsorted(bearings, phi)
    sides = np.stack([(after - 1) % bearings.size, after % bearings.size])
    away = np.abs(np.angle(np.exp(1j * (bearings[sides] - phi))))
    nearest = away.argmin(axis=0)
    picked = np.arange(phi.size)
    within = away[nearest, picked] <= sweep.spacing_rad
    sigmas = pseudo.sigma_m[np.isfinite(pseudo.ranges_m)]
    return sides[nearest, picked][within], s1[within], sigmas[within]
