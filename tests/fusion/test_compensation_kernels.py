"""The compensation's kernels against plain NumPy twins."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import se2, transform
from fusion import compensation_kernels as kernels
from fusion import sweep_kernels
from fusion.deskew import deskew
from fusion.sweep import Sweep
from tests.fusion.views import WALLS, box, cast, sweep_of

Flags = npt.NDArray[np.uint8]
Ints = npt.NDArray[np.int64]


def wrapped(angles: Array) -> Array:
    turned: Array = (angles + math.pi) % (2.0 * math.pi) - math.pi
    return turned


def scene(seed: int, beams: int, timed: bool) -> Sweep:
    """A noisy turn in a corridor with a box in it, holes in it, from some place."""
    random = np.random.default_rng(seed)
    place = random.uniform((-6.0, -0.8), (1.0, 0.8))
    bearings = wrapped(random.uniform(-3.0, 3.0) - np.arange(beams) * 2.0 * math.pi / beams)
    ranges = cast(WALLS + box(2.0, -0.3, 0.6, 0.5), place, bearings)
    ranges += (0.01 + 0.003 * ranges) * random.standard_normal(beams)
    ranges[random.random(beams) < 0.05] = random.choice([np.inf, np.nan, -np.inf])
    return sweep_of(ranges, bearings, np.arange(beams) * 0.14 / beams if timed else None, (0.1, 0))


def joined_by_kernel(sweep: Sweep) -> Flags:
    joined = np.empty(sweep.ranges_m.size, dtype=np.uint8)
    sweep_kernels.join_beams(
        sweep.ranges_m,
        sweep.bearings_rad,
        sweep.points_base,
        sweep.offsets_s,
        sweep.variance_m2,
        sweep.spacing_rad,
        joined,
    )
    return joined


def joined_by_numpy(sweep: Sweep) -> Flags:
    r, b, p, v = sweep.ranges_m, sweep.bearings_rad, sweep.points_base, sweep.variance_m2
    step = (np.roll(b, -1) - b) % (2.0 * math.pi)
    finite = np.isfinite(r)
    neighbours = finite & np.roll(finite, -1) & (step <= 1.5 * sweep.spacing_rad)
    a, c = np.roll(np.arange(r.size), 1), np.roll(np.arange(r.size), -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = step[a] / (step[a] + step)
        expected = 1.0 / ((1.0 - share) / r[a] + share / r[c])
        variance = (
            v
            + ((1.0 - share) * (expected / r[a]) ** 2) ** 2 * v[a]
            + (share * (expected / r[c]) ** 2) ** 2 * v[c]
        )
        line = (r - expected) ** 2 <= 9.0 * variance
        gap = np.hypot(*(np.roll(p, -1, axis=0) - p).T)
        near = gap <= 0.05 + 3.0 * sweep.spacing_rad * np.minimum(r, np.roll(r, -1))
    line &= neighbours & neighbours[a]  # of beam i and those on either side of it
    joined = neighbours & (near | line | np.roll(line, -1))
    times = sweep.offsets_s
    if times.size:
        joined &= np.abs(np.roll(times, -1) - times) <= 0.5 * (times.max() - times.min())
    return joined.astype(np.uint8)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), beams=st.integers(40, 900), timed=st.booleans())
def test_joined_beams(seed: int, beams: int, timed: bool) -> None:
    sweep = scene(seed, beams, timed)
    assert joined_by_kernel(sweep).tolist() == joined_by_numpy(sweep).tolist()


def test_a_wall_is_joined_however_grazing_and_edges_are_not() -> None:
    bearings = np.linspace(-0.7, 0.7, 281)
    ranges = cast([*WALLS, *box(2.0, -0.2, 0.4, 0.4)], np.zeros(2), bearings)
    sweep = sweep_of(ranges, bearings)
    joined = joined_by_kernel(sweep)
    apart = np.flatnonzero(joined[:-1] == 0)
    assert apart.size == 2  # the two sides of the box
    middles = 0.5 * (bearings[apart] + bearings[apart + 1])
    assert np.abs(middles) == pytest.approx(math.atan(0.1), abs=0.005)
    assert joined[-1] == 0  # the ends of the field of view


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 50))
def test_the_nearest_beam(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    bearings = np.sort(random.uniform(-math.pi, math.pi, count))
    for bearing in random.uniform(-math.pi, math.pi, 20):
        k = sweep_kernels.nearest_beam(bearing, bearings)
        away = np.abs(wrapped(bearings - bearing))
        assert away[k] == pytest.approx(away.min())


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), angle=st.floats(-math.pi, math.pi))
def test_the_normal_is_that_of_the_least_squares_line(seed: int, angle: float) -> None:
    random = np.random.default_rng(seed)
    along = np.arange(-12.0, 13.0) * 0.03
    wall = np.column_stack([np.full(25, 1.5) + 0.01 * random.standard_normal(25), along])
    points = transform(se2(0.0, 0.0, angle), wall)
    joined = np.ones(25, dtype=np.uint8)
    joined[-1] = joined[14] = 0
    nx, ny, fitted = sweep_kernels.surface_normal(12, points, joined, np.zeros(2))
    used = points[6:15]  # six to one side, as far as it is joined to the other
    assert fitted == 9
    least = np.linalg.eigh(np.cov(used.T))[1][:, 0]
    assert abs(nx * least[0] + ny * least[1]) == pytest.approx(1.0, abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), timed=st.booleans())
def test_placing_is_undone_by_the_way_of_the_base(seed: int, timed: bool) -> None:
    random = np.random.default_rng(seed)
    sweep = scene(seed, 500, timed)
    twist = random.uniform((-0.8, -0.1, -1.0), (0.8, 0.1, 1.0))
    before = random.uniform(-4.0, 4.0, (60, 2))
    angles = random.uniform(-3.0, 3.0, 60)
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    placed, turned = before.copy(), rays.copy()
    found, times = np.empty(60, dtype=np.int64), np.zeros(60)
    kernels.place_points(
        placed,
        turned,
        sweep.middle_s,
        twist,
        sweep.origin_base,
        sweep.bearings_rad,
        sweep.offsets_s,
        sweep.spacing_rad,
        found,
        times,
    )
    if not timed:
        assert placed == pytest.approx(before)
        assert not times.any()
        return
    since = times - sweep.middle_s
    assert deskew(placed, since, twist) == pytest.approx(before, abs=1e-9)
    back = deskew(turned, since, np.array([0.0, 0.0, twist[2]]))
    assert back == pytest.approx(rays, abs=1e-9)
    seen = placed - sweep.origin_base
    away = np.abs(wrapped(np.arctan2(seen[:, 1], seen[:, 0])[:, None] - sweep.bearings_rad))
    near = np.hypot(*seen.T) > 0.3
    assert (found[near] >= 0).all()
    # the time is that of the beam of its bearing, but for the seam, where there are two
    of_time = np.abs(sweep.offsets_s[None] - times[:, None]).argmin(axis=1)
    off = np.take_along_axis(away, of_time[:, None], axis=1)[:, 0]
    first, last = sweep.offsets_s.argmin(), sweep.offsets_s.argmax()
    overlap_rad = 0.14 * (abs(twist[2]) + np.hypot(*twist[:2]) / np.hypot(*seen.T))
    at_seam = np.minimum(away[:, first], away[:, last]) < overlap_rad + 2.0 * sweep.spacing_rad
    assert np.quantile(off[near & ~at_seam], 0.9) < sweep.spacing_rad


def twin_of_associate(
    sweep: Sweep,
    joined: Flags,
    points: Array,
    rays: Array,
    numbers: tuple[Array, Array, Array],
    home: Ints,
    placing: float,
) -> list[int]:
    """Verdicts, in plain steps; the distance to the lidar's surface is that to all of it."""
    verdicts = []
    count, origin = sweep.ranges_m.size, sweep.origin_base
    for p, u, sigma, systematic, lateral, k in zip(points, rays, *numbers, home, strict=True):
        q = p - origin
        r, bearing = float(np.hypot(*q)), math.atan2(q[1], q[0])
        e = q / r
        along2, across2 = sigma**2 + (0.5 * systematic) ** 2, lateral**2

        def variance(n: Array, u: Array = u, a: float = along2, c: float = across2) -> float:
            return float(a * (n @ u) ** 2 + c * (1.0 - (n @ u) ** 2) + placing**2)

        if k < 0:
            verdicts.append(kernels.FILLED)
            continue
        ahead = float(wrapped(np.array(bearing - sweep.bearings_rad[k]))) >= 0.0
        low, high = (k, (k + 1) % count) if ahead else ((k - 1) % count, k)
        best, nearest = math.inf, math.inf
        for i in (low, high):
            away = abs(float(wrapped(np.array(bearing - sweep.bearings_rad[i]))))
            if (joined[low] and i != k) or away > sweep.spacing_rad:
                continue
            if not np.isfinite(sweep.ranges_m[i]):
                continue
            nx, ny, fitted = sweep_kernels.surface_normal(i, sweep.points_base, joined, origin)
            n, at = np.array([nx, ny]), sweep.points_base[i] - origin
            met = own = float(np.hypot(*at))
            if joined[low]:
                a, b = sweep.points_base[[low, high]] - origin
                met = float(np.linalg.solve(np.column_stack([e, a - b]), a)[0])
            elif fitted >= 3 and abs(n @ e) >= kernels.LEAST_COSINE:
                line = float(n @ at / (n @ e))
                met = line if 0.5 * own < line < 2.0 * own else own
            c = max(kernels.LEAST_COSINE, abs(float(n @ e)))
            best = min(best, ((met - r) * c) ** 2 / (sweep.variance_m2[i] * c * c + variance(n)))
            nearest = min(nearest, met)
        if best < kernels.GAMMA2:
            verdicts.append(kernels.ASSOCIATED)
        elif not np.isfinite(sweep.ranges_m[k]):
            verdicts.append(kernels.FILLED)
        elif r > nearest:
            verdicts.append(kernels.FARTHER)
        else:
            verdicts.append(kernels.OWN)
            for a in np.flatnonzero(np.isfinite(sweep.ranges_m)):
                first = last = sweep.points_base[a]
                if joined[a]:
                    last = sweep.points_base[(a + 1) % count]
                way = last - first
                t = np.clip((p - first) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
                off = first + t * way - p
                distance = float(np.hypot(*off))
                n = off / distance
                random2 = variance(n) - (0.5 * systematic * float(n @ u)) ** 2
                bound = 3.0 * math.sqrt(random2 + sweep.variance_m2[a])
                if distance <= bound + systematic * abs(float(n @ u)):
                    verdicts[-1] = kernels.SAME
                    break
    return verdicts


@settings(deadline=None, max_examples=12)
@given(seed=st.integers(0, 2**32 - 1), beams=st.integers(100, 700))
def test_verdicts(seed: int, beams: int) -> None:
    random = np.random.default_rng(seed)
    sweep = scene(seed, beams, timed=False)
    joined = joined_by_kernel(sweep)
    # near the lidar's surface, where it matters, and on it
    angles = random.uniform(-math.pi, math.pi, 80)
    places = np.abs(wrapped(angles[:, None] - sweep.bearings_rad)).argmin(axis=1)
    lengths = np.nan_to_num(sweep.ranges_m[places], nan=2.0, posinf=2.0, neginf=2.0)
    lengths = np.maximum(0.2, lengths - random.exponential(0.2, 80) + 0.1)
    points = (
        sweep.origin_base + np.column_stack([np.cos(angles), np.sin(angles)]) * lengths[:, None]
    )
    eye = np.array([0.25, 0.1])
    rays = (points - eye) / np.hypot(*(points - eye).T)[:, None]
    away = np.hypot(*(points - eye).T)
    numbers = (random.uniform(0.002, 0.05, 80), 0.02 * away, np.full(80, 0.004))
    home, nothing = np.empty(80, dtype=np.int64), np.zeros(80)
    place = (sweep.origin_base, sweep.bearings_rad, sweep.offsets_s, sweep.spacing_rad)
    kernels.place_points(points, rays, 0.0, np.zeros(3), *place, home, nothing)
    verdicts, moved = np.empty(80, dtype=np.uint8), home.copy()
    variances, seen = np.empty((2, 80))
    kernels.associate(
        points,
        rays,
        *numbers,
        moved,
        sweep.origin_base,
        sweep.ranges_m,
        sweep.bearings_rad,
        sweep.points_base,
        sweep.variance_m2,
        sweep.spacing_rad,
        joined,
        0.02,
        verdicts,
        variances,
        seen,
    )
    wanted = twin_of_associate(sweep, joined, points, rays, numbers, home, 0.02)
    assert verdicts.tolist() == wanted
    assert (variances > 0.0).all()


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), beams=st.integers(1, 80))
def test_hidden_beams(seed: int, beams: int) -> None:
    random = np.random.default_rng(seed)
    bearings = np.sort(random.uniform(-math.pi, math.pi, beams))
    ranges = random.uniform(0.5, 3.0, beams)
    ranges[random.random(beams) < 0.2] = np.nan
    points = random.uniform(-math.pi, math.pi, 5)
    lengths, halves = random.uniform(0.5, 3.0, 5), random.uniform(0.0, 0.5, 5)
    hidden = np.empty(beams, dtype=np.uint8)
    kernels.hide_beams(ranges, bearings, lengths, points, halves, hidden)
    inside = np.abs(wrapped(bearings[:, None] - points)) <= halves
    with np.errstate(invalid="ignore"):
        wanted = (inside & (ranges[:, None] > lengths)).any(axis=1)
    assert hidden.astype(bool).tolist() == wanted.tolist()
