"""Pseudo-scans compensate a lidar's scan: what it passes over is put in, what both saw averaged.

The better mode. The gate is the paper's (section 3.3), and so is the rule that what is nearer than
the lidar's surface is an obstacle it does not see (section 3.4, Algorithm 1). What differs: each
sensor's own covariance, each beam's own time, averages in place of minima, and surfaces that
are compared square to them, so that the camera's errors make no second wall beside the lidar's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from datasets.messages import Array
from datasets.se2 import transform
from datasets.section import Section
from fusion.pseudo_scan import PseudoScan
from fusion.scan import BOTH, CAMERA, CAMERA_LAYER, LIDAR, LIDAR_LAYER, Bytes, FusedScan
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


@dataclass(frozen=True, slots=True)
class PlacedView:
    """A pseudo-scan, and where the base was when it was taken.

    T_base_view : (3, 3), of the base at the view's stamp, in the base frame at the middle of the
                  lidar's turn (``Sweep.moment_ns``).
    """

    pseudo: PseudoScan
    T_base_view: Array

    def __post_init__(self) -> None:
        if self.T_base_view.shape != (3, 3) or not np.isfinite(self.T_base_view).all():
            raise ValueError("T_base_view must be a finite (3, 3) matrix")


@dataclass(slots=True)
class _Points:
    """Points of views at the time of the lidar's beam in their direction; (M,) each.

    points, rays : (M, 2) base frame; spacing_m : width of the bin at the point.
    """

    points: Array
    rays: Array
    ranges_m: Array
    sigma_m: Array
    spacing_m: Array

    @classmethod
    def of(cls, views: Sequence[PlacedView]) -> _Points:
        """In the base frame at the middle of the lidar's turn."""
        points, rays, ranges, sigmas, widths = [np.empty((0, 2))], [np.empty((0, 2))], [], [], []
        for view in views:
            pseudo, T = view.pseudo, view.T_base_view
            hit = np.isfinite(pseudo.ranges_m)
            bearings, lengths = pseudo.bearings_rad[hit], pseudo.ranges_m[hit]
            directions = np.column_stack([np.cos(bearings), np.sin(bearings)])
            points.append(transform(T, pseudo.origin_base + directions * lengths[:, None]))
            rays.append(directions @ T[:2, :2].T)
            ranges.append(lengths)
            sigmas.append(pseudo.sigma_m[hit])
            widths.append(pseudo.spacing_rad * lengths)
        flat = [np.concatenate([np.empty(0), *each]) for each in (ranges, sigmas, widths)]
        return cls(np.concatenate(points), np.concatenate(rays), *flat)


class Compensation:
    """Compensates the scans of a lidar by what cameras, or lower lidars, saw."""

    def __init__(self, config: CompensationConfig) -> None:
        self._config = config

    def fuse(self, sweep: Sweep, views: Sequence[PlacedView], velocity_base: Array) -> FusedScan:
        """The lidar's turn with the points of the views in it.

        velocity_base : (3,) m/s, m/s, rad/s, of the base in its own frame during the turn.

        Points of a view near enough to the lidar's surface (11), (12) move the beam to the mean
        weighted by inverse variances (BOTH). Farther ones are left out, nearer ones are points of
        their own (CAMERA) unless the errors of the view could have put them there, and so are
        those where the lidar has no return. In one grid (``layers`` off) a nearer point replaces
        the beams it hides.
        """
        found = _Points.of(views)
        if not len(found.points) or not sweep.bearings_rad.size:
            return sweep.returns()
        return _Association(sweep, found, velocity_base, self._config).fused()


class _Association:
    """What became of the points of the views of one turn."""

    def __init__(
        self, sweep: Sweep, found: _Points, velocity_base: Array, config: CompensationConfig
    ) -> None:
        from fusion import compensation_kernels as kernels  # noqa: PLC0415
        from fusion.sweep_kernels import join_beams  # noqa: PLC0415

        self._sweep, self._found, self._config = sweep, found, config
        count, beams = len(found.points), sweep.bearings_rad.size
        self._beams = np.empty(count, dtype=np.int64)
        self._times = np.zeros(count)
        joined = np.empty(beams, dtype=np.uint8)
        verdicts = np.empty(count, dtype=np.uint8)
        self._taus, self._variances, self._seen = np.empty((3, count))
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
        kernels.place_points(
            found.points,
            found.rays,
            sweep.middle_s,
            velocity_base,
            sweep.origin_base,
            sweep.bearings_rad,
            sweep.offsets_s,
            sweep.spacing_rad,
            self._beams,
            self._times,
        )
        kernels.associate(
            found.points,
            found.rays,
            found.sigma_m,
            found.ranges_m,
            found.spacing_m / np.sqrt(12.0),  # even within the bin
            self._beams,
            sweep.origin_base,
            sweep.ranges_m,
            sweep.bearings_rad,
            sweep.points_base,
            variance,
            sweep.spacing_rad,
            joined,
            config.systematic_share,
            config.placing_m,
            verdicts,
            self._taus,
            self._variances,
            self._seen,
        )
        self._both = verdicts == kernels.ASSOCIATED
        self._added = (verdicts == kernels.OWN) | (verdicts == kernels.FILLED)
        rays = found.points - sweep.origin_base
        self._ranges = np.hypot(rays[:, 0], rays[:, 1])
        self._bearings = np.arctan2(rays[:, 1], rays[:, 0])

    def fused(self) -> FusedScan:
        sweep = self._sweep
        ranges, variance, source = self._averaged()
        kept = np.isfinite(sweep.ranges_m)
        if not self._config.layers:
            kept &= ~self._hidden()
        moved = sweep.points_base.copy()
        changed = source == BOTH
        rays = moved[changed] - sweep.origin_base
        scale = ranges[changed] / sweep.ranges_m[changed]
        moved[changed] = sweep.origin_base + rays * scale[:, None]

        added = np.flatnonzero(self._added)
        bearings = np.concatenate([sweep.bearings_rad[kept], self._bearings[added]])
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
            joined(moved, self._found.points),
            joined(times, self._times) if times.size else times,
            sources[order],
            sweep.spacing_rad,
            layer[order],
            joined(variance, self._variances),
            joined(sweep.ranges_m, self._seen),
            joined(self._camera_ranges(), self._ranges),
        )

    def _averaged(self) -> tuple[Array, Array, Bytes]:
        """Range, variance and source of each beam, averaged with the points associated with it.

        Points of neighbouring bins err together: several in one beam are averaged, but the
        variance of their mean is taken as that of the best of them.
        """
        sweep, at = self._sweep, self._beams[self._both]
        count = sweep.ranges_m.size
        weights = 1.0 / self._variances[self._both]
        total = np.bincount(at, weights, count)
        tau = np.bincount(at, weights * self._taus[self._both], count)
        best = np.full(count, np.inf)
        np.minimum.at(best, at, self._variances[self._both])
        seen = total > 0.0
        source = np.where(seen, BOTH, LIDAR).astype(np.uint8)
        ranges, variance = sweep.ranges_m.copy(), sweep.variance_m2.copy()
        share = variance[seen] / (variance[seen] + best[seen])
        ranges[seen] -= share * tau[seen] / total[seen]
        variance[seen] *= 1.0 - share
        return ranges, variance, source

    def _camera_ranges(self) -> Array:
        """The nearest range that a view has in the direction of each beam; NaN where none."""
        nearest = np.full(self._sweep.ranges_m.size, np.inf)
        near = self._beams >= 0
        np.minimum.at(nearest, self._beams[near], self._ranges[near])
        return np.where(np.isfinite(nearest), nearest, np.nan)

    def _hidden(self) -> npt.NDArray[np.bool_]:
        """Beams that pass over an added point, within its bin or their own spacing: (N,)."""
        sweep = self._sweep
        hidden = np.zeros(sweep.ranges_m.size, dtype=np.bool_)
        half = 0.5 * np.maximum(
            sweep.spacing_rad, self._found.spacing_m / np.maximum(self._ranges, 1e-3)
        )
        for point in np.flatnonzero(self._added):
            for turn in (-2.0 * np.pi, 0.0, 2.0 * np.pi):
                middle = self._bearings[point] + turn
                first, last = np.searchsorted(
                    sweep.bearings_rad, [middle - half[point], middle + half[point]]
                )
                hidden[first:last] |= sweep.ranges_m[first:last] > self._ranges[point]
        return hidden
