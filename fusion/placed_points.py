"""The points of views of other sensors, brought into a lidar's turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.se2 import transform
from fusion.pseudo_scan import PseudoScan
from fusion.sweep import Sweep


@dataclass(frozen=True, slots=True)
class PlacedView:
    """A pseudo-scan, and where the base was when it was taken.

    T_base_view : (3, 3), of the base at the view's stamp, in the base frame at the middle of the
                  lidar's turn (``Sweep.moment_ns``).
    systematic_share : of all its ranges, by which they may be off as a whole; None: what the
                  configuration says of cameras.
    """

    pseudo: PseudoScan
    T_base_view: Array
    systematic_share: float | None = None

    def __post_init__(self) -> None:
        if self.T_base_view.shape != (3, 3) or not np.isfinite(self.T_base_view).all():
            raise ValueError("T_base_view must be a finite (3, 3) matrix")


@dataclass(frozen=True, slots=True)
class PlacedPoints:
    """M points of views, each at the time of the lidar's beam of its bearing.

    points_base, rays_base : (M, 2) m, and the unit directions that the view saw them in; in the
               base frame of that time.
    sigma_m, systematic_m, widths_m : (M,) standard deviation of the range that the view's own
               sensor measured, by how much it may be off besides, and the width of its bin there.
    beams    : (M,) the nearest beam by bearing; -1 where none is within a spacing.
    times_s  : (M,) from the sweep's stamp; 0 where the beams' times are unknown.
    ranges_m, bearings_rad : (M,) around the lidar.
    """

    points_base: Array
    rays_base: Array
    sigma_m: Array
    systematic_m: Array
    widths_m: Array
    beams: npt.NDArray[np.int64]
    times_s: Array
    ranges_m: Array
    bearings_rad: Array


def place_views(
    sweep: Sweep, views: Sequence[PlacedView], velocity_base: Array, systematic_share: float
) -> PlacedPoints:
    """The ends of all finite ranges of the views; the sweep has one beam or more.

    velocity_base    : (3,) m/s, m/s, rad/s, of the base in its own frame during the turn.
    systematic_share : of views that don't say their own.
    """
    from fusion.compensation_kernels import place_points  # noqa: PLC0415

    points, rays = [np.empty((0, 2))], [np.empty((0, 2))]
    numbers = [np.empty((3, 0))]
    for view in views:
        pseudo, T = view.pseudo, view.T_base_view
        hit = np.isfinite(pseudo.ranges_m)
        bearings, lengths = pseudo.bearings_rad[hit], pseudo.ranges_m[hit]
        directions = np.column_stack([np.cos(bearings), np.sin(bearings)])
        points.append(transform(T, pseudo.origin_base + directions * lengths[:, None]))
        rays.append(directions @ T[:2, :2].T)
        share = systematic_share if view.systematic_share is None else view.systematic_share
        widths = pseudo.spacing_rad * lengths
        numbers.append(np.stack([pseudo.sigma_m[hit], share * lengths, widths]))
    points_base, rays_base = np.concatenate(points), np.concatenate(rays)
    sigmas, systematic, widths = np.concatenate(numbers, axis=1)
    beams = np.empty(len(points_base), dtype=np.int64)
    times_s = np.zeros(len(points_base))
    place_points(
        points_base,
        rays_base,
        sweep.middle_s,
        velocity_base,
        sweep.origin_base,
        sweep.bearings_rad,
        sweep.offsets_s,
        sweep.spacing_rad,
        beams,
        times_s,
    )
    seen = points_base - sweep.origin_base
    return PlacedPoints(
        points_base,
        rays_base,
        sigmas,
        systematic,
        widths,
        beams,
        times_s,
        np.hypot(seen[:, 0], seen[:, 1]),
        np.arctan2(seen[:, 1], seen[:, 0]),
    )
