"""The D435i: what a stereo camera makes of a scene.

Depth comes from disparity d = f B / z, found by matching blocks between a left and a right imager,
and all that is wrong with it comes from there: noise in d is noise growing with z squared in z, a
strip at the left edge lies outside the right image, what the right imager does not see is a shadow,
blocks on two surfaces find neither. Figures: `docs/simulation.md`.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from datasets.messages import Array
from datasets.section import Section
from datasets.simulation.depth_kernels import (
    Effects,
    Float32s,
    Pinhole,
    degrade,
    fill_between,
    pixel_rays,
    surface,
)
from datasets.simulation.scene import Scene

WINDOW_PX = 5
"""Side of the block over which the matcher sees one disparity."""

RAGGED_LENGTH_PX = 2.0
WAVE_LENGTH_PX = 12.0
"""How slowly borders wander and waves rise: deviations of the Gaussians that smooth their noise."""

EDGE_PX = 2.0
"""Steps of disparity that a block still takes for one surface: they are smoothed over."""


class Mode(NamedTuple):
    """nearest_m : below it the disparity is larger than the camera searches."""

    width: int
    height: int
    focal_px: float
    nearest_m: float


MODES = {
    "1280x720": Mode(1280, 720, 686.0, 0.28),
    "848x480": Mode(848, 480, 424.0, 0.195),
    "640x480": Mode(640, 480, 384.0, 0.175),
}


class DepthModel(Section):
    """A depth camera with the errors of a RealSense D435i.

    subpixel_px     : rms of the disparity's noise; of depth it is z^2 subpixel / (f B).
    kernel_px       : standard deviation of the Gaussian that correlates this noise.
    wave_px         : rms of slow waves at twice ``wave_from_m``, where they begin; they grow up to
                      1.5 times that. 0: none.
    edge_px         : width of the seam at a step of depth where no surface is found for sure.
    mixed_share     : share of the seam with depths in between (flying pixels), at a step of 4 px of
                      disparity; fewer at larger ones. The rest is holes.
    ragged_px       : how far borders of all kinds wander from where they belong, rms.
    band_px         : what the left edge lacks besides the disparity.
    least_signal    : reflectance times cosine of incidence that is still matched.
    speckle_share   : share of pixels that are holes for no reason.
    farthest_m      : what seems farther than this gets no depth.

    How near it sees depends on the mode, by ``MODES``.
    """

    mode: Literal["1280x720", "848x480", "640x480"] = "1280x720"
    baseline_m: float = Field(0.05, gt=0.0, le=1.0)
    subpixel_px: float = Field(0.08, ge=0.01, le=1.0)
    kernel_px: float = Field(4.0, ge=1.0, le=20.0)
    quantum_px: float = Field(1 / 32, gt=0.0, le=1 / 32)
    wave_px: float = Field(0.35, ge=0.0, le=2.0)
    wave_from_m: float = Field(2.5, gt=0.0)
    edge_px: float = Field(4.0, ge=0.0, le=WINDOW_PX - 1.0)
    mixed_share: float = Field(0.5, ge=0.0, lt=1.0)
    ragged_px: float = Field(1.5, ge=0.0, le=3.0)
    band_px: float = Field(6.0, ge=0.0, le=50.0)
    least_signal: float = Field(0.02, ge=0.0, le=1.0)
    speckle_share: float = Field(0.0003, gt=0.0, lt=0.5)
    farthest_m: float = Field(65.0, gt=0.0, le=65.535)

    @property
    def K(self) -> Array:
        """Intrinsics, (3, 3), px; pixel (0, 0) has its centre at (0, 0)."""
        mode = MODES[self.mode]
        centre = ((mode.width - 1) / 2, (mode.height - 1) / 2)
        f = mode.focal_px
        return np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])

    @property
    def focal_baseline(self) -> float:
        """f B, px m: the disparity at 1 m."""
        return MODES[self.mode].focal_px * self.baseline_m


def simulate_depth(
    scene: Scene,
    T_map_camera: Array,
    model: DepthModel,
    rng: np.random.Generator,
    time_s: float,
) -> Float32s:
    """A depth image: (H, W) float32, z in m, 0 for holes.

    T_map_camera : (4, 4), the optical frame of the left imager, from which depth is seen.
    The same generator state gives the same image, bit by bit. Raises ValueError if the pose is no
    finite (4, 4) matrix.
    """
    if T_map_camera.shape != (4, 4) or not np.isfinite(T_map_camera).all():
        raise ValueError("T_map_camera must be a finite (4, 4) matrix")
    import cv2  # noqa: PLC0415

    disparity, signal = true_disparity(scene, T_map_camera, model, time_s)
    window = np.ones((WINDOW_PX, WINDOW_PX), dtype=np.uint8)
    border = cv2.BORDER_REPLICATE
    side = (WINDOW_PX, WINDOW_PX)
    shape = disparity.shape
    noise = random_field(rng, shape, 2, model.kernel_px)
    ragged = random_field(rng, shape, 2, RAGGED_LENGTH_PX)
    waves = random_field(rng, shape, 8, WAVE_LENGTH_PX)
    return degrade(
        disparity,
        cv2.dilate(disparity, window, borderType=border),
        cv2.erode(disparity, window, borderType=border),
        cv2.blur(disparity, side, borderType=border),
        cv2.blur(signal, side, borderType=border),
        noise,
        ragged,
        waves,
        model.focal_baseline,
        _effects(model),
    )


def true_disparity(
    scene: Scene, T_map_camera: Array, model: DepthModel, time_s: float
) -> tuple[Float32s, Float32s]:
    """f B / z of each pixel without errors, and the signal that comes back; (H, W) float32.

    Disparity is 0 where there is nothing. Signal is reflectance times cosine of incidence; 0 for
    what gives no return. Cast is every fourth pixel, and those between where they don't lie on one
    plane: what is narrower than 2 px may be missed, as a matcher of blocks would.
    """
    mode, K, focal_baseline = MODES[model.mode], model.K, model.focal_baseline
    eye = Pinhole(mode.focal_px, K[0, 2], K[1, 2])
    reflectances = np.array(
        [m.reflectance if m.depth == "opaque" else 0.0 for m in scene.materials], dtype=np.float32
    )
    grid = np.mgrid[0 : mode.height + 1 : 2, 0 : mode.width + 1 : 2].astype(np.int32)
    rays = pixel_rays(grid[1].ravel(), grid[0].ravel(), T_map_camera, eye)
    hits = scene.first_hits(rays, "depth", time_s)
    seen = (hits.distance_m, hits.normals, hits.materials)
    coarse = surface(rays, *seen, reflectances, focal_baseline)
    disparity, signal, columns, rows = fill_between(
        (mode.height, mode.width), rays, hits.normals, hits.materials, *coarse
    )
    rays = pixel_rays(columns, rows, T_map_camera, eye)
    hits = scene.first_hits(rays, "depth", time_s)
    seen = (hits.distance_m, hits.normals, hits.materials)
    disparity[rows, columns], signal[rows, columns] = surface(
        rays, *seen, reflectances, focal_baseline
    )
    return disparity, signal


def to_millimetres(depth_m: Float32s) -> npt.NDArray[np.uint16]:
    """Depth as the driver publishes it (16UC1), rounded; holes stay 0."""
    return np.rint(depth_m * 1000.0).astype(np.uint16)


def random_field(
    rng: np.random.Generator, shape: tuple[int, ...], step: int, sigma_px: float
) -> Float32s:
    """Gaussian noise of variance 1, (H, W), smoothed by a Gaussian of that standard deviation.

    Drawn at every ``step``-th pixel and interpolated; with step 2 the variance is even, with more
    it is 1 on average.
    """
    import cv2  # noqa: PLC0415

    height, width = shape
    small = rng.standard_normal((-(-height // step), -(-width // step)), dtype=np.float32)
    sigma = sigma_px / step
    reach = math.ceil(3 * sigma)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    # Bilinear interpolation by a step lowers the variance by what its weights leave of it.
    neighbours = np.correlate(weights, weights, mode="full")
    power, beside = neighbours[2 * reach], neighbours[2 * reach + 1]
    offsets = (np.arange(step) + 0.5) / step - 0.5
    share = np.abs(offsets)
    left = np.mean((1 - share) ** 2 + share**2) * power + np.mean(2 * share * (1 - share)) * beside
    kernel = weights / math.sqrt(left)
    small = np.asarray(cv2.sepFilter2D(small, -1, kernel, kernel), dtype=np.float32)
    full = cv2.resize(small, (small.shape[1] * step, small.shape[0] * step))
    return np.ascontiguousarray(full[:height, :width], dtype=np.float32)


def _effects(model: DepthModel) -> Effects:
    mode = MODES[model.mode]
    quantum = model.quantum_px
    # At a step of 4 px the size of a standard normal times the step is below this so often.
    mixed = 4.0 * NormalDist().inv_cdf((1 + model.mixed_share) / 2)
    return Effects(
        noise=math.sqrt(max(model.subpixel_px**2 - quantum**2 / 12, 0.0)),
        quantum=quantum,
        wave=model.wave_px,
        wave_from=model.wave_from_m,
        edge=EDGE_PX / WINDOW_PX,
        zone=model.edge_px / WINDOW_PX / 2,
        mixed=mixed,
        band=model.band_px,
        ragged=model.ragged_px,
        per_px=1 / WINDOW_PX,
        least_signal=model.least_signal,
        speckle=NormalDist().inv_cdf(1 - model.speckle_share),
        least=model.focal_baseline / model.farthest_m,
        most=model.focal_baseline / mode.nearest_m,
    )
