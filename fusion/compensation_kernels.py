"""The loops of the compensation: points of a view against the beams of a lidar's turn."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fusion.kernel_types import Bytes, Floats, Ints
from fusion.sweep_kernels import nearest_beam, surface_normal

ASSOCIATED = 0
"""What became of a view's point: a beam of the lidar saw the same,"""
SAME = 1
"""it is no obstacle of its own, for the lidar's surface is as near as errors reach,"""
OWN = 2
"""it is nearer than anything the lidar saw,"""
FILLED = 3
"""it stands where the lidar has no return,"""
FARTHER = 4
"""or it is farther than the lidar's surface."""

GAMMA2 = 3.84
"""Gate of the association, 95 % at one degree of freedom (paper, section 3.3)."""
APART_SIGMAS = 3.0
"""So many sigmas, and the systematic error, a point must lie off a surface not to belong to it."""
LEAST_COSINE = 0.05
PLACING_TURNS = 4


@njit(cache=True)
def place_points(
    points: Floats,
    rays: Floats,
    middle_s: float,
    velocity: Floats,
    origin: Floats,
    bearings: Floats,
    offsets: Floats,
    spacing: float,
    beams: Ints,
    times: Floats,
) -> None:
    """Bring points to the time of the lidar beam of their bearing.

    points (M, 2), rays (M, 2) in and out: the points, and the directions they were seen in, from
    the base frame at the middle of the turn to the base frame at the beam's time.
    beams (M,) out: the nearest beam by bearing, -1 where none is within a spacing.
    times (M,) out: of the nearest beam, to a beam or so; untouched if beam times are unknown.
    The base moves with a constant twist, velocity (3,). Cost: M log N.
    """
    for m in range(points.shape[0]):
        x, y = points[m, 0], points[m, 1]
        ux, uy = rays[m, 0], rays[m, 1]
        time = middle_s
        k = -1
        for left in range(PLACING_TURNS, 0, -1):
            dt = time - middle_s
            turn = velocity[2] * dt
            half = 0.5 * turn  # the chord of an arc lies at half the turn
            along, across = math.cos(half) * dt, math.sin(half) * dt
            px = x - (along * velocity[0] - across * velocity[1])
            py = y - (across * velocity[0] + along * velocity[1])
            c, s = math.cos(turn), math.sin(turn)
            points[m, 0], points[m, 1] = c * px + s * py, c * py - s * px
            rays[m, 0], rays[m, 1] = c * ux + s * uy, c * uy - s * ux
            bearing = math.atan2(points[m, 1] - origin[1], points[m, 0] - origin[0])
            k = nearest_beam(bearing, bearings)
            if not offsets.size:
                break
            times[m] = time
            if offsets[k] == time or left == 1:
                break
            time = offsets[k]
        off = math.atan2(points[m, 1] - origin[1], points[m, 0] - origin[0]) - bearings[k]
        off = abs((off + math.pi) % (2.0 * math.pi) - math.pi)
        beams[m] = k if off <= spacing else -1


@njit(cache=True)
def associate(
    points: Floats,
    rays: Floats,
    sigmas: Floats,
    systematic: Floats,
    lateral: Floats,
    beams: Ints,
    origin: Floats,
    lidar_ranges: Floats,
    bearings: Floats,
    lidar_points: Floats,
    lidar_variances: Floats,
    spacing: float,
    joined: Bytes,
    placing_m: float,
    verdicts: Bytes,
    variances: Floats,
    seen: Floats,
) -> None:
    """Compare points of a view with the surfaces of the lidar (paper, section 3.3).

    points, rays (M, 2): base frame at the time of the beam, see ``place_points``.
    sigmas, systematic, lateral (M,): errors along the view's own ray, at random and as a whole, and
    errors across it. The point's variance along a unit vector n is
        (sigma^2 + (systematic / 2)^2) (n.u)^2 + lateral^2 (1 - (n.u)^2) + placing^2,
    u the view's ray: the systematic error is taken as two sigmas of a random one.
    verdicts (M,) out. variances (M,) out: of the point's range along the lidar's ray.
    seen (M,) out: the lidar's range in this direction, NaN where it has none, or ASSOCIATED.
    beams (M,) in and out: the beam associated with.
    D^2 = tau^2 / (sigma_L^2 + sigma_C^2) (11), tau the lidar's range minus the point's at the
    same bearing (12), is taken square to the surface, which is the same if both look along one
    ray, and bears errors of bearing and mounting where the ray grazes.
    """
    for m in range(points.shape[0]):
        x, y = points[m, 0] - origin[0], points[m, 1] - origin[1]
        r = max(math.sqrt(x * x + y * y), 1e-6)
        bearing = math.atan2(y, x)
        along2 = sigmas[m] * sigmas[m] + 0.25 * systematic[m] * systematic[m]
        across2 = lateral[m] * lateral[m]
        ux, uy = x / r, y / r
        cc = ux * rays[m, 0] + uy * rays[m, 1]
        variances[m] = along2 * cc * cc + across2 * (1.0 - cc * cc) + placing_m * placing_m
        seen[m] = np.nan
        k = beams[m]
        if k < 0:
            verdicts[m] = FILLED
            continue
        best = np.inf
        nearest = np.inf
        home_seen = np.nan
        low, high = _around(bearing, k, bearings)
        other = k if joined[low] == 1 else low + high - k
        for candidate in (k, other):
            away = abs((bearing - bearings[candidate] + math.pi) % (2.0 * math.pi) - math.pi)
            if not math.isfinite(lidar_ranges[candidate]) or away > spacing:
                continue
            nx, ny, fitted = surface_normal(candidate, lidar_points, joined, origin)
            met = _meets(candidate, low, high, ux, uy, nx, ny, fitted, origin, lidar_points, joined)
            tau = met - r
            cl = max(LEAST_COSINE, abs(nx * ux + ny * uy))
            cc = nx * rays[m, 0] + ny * rays[m, 1]
            camera2 = along2 * cc * cc + across2 * (1.0 - cc * cc) + placing_m * placing_m
            d2 = (tau * cl) ** 2 / (lidar_variances[candidate] * cl * cl + camera2)
            nearest = min(nearest, met)
            if candidate == k:
                home_seen = met
            if d2 < best:
                best = d2
                if d2 < GAMMA2:
                    beams[m] = candidate
        if best < GAMMA2:
            verdicts[m] = ASSOCIATED
            continue
        seen[m] = home_seen
        if not math.isfinite(lidar_ranges[k]):
            verdicts[m] = FILLED
        elif r > nearest:
            verdicts[m] = FARTHER
        elif _belongs(
            x + origin[0],
            y + origin[1],
            rays[m, 0],
            rays[m, 1],
            sigmas[m],
            across2,
            systematic[m],
            placing_m,
            k,
            r,
            lidar_points,
            lidar_variances,
            spacing,
            joined,
        ):
            verdicts[m] = SAME
        else:
            verdicts[m] = OWN


@njit(cache=True)
def _around(bearing: float, k: int, bearings: Floats) -> tuple[int, int]:
    """The beams on either side of a bearing whose nearest beam is k."""
    count = bearings.size
    off = (bearing - bearings[k] + math.pi) % (2.0 * math.pi) - math.pi
    if off >= 0.0:
        return k, (k + 1) % count
    return (k - 1) % count, k


@njit(cache=True)
def _meets(
    k: int,
    low: int,
    high: int,
    ux: float,
    uy: float,
    nx: float,
    ny: float,
    fitted: int,
    origin: Floats,
    points: Floats,
    joined: Bytes,
) -> float:
    """Range at which the ray (ux, uy) meets the surface of beam k.

    Between two beams of one surface that is their chord; beside an edge the line fitted to the
    surface, or the beam's own range where there is no line.
    """
    kx, ky = points[k, 0] - origin[0], points[k, 1] - origin[1]
    own = math.sqrt(kx * kx + ky * ky)
    if low != high and joined[low] == 1:
        ax, ay = points[low, 0] - origin[0], points[low, 1] - origin[1]
        dx, dy = points[high, 0] - points[low, 0], points[high, 1] - points[low, 1]
        cross = ux * dy - uy * dx
        if cross > 0.0:
            return (ax * dy - ay * dx) / cross
    across = nx * ux + ny * uy
    if fitted < 3 or abs(across) < LEAST_COSINE:
        return own
    met = (nx * kx + ny * ky) / across
    return met if 0.5 * own < met < 2.0 * own else own


@njit(cache=True)
def _belongs(
    x: float,
    y: float,
    ray_x: float,
    ray_y: float,
    sigma: float,
    across2: float,
    systematic: float,
    placing: float,
    k: int,
    r: float,
    points: Floats,
    variances: Floats,
    spacing: float,
    joined: Bytes,
) -> bool:
    """Whether a point lies as near to what the lidar saw as errors reach.

    The distance is the shortest one to the chain of the lidar's points, joined where they are of
    one surface; the errors are those along it. Looked at are beams in reach of the largest error.
    """
    count = points.shape[0]
    furthest = APART_SIGMAS * math.sqrt(sigma * sigma + across2 + placing * placing) + systematic
    reach = min(furthest / max(r, 1e-3), 1.0)
    beams = min(int(math.asin(reach) / max(spacing, 1e-6)) + 2, count // 2)
    for step in range(-beams, beams):
        a = (k + step) % count
        if not math.isfinite(points[a, 0]):
            continue
        dx, dy = points[a, 0] - x, points[a, 1] - y
        b = (a + 1) % count
        if joined[a] == 1:
            ex, ey = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            length2 = ex * ex + ey * ey
            if length2 > 0.0:
                share = min(1.0, max(0.0, -(dx * ex + dy * ey) / length2))
                dx += share * ex
                dy += share * ey
        distance2 = dx * dx + dy * dy
        if distance2 == 0.0:
            return True
        distance = math.sqrt(distance2)
        cc = (dx * ray_x + dy * ray_y) / distance
        variance = (
            sigma * sigma * cc * cc + across2 * (1.0 - cc * cc) + placing * placing + variances[a]
        )
        if distance <= APART_SIGMAS * math.sqrt(variance) + systematic * abs(cc):
            return True
    return False


@njit(cache=True)
def hide_beams(
    ranges: Floats,
    bearings: Floats,
    point_ranges: Floats,
    point_bearings: Floats,
    halves: Floats,
    hidden: Bytes,
) -> None:
    """hidden (N,) out: 1 for beams that pass over a point nearer than they reach.

    ranges, bearings (N,): of the beams, by ascending bearing. halves (M,): half the angle that
    each point covers. Cost: M log N and the beams covered.
    """
    hidden[:] = 0
    count = bearings.size
    for m in range(point_ranges.size):
        first = np.searchsorted(bearings, point_bearings[m] - halves[m])
        if point_bearings[m] - halves[m] < -math.pi:
            first = np.searchsorted(bearings, point_bearings[m] - halves[m] + 2.0 * math.pi)
        for step in range(count):
            k = (first + step) % count
            off = (bearings[k] - point_bearings[m] + math.pi) % (2.0 * math.pi) - math.pi
            if abs(off) > halves[m]:
                break
            if ranges[k] > point_ranges[m]:
                hidden[k] = 1
