"""KISS-ICP as the second front end: point-to-point ICP against a voxel map of the place around.

The registration and the voxel map are the library's (kiss-icp, through the low-level classes that
take a first guess). What stands around them is ours, since planar scans indoors differ from what
the library was made for:

* The points of its map are 5 cm apart while its voxels, beyond whose neighbours it finds no
  partner, are 50 cm wide: the library's own coupling of the two (voxel = range / 100, and 20 points
  in each) is either too coarse indoors or gives up a few centimetres off.
* The first guess is the motion model's, so odometry counts where there is some.
* ICP always returns a pose. How much of the scan lies on the map at that pose decides whether it
  is believed, and whether it is tried again from turned and shifted guesses.
* It knows one map: what a camera alone saw, lower things, takes no part beside a lidar's points.
* Points of a wall hold a scan along the wall where points of neighbouring beams happen to meet, so
  the point-to-point Hessian sees no degeneracy. The information given is that of the
  distances along the scan's normals, and the prediction holds what these leave open (Zhang, Kaess,
  Singh, ICRA 2016).

What it is worth, measured: the final maps are nearly as good as with scan matching (mean error over
the relations 0.041 m on Intel, 0.039 m on FR079) since the back end matches again, at six or seven
times the time in the front end. Single steps scatter by 10 mm and 3 mrad (median, against the final
poses of scan matching). It finds its way from a fraction of a metre only: where scans are a metre
apart it needs odometry (Intel without: 3 m).

Source: Vizzo et al., KISS-ICP: In Defense of Point-to-Point ICP, RA-L 2023.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Final

import numpy as np
from pydantic import Field

from datasets.messages import Array
from datasets.se2 import inverse, se2, transform, xyyaw
from datasets.section import Section
from frontend.match import UNOBSERVED_SIGMA_M, Match, Rejected
from frontend.matching import INFORMATION_PER_POINT, weakest_direction
from frontend.motion import Motion
from frontend.prepared import SIGMA_M, PreparedScan
from frontend.tracker import LOST, Anew, Tracked, as_it_is
from fusion.scan import CAMERA_LAYER, LIDAR_LAYER

if TYPE_CHECKING:
    from kiss_icp.pybind.kiss_icp_pybind import _Vector3dVector
    from scipy.spatial import cKDTree

FEWEST_POINTS: Final = 10
JUDGED_POINTS: Final = 400

PARTNER_M: Final = 0.15
"""Between neighbouring beams and neighbouring points of the map no partner is farther away."""
SURFACE_M: Final = 0.05
"""A point lies on the map if it is within this of its partner, along the normal."""
KERNEL_M: Final = 0.05
"""Distances from here up count less."""

GOOD_INLIER_RATIO: Final = 0.93
"""Below this share of points on the map the alignment is tried again from other places, so"""
WINDOW_M: Final = 0.5
WINDOW_RAD: Final = 0.8
"""far from the prediction."""


class KissConfig(Section):
    """KISS-ICP's few knobs, and when its result is believed."""

    voxel_m: float = Field(0.05, gt=0.0, le=1.0, description="between two points of the map")
    reach_m: float = Field(0.5, gt=0.0, le=5.0, description="partners are looked for within this")
    max_range_m: float = Field(15.0, gt=0.0, description="the map is kept, and used, within this")
    min_inlier_ratio: float = Field(0.5, gt=0.0, lt=1.0, description="below: no match")
    lost_after_scans: int = Field(5, ge=1, description="so many without a match: start anew")


@dataclass(frozen=True, slots=True)
class _Fit:
    """How a scan lies on the map at a pose."""

    T_odom_base: Array
    inlier_ratio: float
    score: float
    rms_m: float
    information: Array


class KissTracker:
    """Tracks with KISS-ICP; see Tracker."""

    def __init__(self, config: KissConfig) -> None:
        from kiss_icp.pybind import kiss_icp_pybind as kiss  # noqa: PLC0415

        self._kiss = kiss
        self._config = config
        # One thread: a parallel sum depends on who finishes first, and runs must repeat bit by bit.
        self._coarse = kiss._Registration(30, 3e-3, 1)
        self._fine = kiss._Registration(100, 1e-4, 1)
        self._T_odom_last = np.eye(3)
        self._unmatched = 0
        self._begin()

    def track(self, scan: PreparedScan, motion: Motion, anew: Anew = as_it_is) -> Tracked:
        """See Tracker. A scan is matched as it is, as in KISS-ICP, and slip is not learned."""
        T_odom_guess = self._T_odom_last @ motion.T_last_base
        usable = self._within_range(scan)
        outcome: Match | Rejected
        T_odom_base = T_odom_guess
        if len(usable) < FEWEST_POINTS:
            outcome = Rejected("too few points")
        elif self._map._empty():
            outcome = Rejected("first scan")
            self._insert(scan.sensor, usable, T_odom_base)
        else:
            outcome = self._match(scan, usable, T_odom_guess, motion)
            if isinstance(outcome, Match):
                self._unmatched = 0
                T_odom_base = outcome.T_frame_base
                if self._moved(scan.sensor, T_odom_base):
                    self._insert(scan.sensor, usable, T_odom_base)
            elif scan.sensor not in self._inserted:
                # another sensor that looks elsewhere: its map begins where the base is known to be
                self._insert(scan.sensor, usable, T_odom_base)
            else:
                outcome = self._give_up(scan.sensor, usable, T_odom_base, outcome)
        self._T_odom_last = T_odom_base
        return Tracked(scan, T_odom_base, outcome, motion)

    def _begin(self) -> None:
        """An empty map."""
        config = self._config
        # the library keeps points of one voxel apart by its width over the root of their number
        points_per_voxel = max(1, round((config.reach_m / config.voxel_m) ** 2))
        self._map = self._kiss._VoxelHashMap(config.reach_m, config.max_range_m, points_per_voxel)
        self._tree: cKDTree | None = None
        self._inserted: dict[str, Array] = {}

    def _vector(self, points_base: Array) -> _Vector3dVector:
        """(N, 2) points at z = 0, as the library takes them; it keeps z at exactly 0."""
        return self._kiss._Vector3dVector(
            np.column_stack([points_base, np.zeros(len(points_base))])
        )

    def _within_range(self, scan: PreparedScan) -> Array:
        points_base = scan.points_base[_registered(scan)]
        near = np.hypot(*points_base.T) <= self._config.max_range_m
        return points_base[near]

    def _match(
        self, scan: PreparedScan, usable: Array, T_odom_guess: Array, motion: Motion
    ) -> Match | Rejected:
        config = self._config
        source = self._kiss._voxel_down_sample(self._vector(usable), 1.5 * config.voxel_m)
        if len(source) < FEWEST_POINTS:
            return Rejected("too few points")
        best = self._fit(scan, self._align(source, T_odom_guess, motion))
        if best.inlier_ratio < GOOD_INLIER_RATIO:
            for offset in _offsets():
                again = self._fit(scan, self._align(source, T_odom_guess @ offset, motion))
                if again.inlier_ratio > best.inlier_ratio + 0.05:
                    best = again
        if best.inlier_ratio < config.min_inlier_ratio:
            return Rejected("too little of the scan lies on the map")
        x, y, yaw = xyyaw(inverse(best.T_odom_base) @ T_odom_guess)
        if (
            math.hypot(x, y) > WINDOW_M + config.reach_m + 3.0 * motion.sigma_m
            or abs(yaw) > WINDOW_RAD + 0.3 + 3.0 * motion.sigma_rad
        ):
            return Rejected("the match is too far from the prediction")
        weak_sigma_m, weak_base = weakest_direction(best.information)
        back = _held(best.information, np.array([x, y, yaw]), motion)
        if weak_sigma_m > max(UNOBSERVED_SIGMA_M, motion.sigma_m):
            # ICP slides here (the ends of what is seen pull), so the prediction is taken as it is
            back[:2] += weak_base * (weak_base @ (np.array([x, y]) - back[:2]))
        return Match(
            best.T_odom_base @ se2(*back),
            best.information,
            best.score,
            best.inlier_ratio,
            best.rms_m,
            weak_sigma_m,
            weak_base,
        )

    def _align(self, source: _Vector3dVector, T_odom_guess: Array, motion: Motion) -> Array:
        """ICP, first with a kernel as wide as the prediction is uncertain, then a narrow one."""
        wide_m = min(0.3, max(KERNEL_M, motion.sigma_m + 2.0 * motion.sigma_rad))
        T = self._coarse._align_points_to_map(
            source, self._map, _lifted(T_odom_guess), 3.0 * wide_m, wide_m
        )
        T = self._fine._align_points_to_map(source, self._map, T, 3.0 * KERNEL_M, KERNEL_M)
        return se2(T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0]))

    def _fit(self, scan: PreparedScan, T_odom_base: Array) -> _Fit:
        if self._tree is None:
            from scipy.spatial import cKDTree  # noqa: PLC0415

            points_odom = np.asarray(self._map._point_cloud())[:, :2]
            # built for some hundred questions only
            self._tree = cKDTree(points_odom, balanced_tree=False, compact_nodes=False)
        part = _registered(scan)
        every = max(1, math.ceil((part.stop - part.start) / JUDGED_POINTS))
        points, normals = scan.points_base[part][::every], scan.normals_base[part][::every]
        points_odom = transform(T_odom_base, points)
        away_m, partner = self._tree.query(points_odom, distance_upper_bound=PARTNER_M)
        has_normal = normals.any(axis=1)
        met = np.isfinite(away_m) & has_normal
        apart = (
            transform(inverse(T_odom_base), np.asarray(self._tree.data)[np.asarray(partner)[met]])
            - points[met]
        )
        along_m = np.abs(np.einsum("ij,ij->i", apart, normals[met]))
        on_map = along_m < SURFACE_M
        p, n = points[met][on_map], normals[met][on_map]
        J = np.column_stack([n, p[:, 0] * n[:, 1] - p[:, 1] * n[:, 0]])
        information = J.T @ J * (INFORMATION_PER_POINT * every / SIGMA_M**2)
        likelihood = np.exp(-(np.minimum(away_m, 1.0) ** 2) / (2.0 * SURFACE_M**2))
        return _Fit(
            T_odom_base,
            len(p) / max(1, int(has_normal.sum())),
            float(likelihood.mean()),
            math.sqrt(float(np.mean(along_m[on_map] ** 2))) if len(p) else 0.0,
            information,
        )

    def _give_up(
        self, sensor: str, usable: Array, T_odom_base: Array, outcome: Rejected
    ) -> Rejected:
        """After too many scans without a match the old map is of no use: begin a new one here."""
        self._unmatched += 1
        if self._unmatched < self._config.lost_after_scans:
            return outcome
        self._unmatched = 0
        self._begin()
        self._insert(sensor, usable, T_odom_base)
        return Rejected(LOST)

    def _moved(self, sensor: str, T_odom_base: Array) -> bool:
        T_odom_inserted = self._inserted.get(sensor)
        if T_odom_inserted is None:
            return True
        x, y, yaw = xyyaw(inverse(T_odom_inserted) @ T_odom_base)
        return math.hypot(x, y) > 0.1 or abs(yaw) > 0.1

    def _insert(self, sensor: str, usable: Array, T_odom_base: Array) -> None:
        points = self._kiss._voxel_down_sample(self._vector(usable), 0.5 * self._config.voxel_m)
        self._map._update(points, _lifted(T_odom_base))
        self._inserted[sensor] = T_odom_base
        self._tree = None


def _registered(scan: PreparedScan) -> slice:
    """The main layer's points take part; where it has none, all do."""
    return scan.part(LIDAR_LAYER if scan.main_count else CAMERA_LAYER)


def _held(information: Array, to_prediction: Array, motion: Motion) -> Array:
    """How far to go back from ICP's pose to the predicted one, (x, y, yaw) in base axes."""
    way_m, turn_rad = float(np.hypot(*to_prediction[:2])), abs(float(to_prediction[2]))
    # a prediction that the scan contradicts is trusted no more than it is off
    sigma_m, sigma_rad = max(2.0 * motion.sigma_m, way_m), max(2.0 * motion.sigma_rad, turn_rad)
    prior = np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])
    back = np.linalg.solve(information + prior, prior @ to_prediction)
    return np.asarray(back, dtype=np.float64)


def _lifted(T_a_b: Array) -> Array:
    """A planar pose as a (4, 4) one."""
    T = np.eye(4)
    T[:2, :2], T[:2, 3] = T_a_b[:2, :2], T_a_b[:2, 2]
    return T


def _offsets() -> list[Array]:
    """From where ICP, which finds its way from some 0.2 rad off, is tried again."""
    turns = math.ceil(WINDOW_RAD / 0.2)
    yaws = [sign * k * WINDOW_RAD / turns for k, sign in product(range(1, turns + 1), (1, -1))]
    shifts = [(WINDOW_M * x, WINDOW_M * y) for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    return [se2(0.0, 0.0, yaw) for yaw in yaws] + [se2(x, y, 0.0) for x, y in shifts]
