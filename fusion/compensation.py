"""Pseudo-scans compensate a lidar's scan: what it passes over is put in, what both saw is marked.

The better mode. The gate is the paper's (section 3.3), and so is the rule that what is nearer than
the lidar's surface is an obstacle it does not see (section 3.4, Algorithm 1). What differs: each
sensor's own covariance, each beam's own time, and surfaces that are compared square to them, so
that the camera's errors make no second wall beside the lidar's. A beam that both saw keeps the
lidar's range: a view's points err alike, so that a mean betters each beam and worsens the scan.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from pydantic import Field

from datasets.messages import Array
from datasets.section import Section
from fusion.placed_points import PlacedPoints, PlacedView, place_views
from fusion.scan import BOTH, CAMERA, CAMERA_LAYER, LIDAR, LIDAR_LAYER, FusedScan
from fusion.sweep import Sweep


class CompensationConfig(Section):
    """How pseudo-scans are joined with a lidar's scan."""

    layers: bool = Field(
        True, description="what only the camera saw in a layer of its own; false: one grid"
    )
    systematic_share: float = Field(
        0.02,
        ge=0.0,
        le=0.2,
        description="ranges of the camera may be off as a whole by this share",
    )
    placing_m: float = Field(
        0.02, ge=0.0, le=0.5, description="and its points by this, for mountings and clocks"
    )


class Compensation:
    """Compensates the scans of a lidar by what cameras, or lower lidars, saw."""

    def __init__(self, config: CompensationConfig) -> None:
        self._config = config

    def fuse(self, sweep: Sweep, views: Sequence[PlacedView], velocity_base: Array) -> FusedScan:
        """The lidar's turn with the points of the views in it.

        velocity_base : (3,) m/s, m/s, rad/s, of the base in its own frame during the turn.

        A beam with points of a view near enough to the lidar's surface (11), (12) is of both
        (BOTH). Farther points are left out, nearer ones are points of their own (CAMERA) unless
        the errors of the view could have put them there, and so are those where the lidar has no
        return. In one grid (``layers`` off) a nearer point replaces the beams it hides.
        """
        if not sweep.bearings_rad.size:
            return sweep.returns()
        found = place_views(sweep, views, velocity_base, self._config.systematic_share)
        if not found.beams.size:
            return sweep.returns()
        return _Association(sweep, found, self._config).fused()


class _Association:
    """What became of the points of the views of one turn."""

    def __init__(self, sweep: Sweep, found: PlacedPoints, config: CompensationConfig) -> None:
        from fusion import compensation_kernels as kernels  # noqa: PLC0415
        from fusion.sweep_kernels import join_beams  # noqa: PLC0415

        self._sweep, self._found, self._config = sweep, found, config
        count, beams = found.beams.size, sweep.bearings_rad.size
        self._beams = found.beams.copy()
        joined = np.empty(beams, dtype=np.uint8)
        verdicts = np.empty(count, dtype=np.uint8)
        self._variances, self._seen = np.empty((2, count))
        variance = sweep.variance_m2
        join_beams(
            sweep.ranges_m,
            sweep.bearings_rad,
            sweep.points_base,
            sweep.offsets_s,
            variance,
            sweep.spacing_rad,
            joined,
        )
        kernels.associate(
            found.points_base,
            found.rays_base,
            found.sigma_m,
            found.systematic_m,
            found.widths_m / np.sqrt(12.0),  # even within the bin
            self._beams,
            sweep.origin_base,
            sweep.ranges_m,
            sweep.bearings_rad,
            sweep.points_base,
            variance,
            sweep.spacing_rad,
            joined,
            config.placing_m,
            verdicts,
            self._variances,
            self._seen,
        )
        self._both = verdicts == kernels.ASSOCIATED
        self._added = (verdicts == kernels.OWN) | (verdicts == kernels.FILLED)

    def fused(self) -> FusedScan:
        sweep, found = self._sweep, self._found
        source = np.full(sweep.ranges_m.size, LIDAR, dtype=np.uint8)
        source[self._beams[self._both]] = BOTH
        kept = np.isfinite(sweep.ranges_m)
        if not self._config.layers:
            kept &= ~self._hidden()
        added = np.flatnonzero(self._added)
        bearings = np.concatenate([sweep.bearings_rad[kept], found.bearings_rad[added]])
        layer = np.full(bearings.size, LIDAR_LAYER, dtype=np.uint8)
        if self._config.layers:
            layer[bearings.size - added.size :] = CAMERA_LAYER
        order = np.lexsort((bearings, layer))

        def joined(of_beams: Array, of_points: Array) -> Array:
            both: Array = np.concatenate([of_beams[kept], of_points[added]])[order]
            return both

        times = sweep.offsets_s
        sources = np.concatenate([source[kept], np.full(added.size, CAMERA, dtype=np.uint8)])
        return FusedScan(
            sweep.stamp_ns,
            sweep.sensor,
            sweep.origin_base,
            joined(sweep.points_base, found.points_base),
            joined(times, found.times_s) if times.size else times,
            sources[order],
            sweep.spacing_rad,
            layer[order],
            joined(sweep.variance_m2, self._variances),
            joined(sweep.ranges_m, self._seen),
            joined(self._camera_ranges(), found.ranges_m),
        )

    def _camera_ranges(self) -> Array:
        """The nearest range that a view has in the direction of each beam; NaN where none."""
        nearest = np.full(self._sweep.ranges_m.size, np.inf)
        near = self._beams >= 0
        np.minimum.at(nearest, self._beams[near], self._found.ranges_m[near])
        return np.where(np.isfinite(nearest), nearest, np.nan)

    def _hidden(self) -> npt.NDArray[np.bool_]:
        """Beams that pass over an added point, within its bin or their own spacing: (N,)."""
        from fusion.compensation_kernels import hide_beams  # noqa: PLC0415

        sweep, found = self._sweep, self._found
        covered = found.widths_m / np.maximum(found.ranges_m, 1e-3)
        hidden = np.empty(sweep.ranges_m.size, dtype=np.uint8)
        hide_beams(
            sweep.ranges_m,
            sweep.bearings_rad,
            found.ranges_m[self._added],
            found.bearings_rad[self._added],
            0.5 * np.maximum(sweep.spacing_rad, covered)[self._added],
            hidden,
        )
        return hidden.astype(np.bool_)
