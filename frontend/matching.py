"""Scan to map: correlative search where the prior is weak, then Gauss-Newton on the surface."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from datasets.messages import Array
from datasets.se2 import se2, xyyaw
from frontend.kernel_types import Cloud
from frontend.local_map import CELL_M, NO_CLOUD, NO_POINTS, LocalMap
from frontend.match import Match, Rejected
from frontend.prepared import SIGMA_M, PreparedScan
from fusion.scan import CAMERA_LAYER, LIDAR_LAYER

INFORMATION_PER_POINT: Final = 0.1
"""Neighbouring points err together (normals, mixed pixels, the same map point), and what all scans
of a place have wrong in common no residual shows: ten points count as one. This is cautious:
after the final passes the pairs' chi^2 is some 0.03 of what is expected on the recordings."""

NORMAL_SIGMA_RAD: Final = 0.03
"""Noise of a normal."""

LOW_COMMON_INFORMATION: Final = np.array([0.02**-2, 0.02**-2, 0.01**-2])
"""Of the displacement (x m, y m, yaw rad) that all points of a camera share: its mounting and
the scale of its depth err by more than its noise. So what it sees holds a pose where nothing else
does, and pulls by a millimetre or two where a lidar sees enough."""

APART_M: Final = 0.6
APART_RAD: Final = 0.3
"""Two poses less than both apart are one place."""

SEARCH_POINTS: Final = 120
ALIGN_POINTS: Final = 400
ALIGN_LOW_POINTS: Final = 200


def yaw_step_rad(points_base: Array) -> float:
    """The turn that moves the far points of a scan by about one cell (Olson 2009)."""
    if not len(points_base):
        return 0.02
    ranges_m = np.hypot(points_base[:, 0], points_base[:, 1])
    far = int(0.9 * (len(ranges_m) - 1))
    reach_m = float(np.partition(ranges_m, far)[far])
    return min(0.02, max(0.005, CELL_M / max(reach_m, 0.5)))


def thinned(rows: Array, most: int) -> Array:
    """Every k-th row, so that no more than about ``most`` are left."""
    return np.ascontiguousarray(rows[:: max(1, math.ceil(len(rows) / most))])


def match_correlative(
    scan: PreparedScan,
    local_map: LocalMap,
    T_frame_base_guess: Array,
    window_m: float,
    window_rad: float,
    penalty: tuple[float, float],
    min_score: float = 0.0,
    avoid: Array | None = None,
) -> tuple[Array, float] | Rejected:
    """Find the pose in a window around a guess that lays a scan best on the map's field.

    Of the main layer: no low points take part.

    penalty : loss of score for 1 m^2 and 1 rad^2 away from the guess.
    min_score : what scores less is not looked for, which makes the search short.
    avoid : (3, 3), a pose that is known already: another one is looked for, ``APART_M`` and
        ``APART_RAD`` from it.

    Returns T_frame_base (3, 3) to within a cell and a yaw step, and its penalised score.
    Source: Olson, Real-Time Correlative Scan Matching, ICRA 2009.
    """
    points = thinned(scan.points_base[scan.part(LIDAR_LAYER)], SEARCH_POINTS)
    found, x, y, yaw, score, _ = local_map.search(
        points,
        xyyaw(T_frame_base_guess),
        window_m,
        window_rad,
        yaw_step_rad(points),
        penalty,
        min_score,
        2_000_000,
        None if avoid is None else (*xyyaw(avoid), APART_M, APART_RAD),
    )
    if not found:
        return Rejected("nothing of the scan lies on the map")
    return se2(x, y, yaw), score


def match_surface(
    scan: PreparedScan,
    local_map: LocalMap,
    T_frame_base_start: Array,
    T_frame_base_expected: Array,
    expected_sigma: tuple[float, float],
    robust_m: tuple[float, float] = (0.2, 0.04),
) -> Match | Rejected:
    """Align a scan to the surfaces of the map, held by a prior where the map does not hold it.

    T_frame_base_start    : where the iteration begins, within some 0.2 m and 10 deg.
    T_frame_base_expected : the prior's mean, with expected_sigma = (m, rad).

    The prior enters the pose, not the information of the Match. Low points enter both, as far as
    they meet low things that the map knows, but may not move the pose by more than
    expected_sigma; score, inliers and rms are of the main layer, and a scan without points there
    has no match.
    """
    (points, normals, weights), every = _cloud(scan, LIDAR_LAYER, ALIGN_POINTS)
    low_cloud, low_every = NO_CLOUD, 1
    if scan.has_low:
        low_cloud, low_every = _cloud(scan, CAMERA_LAYER, ALIGN_LOW_POINTS)
    if np.count_nonzero(normals[:, 0] + 1j * normals[:, 1]) < 10:
        return Rejected("too few points on surfaces")
    start, expected = np.array(xyyaw(T_frame_base_start)), np.array(xyyaw(T_frame_base_expected))
    turn = start[2] - expected[2]
    expected[2] = start[2] - math.atan2(math.sin(turn), math.cos(turn))
    sigma_m, sigma_rad = expected_sigma
    xy, tt = sigma_m**-2, sigma_rad**-2
    prior = np.array([[xy, 0.0, 0.0], [0.0, xy, 0.0], [0.0, 0.0, tt]])
    cloud, common = (points, normals, weights), LOW_COMMON_INFORMATION
    single = NO_POINTS
    if local_map.has_single:
        single = thinned(scan.single_points, ALIGN_POINTS)
    how = (single, common, start, expected, prior, robust_m, SIGMA_M, 12)
    found = local_map.align(cloud, low_cloud, *how)
    if scan.has_low and math.dist(found.pose[:2], expected[:2]) > sigma_m:
        # low things that move don't contradict the walls of a corridor, but the prediction
        without = local_map.align(cloud, NO_CLOUD, *how)
        if math.dist(found.pose[:2], without.pose[:2]) > sigma_m:
            found = without
    if found.matched < 10 or found.iterations == 0:
        return Rejected("too little of the scan lies on the map")
    pose, weight, low_weight = found.pose, found.weight, found.low_weight
    main, low = (to_base_axes(H, pose[2]) for H in (found.information, found.low_information))
    believed = main + sharing(low, common) if low_weight > 0.0 else main
    if weakest_direction(believed)[0] ** -2 < 20.0 * _wavering(weight, scan.noise):
        # elsewhere it would take off next to nothing
        main, low = observed(main, weight, scan.noise), observed(low, low_weight)
        pose = _let_go(pose, expected, believed, main + sharing(low, common))
    T_frame_base = se2(*pose)
    information = main * (INFORMATION_PER_POINT * every)
    if low_weight > 0.0:
        information += sharing(low * (INFORMATION_PER_POINT * low_every), common)
    weak_sigma_m, weak_base = weakest_direction(information)
    return Match(
        T_frame_base,
        information,
        local_map.score(points, T_frame_base),
        weight / found.usable,
        found.rms_m,
        weak_sigma_m,
        weak_base,
    )


def _cloud(scan: PreparedScan, layer: int, most: int) -> tuple[Cloud, int]:
    """A layer's points, thinned to about ``most``, and of how many points each one is one."""
    part = scan.part(layer)
    every = max(1, math.ceil((part.stop - part.start) / most))
    kept = slice(part.start, part.stop, every)
    cloud = (
        np.ascontiguousarray(scan.points_base[kept]),
        np.ascontiguousarray(scan.normals_base[kept]),
        np.ascontiguousarray(scan.weights[kept]),
    )
    return cloud, every


def sharing(information: Array, common: Array) -> Array:
    """Information (3, 3) of points that all share an error with information diag(common) (3,)."""
    P = np.diag(common)
    shared: Array = P - P @ np.linalg.solve(information + P, P)
    return shared


def to_base_axes(information_frame: Array, yaw_rad: float) -> Array:
    """Information of (x, y, yaw) in a frame's axes, in those of a base turned by yaw in it."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned: Array = R.T @ information_frame @ R
    return turned


def observed(information: Array, weight: Array | float, noise: Array | float = 1.0) -> Array:
    """Information (..., 3, 3) less what the noise of normals makes believe along bare walls.

    weight : (...) sum of the points' weights; noise : (...) of PreparedScan. Normals that err by
    NORMAL_SIGMA_RAD times the noise give each point some information along its wall; it is taken
    off, down to none.
    """
    floor = np.asarray(_wavering(weight, noise))
    less = information - floor[..., None, None] * np.diag([1.0, 1.0, 0.0])
    values, vectors = np.linalg.eigh(less)
    kept: Array = (vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return kept


def _wavering(weight: Array | float, noise: Array | float) -> Array | float:
    """What the noise of normals adds to the information along bare walls, 1/m^2."""
    return weight * (NORMAL_SIGMA_RAD * noise / SIGMA_M) ** 2


def _let_go(pose: Array, expected: Array, believed: Array, seen: Array) -> Array:
    """A pose taken back to what was expected, where only the noise of normals held it off.

    pose, expected : (3,) x, y, yaw. believed, seen : (3, 3) information in base axes, as it went
    into the pose and as ``observed``. Along a bare wall wavering normals hold a scan where the last
    ones were, and corridors become short: there the pose moves along the weakest direction by the
    share that was not seen. (Zhang, Kaess, Singh, ICRA 2016: no update along what is degenerate.)
    """
    sigma_m, weak_base = weakest_direction(believed)
    share = min(1.0, (sigma_m / weakest_direction(seen)[0]) ** 2)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    weak = np.array([c * weak_base[0] - s * weak_base[1], s * weak_base[0] + c * weak_base[1]])
    back = pose.copy()
    back[:2] -= (1.0 - share) * float(weak @ (pose[:2] - expected[:2])) * weak
    return back


def weakest_direction(information: Array) -> tuple[float, Array]:
    """Standard deviation and unit direction in which a position is least known, yaw left free.

    The eigenvector of the smallest eigenvalue of the position's information with yaw marginalised
    out (Zhang, Kaess, Singh, ICRA 2016, judge degeneracy by the same eigenvalues).
    """
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = information.tolist()
    if tt > 0.0:
        xx, xy, yy = xx - xt * xt / tt, xy - xt * yt / tt, yy - yt * yt / tt
    # eigenvalues and the angle of the larger one's vector, of a symmetric 2 x 2 matrix
    half, root = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy) + 0.5 * math.pi
    weak = np.array([math.cos(angle), math.sin(angle)])
    return 1.0 / math.sqrt(max(half - root, 1e-6)), weak
