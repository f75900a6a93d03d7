"""Scene restoration degree: how long a structure came out in the map, of how long it is.

Paper, table 4: gamma = l_m / l_t * 100 %. l_m is the distance between the walls at the structure's
two ends, each fitted as a line within the structure's width, to points and not to cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from datasets.simulation.place import Structure
from datasets.trajectory import Trajectory
from slam.evaluation.surfaces import Ints, Mask

WIDTH_M = 2.0
WINDOW_M = 1.5
MARGIN_M = 0.1
"""Left off at both sides of the width: there the side walls begin."""
STRIP_M = 0.05
BIN_M = 0.01
BLUR_BINS = 2.0
LEAN = np.tan(np.radians(np.arange(-4.0, 4.1, 0.25)))
NEAR_M = 0.04
FIT_M = (0.06, 0.05, 0.05)
LEAST_FILLED = 0.3
COMPARABLE = 0.5
GHOST_APART_M = 0.08
PRESENT = 0.2
PROMINENT = 0.2


@dataclass(frozen=True, slots=True)
class Restored:
    """A structure that was measured.

    measured_m, true_m : l_m and l_t. std_m : of the measured length, from the fits: the points'
                         deviation from each wall over the root of the strips of 5 cm that hold it.
    residual_m         : standard deviation of the points about the wall at each end.
    """

    name: str
    measured_m: float
    true_m: float
    std_m: float
    residual_m: tuple[float, float]

    @property
    def gamma_percent(self) -> float:
        """Signed: above 100 is a map longer than the truth."""
        return self.measured_m / self.true_m * 100.0


@dataclass(frozen=True, slots=True)
class Ghosted:
    """A structure with a wall that is in the map twice: its length is one or another of these.

    measured_m : every length that the walls allow, ascending. ends : which are doubled.
    """

    name: str
    measured_m: tuple[float, ...]
    true_m: float
    ends: tuple[str, ...]

    @property
    def gamma_percent(self) -> tuple[float, ...]:
        return tuple(each / self.true_m * 100.0 for each in self.measured_m)


@dataclass(frozen=True, slots=True)
class NotRestored:
    """A structure whose wall was not found, and why."""

    name: str
    reason: str


Restoration = Restored | Ghosted | NotRestored


@dataclass(frozen=True, slots=True)
class _Wall:
    """offset_m : outwards from where it should be, in the middle. strips : that hold it."""

    offset_m: float
    residual_m: float
    strips: int


def ends_in_map(
    structure: Structure, T_map_base: Trajectory, T_place_base: Trajectory
) -> tuple[Array, Array]:
    """(start_map, end_map), (2,) m each: where the estimate should have put a place's structure.

    T_map_base : the estimate. T_place_base : the truth, in the place's frame. Each end is moved
    by the error at the pose that came nearest to it.
    """
    moved = []
    for point in (structure.start_m, structure.end_m):
        offset = np.array(point) - T_place_base.xyyaw[:, :2]
        nearest = int(np.argmin((offset * offset).sum(axis=1)))
        stamp_ns = T_place_base.stamps_ns[nearest : nearest + 1]
        row, true_row = T_map_base.at(stamp_ns)[0], T_place_base.xyyaw[nearest]
        c, s = np.cos(row[2] - true_row[2]), np.sin(row[2] - true_row[2])
        moved.append(row[:2] + np.array([[c, -s], [s, c]]) @ offset[nearest])
    return moved[0], moved[1]


def restoration(
    structure: Structure,
    points_map: Array,
    weights: Array | None = None,
    *,
    origins_map: Array | None = None,
    ends_map: tuple[Array, Array] | None = None,
    width_m: float = WIDTH_M,
    window_m: float = WINDOW_M,
) -> Restoration:
    """Measure a structure in the points of the lidar layer.

    points_map : (N, 2) m, finite: end points of beams at their map poses, or the centres of cells
                 with their probabilities as ``weights`` (N,) >= 0.
    origins_map: (N, 2) m, where the sensor stood for each point. With them only what was seen from
                 inside counts; without, a thin wall that was seen from both sides is a ghost.
    ends_map   : where its ends should be in the map; without, where the structure has them.
    width_m    : of the structure; only points within it count.
    window_m   : how far from there a wall is looked for, inwards and outwards.

    At each end, strips of 5 cm run along the structure, and each has one vote, however many points
    it holds. A line, at most 4 deg from square, must hold 30 % of the strips; of those that hold
    at least half as many as the fullest, the wall is the one nearest to where it should be. It is
    fitted to the points within 5 cm, and its distance taken on the structure's axis. A second line
    8 cm or more from it, in the same strips and in at least half as many, is a ghost.
    Raises ValueError if shapes disagree, points are not finite or the width leaves nothing.
    """
    _check(points_map, weights, origins_map, width_m)
    start, end = ends_map or (np.array(structure.start_m), np.array(structure.end_m))
    apart_m = float(np.hypot(*(end - start)))
    if apart_m <= 0.0:
        raise ValueError("the ends of a structure lie apart")
    axis = (end - start) / apart_m
    counted = np.ones(len(points_map)) if weights is None else weights
    found: list[tuple[_Wall, ...]] = []
    for name, middle, outwards in (("start", start, -axis), ("end", end, axis)):
        usable = counted
        if origins_map is not None:
            usable = np.where((points_map - origins_map) @ outwards > 0.0, counted, 0.0)
        walls = _walls_at(points_map, usable, middle, outwards, width_m, window_m)
        if isinstance(walls, str):
            return NotRestored(structure.name, f"at its {name}, {walls}")
        found.append(walls)
    lengths_m = sorted(apart_m + a.offset_m + b.offset_m for a in found[0] for b in found[1])
    ghosts = tuple(
        name for name, walls in zip(("start", "end"), found, strict=True) if len(walls) > 1
    )
    if ghosts:
        return Ghosted(structure.name, tuple(lengths_m), structure.length_m, ghosts)
    first, last = found[0][0], found[1][0]
    variance = sum(wall.residual_m**2 / wall.strips for wall in (first, last))
    return Restored(
        structure.name,
        lengths_m[0],
        structure.length_m,
        float(np.sqrt(variance)),
        (first.residual_m, last.residual_m),
    )


def _check(
    points_map: Array, weights: Array | None, origins_map: Array | None, width_m: float
) -> None:
    if points_map.ndim != 2 or points_map.shape[1] != 2 or not np.isfinite(points_map).all():
        raise ValueError(f"points {points_map.shape} must be finite and (N, 2)")
    if weights is not None and (
        weights.shape != (len(points_map),) or not (np.isfinite(weights) & (weights >= 0)).all()
    ):
        raise ValueError(f"weights {weights.shape} do not belong to {len(points_map)} points")
    if origins_map is not None and origins_map.shape != points_map.shape:
        raise ValueError(f"origins {origins_map.shape} do not belong to {len(points_map)} points")
    if not width_m > 2 * MARGIN_M:
        raise ValueError(f"a width of {width_m} m leaves nothing between the side walls")


def _walls_at(
    points_map: Array,
    weights: Array,
    middle: Array,
    outwards: Array,
    width_m: float,
    window_m: float,
) -> tuple[_Wall, ...] | str:
    """The wall at one end, with its ghosts, or why there is none."""
    offset = points_map - middle
    out_m, across_m = offset @ outwards, offset @ np.array([-outwards[1], outwards[0]])
    half_m = width_m / 2 - MARGIN_M
    near = (np.abs(out_m) < window_m) & (np.abs(across_m) < half_m) & (weights > 0)
    out_m, across_m, weights = out_m[near], across_m[near], weights[near]
    if not out_m.size:
        return f"there is nothing within {window_m:g} m of where the wall should be"
    count = max(1, int(np.ceil(2 * half_m / STRIP_M)))
    strip = np.minimum(((across_m + half_m) / (2 * half_m) * count).astype(np.int64), count - 1)
    votes = weights / np.bincount(strip, weights, count)[strip]
    lean, peaks = _peaks(out_m, across_m, votes, window_m)
    present = [_present(out_m - lean * across_m - peak, votes, strip, count) for peak in peaks]
    fullest = max(int(strips.sum()) for strips in present)
    filled = fullest / count
    if filled < LEAST_FILLED:
        return (
            f"no line within {window_m:g} m of where the wall should be holds more than "
            f"{filled:.0%} of its width"
        )
    # A cabinet before the wall may be wider than what it leaves of the wall.
    enough = max(LEAST_FILLED * count, COMPARABLE * fullest)
    full = [k for k, strips in enumerate(present) if strips.sum() >= enough]
    main = min(full, key=lambda k: abs(float(peaks[k])))
    twins = [
        k
        for k, strips in enumerate(present)
        if abs(peaks[k] - peaks[main]) > GHOST_APART_M
        and strips.sum() >= COMPARABLE * present[main].sum()
        and (strips & present[main]).sum() >= COMPARABLE * strips.sum()
    ]
    fitted = []
    for k in sorted([main, *twins]):
        own = present[k][strip]
        fitted.append(_fitted(out_m[own], across_m[own], votes[own], strip[own], lean, peaks[k]))
    return tuple(fitted)


def _peaks(out_m: Array, across_m: Array, votes: Array, window_m: float) -> tuple[float, Array]:
    """(the lean at which all lines together are sharpest, where its lines gather votes, m)."""
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415
    from scipy.signal import find_peaks  # noqa: PLC0415

    reach_m = window_m + LEAN.max() * np.abs(across_m).max() + 10 * BIN_M
    count = int(2 * reach_m / BIN_M) + 1
    best, best_lean, best_profile = -1.0, 0.0, np.empty(0)
    for lean in LEAN.tolist():
        bins = ((out_m - lean * across_m + reach_m) / BIN_M).astype(np.int64)
        profile = gaussian_filter1d(
            np.bincount(bins, votes, count).astype(np.float64), BLUR_BINS, mode="constant"
        )
        sharpness = float(profile @ profile)
        if sharpness > best:
            best, best_lean, best_profile = sharpness, lean, profile
    peaks, _ = find_peaks(best_profile, prominence=PROMINENT * best_profile.max())
    return best_lean, (peaks + 0.5) * BIN_M - reach_m


def _present(from_line_m: Array, votes: Array, strip: Ints, count: int) -> Mask:
    """(count,) which strips have a fair share of their points on a line."""
    near = np.abs(from_line_m) < NEAR_M
    share = np.bincount(strip[near], votes[near], count)
    present: Mask = share >= PRESENT
    return present


def _fitted(
    out_m: Array, across_m: Array, votes: Array, strip: Ints, lean: float, at_m: float
) -> _Wall:
    """Weighted least squares over what lies near the line, again and again.

    All points are of strips that hold the line: one before it, in other strips, would tilt it.
    """
    slope, offset_m = lean, at_m
    for near_m in FIT_M:
        near = np.abs(out_m - slope * across_m - offset_m) < near_m
        w, x, y = votes[near], across_m[near], out_m[near]
        mean_x, mean_y = np.average(x, weights=w), np.average(y, weights=w)
        spread = np.average((x - mean_x) ** 2, weights=w)
        if spread > STRIP_M**2:  # a narrow patch says nothing of its slope
            slope = float(np.average((x - mean_x) * (y - mean_y), weights=w) / spread)
            slope = float(np.clip(slope, LEAN[0], LEAN[-1]))
        offset_m = float(mean_y - slope * mean_x)
    residual = y - slope * x - offset_m
    residual_m = float(np.sqrt(np.average(residual**2, weights=w)))
    return _Wall(offset_m, residual_m, int(np.unique(strip[near]).size))
