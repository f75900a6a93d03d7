"""A scan made ready for matching: turned to one moment, with a normal at each point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from datasets.messages import Array
from frontend import map_kernels
from fusion.deskew import deskew
from fusion.kernel_types import Bytes
from fusion.scan import CAMERA, CAMERA_LAYER, LIDAR_LAYER, FusedScan

SIGMA_M: Final = 0.03
"""Noise of one point against the surface, m: sensor, surface and discretisation together."""

LIDAR_SIGMA_M: Final = 0.01
"""Noise of a good lidar's range, m: SIGMA_M holds that much; what is noisier counts less."""

NORMAL_RADIUS_M: Final = (0.15, 0.2)
NORMAL_NEIGHBOURS: Final = (12, 40)
"""How far, and to how many points on each side, the line of a normal reaches, by layer. A camera's
points are noisier and denser: twelve of its columns span a few centimetres."""

CAMERA_NORMALS: Final = 3.0
"""A stereo camera's depth errs in slow waves that stay from view to view: they bend whole surfaces,
and made into texture they hold a scan where the camera was, along a wall that has none."""


@dataclass(frozen=True, slots=True)
class PreparedScan:
    """A de-skewed scan in the base frame at one moment, the middle of the turn.

    The middle, because an error of the assumed velocity moves the early beams one way and the late
    ones the other: the matched pose stays. Referred to its first beam a scan would take half the
    error on, the next velocity would answer it, and without odometry poses would swing.

    stamp_ns     : of the scan, as recorded; moment_ns : to which the points and the pose belong.
    origin_base  : (2,) m, where the sensor stands.
    points_base  : (N, 2) float64 m, as seen from the base at ``moment_ns``.
    normals_base : (N, 2) unit, towards the sensor; zero where no line fits.
    bearings_rad : (N,) of the points around ``origin_base``, ascending in each layer.
    layer        : (N,) uint8, of FusedScan; layer 0, the main one, comes first.
    weights      : (N,) in 0..1, how much a point counts beside one that a lidar measured.
    noise        : of the main layer's normals, in those of a lidar's scan.
    """

    stamp_ns: int
    moment_ns: int
    sensor: str
    origin_base: Array
    points_base: Array
    normals_base: Array
    bearings_rad: Array
    layer: Bytes
    weights: Array
    noise: float = 1.0

    @property
    def has_low(self) -> bool:
        """Whether there are points of layer 1."""
        return self.layer.size > 0 and self.layer.item(-1) > LIDAR_LAYER

    @property
    def main_count(self) -> int:
        """How many points are of the main layer; they are the first ones."""
        return int(np.searchsorted(self.layer, CAMERA_LAYER)) if self.has_low else self.layer.size

    @property
    def surface_count(self) -> int:
        """How many points of the main layer have a normal."""
        normals = self.normals_base[: self.main_count]
        return int(np.count_nonzero(normals[:, 0] + 1j * normals[:, 1]))

    @property
    def single_points(self) -> Array:
        """(M, 2) m, of the main layer: the points that have no normal, in the base frame."""
        normals = self.normals_base[: self.main_count]
        return self.points_base[: self.main_count][~normals.any(axis=1)]

    def part(self, layer: int) -> slice:
        """Where the points of a layer are."""
        split = self.main_count
        return slice(0, split) if layer == LIDAR_LAYER else slice(split, len(self.layer))


def moment_ns(scan: FusedScan) -> int:
    """The middle of the turn; the stamp itself where beam times are unknown."""
    if not scan.offsets_s.size:
        return scan.stamp_ns
    return scan.stamp_ns + int(0.5e9 * float(scan.offsets_s.min() + scan.offsets_s.max()))


def prepare(
    scan: FusedScan, velocity_base: Array, velocity_views: Array | None = None
) -> PreparedScan:
    """De-skew a scan and fit its normals, in each layer by itself.

    velocity_base : (3,) m/s, m/s, rad/s, of the base in its own frame during the scan. Each
        point is moved by the motion from the middle of the scan to its beam (constant twist).
        Without beam times nothing is moved.
    velocity_views : (3,) by which points of views were brought to the times of the beams, if that
        is another one: by the same they are brought back.
    """
    points = scan.points_base
    moment = moment_ns(scan)
    if scan.offsets_s.size and (np.any(velocity_base) or velocity_views is not None):
        since_s = scan.offsets_s - (moment - scan.stamp_ns) * 1e-9
        points = deskew(points, since_s, velocity_base)
        views = scan.source == CAMERA
        if velocity_views is not None and views.any():
            points[views] = deskew(scan.points_base[views], since_s[views], velocity_views)
    rays = points - scan.origin_base
    bearings = np.arctan2(rays[:, 1], rays[:, 0])
    weights = point_weights(scan)
    back = bearings[1:] < bearings[:-1]
    if np.count_nonzero(back) and (back & (scan.layer[1:] == scan.layer[:-1])).any():
        order = np.lexsort((bearings, scan.layer))
        points, bearings = np.ascontiguousarray(points[order]), bearings[order]
        weights = weights[order]
    normals = np.empty_like(points)
    prepared = PreparedScan(
        scan.stamp_ns,
        moment,
        scan.sensor,
        scan.origin_base,
        points,
        normals,
        bearings,
        scan.layer,
        weights,
        _noise(scan, weights),
    )
    for layer in (LIDAR_LAYER, CAMERA_LAYER) if prepared.has_low else (LIDAR_LAYER,):
        part = prepared.part(layer)
        map_kernels.estimate_normals(
            points[part],
            scan.origin_base[0],
            scan.origin_base[1],
            0.05,  # steps of this size are noise, whatever the range
            3.0 * scan.beam_spacing_rad,  # a surface at 70 deg from its normal still holds together
            NORMAL_RADIUS_M[layer],
            NORMAL_NEIGHBOURS[layer],
            normals[part],
        )
    return prepared


def point_weights(scan: FusedScan) -> Array:
    """(N,) SIGMA_M^2 over SIGMA_M^2 and what a point's variance exceeds a good lidar's by.

    1 for what the scan's own lidar measured: its noise is in SIGMA_M.
    """
    if not np.count_nonzero(scan.source):
        return np.ones(len(scan.source))
    excess_m2 = np.maximum(scan.variance_m2 - LIDAR_SIGMA_M**2, 0.0)
    own = scan.at_lidar_range
    weights: Array = np.where(own, 1.0, SIGMA_M**2 / (SIGMA_M**2 + excess_m2))
    return weights


def _noise(scan: FusedScan, weights: Array) -> float:
    """Of the main layer's normals: CAMERA_NORMALS where all is a camera's, 1 where a lidar's."""
    main = scan.layer == LIDAR_LAYER
    share = float(np.mean(scan.source[main] == CAMERA)) if main.any() else 0.0
    if share == 0.0:
        return 1.0
    return 1.0 + share * (CAMERA_NORMALS * float(np.mean(weights[main])) ** -0.5 - 1.0)
