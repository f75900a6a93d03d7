"""Is a map right as a whole: the relative poses of places that were visited again.

ATE says how far poses lie from the truth, relations and RPE how good short stretches are. Whether
a map is bent, doubled or torn shows where the robot came by again after a long drive.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.se2 import between
from datasets.trajectory import Stamps, Trajectory
from slam.evaluation.association import covered

NEAR_M = 2.0
"""Two poses of the reference nearer than this, ..."""
APART_M = 20.0
"""... and more than this of its path apart, are a revisit."""
OFF_M = 0.5
"""A revisit whose relative position is wrong by more than this is off."""
SLACK_S = 0.02
"""A pose stands for a reference pose whose stamp is nearer than this to its own."""
DENSER = 1.5
"""A reference is denser than a trajectory that usually steps over more of its poses than this."""
GAP = 3.0
"""More than so many usual steps from one pose to the next are a gap."""
TINY = 1e-6
BLOCK = 512
"""Poses whose partners are looked up at once, which bounds the memory."""

Mask = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class RevisitErrors:
    """Errors of the relative position over all revisits.

    count   : revisits. missing : those of them with a pose that the trajectory lacks.
    off     : those with an error above 0.5 m, and the missing ones.
    median_m, mean_m, p95_m : of the errors; None where there is none.
    """

    count: int
    missing: int
    off: int
    median_m: float | None
    mean_m: float | None
    p95_m: float | None

    @property
    def missing_share(self) -> float | None:
        """Of all revisits, 0 to 1; None without revisits."""
        return self.missing / self.count if self.count else None

    @property
    def off_share(self) -> float | None:
        """Of all revisits, 0 to 1: 0 in a map that is right as a whole; None without revisits."""
        return self.off / self.count if self.count else None


@dataclass(frozen=True, slots=True)
class _Places:
    """Poses of the reference that take part.

    stamps_ns : (N,). xyyaw : (N, 3). path_m : (N,), along the whole reference.
    """

    stamps_ns: Stamps
    xyyaw: Array
    path_m: Array


def revisit_errors(
    trajectory: Trajectory,
    reference: Trajectory,
    scans_ns: Stamps | None = None,
    time_offset_s: float = 0.0,
) -> RevisitErrors:
    """Compare relative positions at every pair of reference poses that is a revisit.

    A reference pose is compared with the trajectory's pose at the nearest stamp within 20 ms;
    without one it is missing. A reference denser than the trajectory's poses takes part at their
    stamps, interpolated, and where they have a gap at the steps they usually make.

    scans_ns      : stamps of the recording's scans, if only reference poses at scans are to take
                    part, as for a recording of which every k-th scan was kept.
    time_offset_s : to add to a stamp of the trajectory to get the reference's.
    """
    shift_ns = round(time_offset_s * 1e9)
    own_ns = trajectory.stamps_ns + shift_ns
    places = _all(reference)
    if scans_ns is not None:
        places = _chosen(places, nearest(scans_ns + shift_ns, reference.stamps_ns)[1])
    else:
        places = _at_poses(places, reference, own_ns)
    index, known = nearest(own_ns, places.stamps_ns)
    missing, found = 0, [np.empty(0)]
    for first, second in _revisits(places):
        have = known[first] & known[second]
        missing += int((~have).sum())
        a, b = first[have], second[have]
        truth = between(places.xyyaw[a], places.xyyaw[b])
        estimate = between(trajectory.xyyaw[index[a]], trajectory.xyyaw[index[b]])
        found.append(np.hypot(*(estimate - truth)[:, :2].T))
    return _summary(np.concatenate(found), missing)


def _summary(errors_m: Array, missing: int) -> RevisitErrors:
    off = int((errors_m > OFF_M).sum()) + missing
    count = errors_m.size + missing
    if errors_m.size == 0:
        return RevisitErrors(count, missing, off, None, None, None)
    return RevisitErrors(
        count,
        missing,
        off,
        median_m=float(np.median(errors_m)),
        mean_m=float(errors_m.mean()),
        p95_m=float(np.percentile(errors_m, 95.0)),
    )


def _revisits(places: _Places) -> Iterator[tuple[Indices, Indices]]:
    """All revisits as indices (first, second), first < second, in some pieces."""
    from scipy.spatial import cKDTree  # noqa: PLC0415

    points, path_m = places.xyyaw[:, :2], places.path_m
    tree = cKDTree(points)
    for begin in range(0, len(points), BLOCK):
        block = cKDTree(points[begin : begin + BLOCK])
        near = block.sparse_distance_matrix(tree, NEAR_M, output_type="ndarray")
        first, second = near["i"].astype(np.intp) + begin, near["j"].astype(np.intp)
        again = (near["v"] < NEAR_M) & (path_m[second] - path_m[first] > APART_M)
        yield first[again], second[again]


def _all(reference: Trajectory) -> _Places:
    steps_m = np.hypot(*np.diff(reference.xyyaw[:, :2], axis=0).T)
    path_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    return _Places(reference.stamps_ns, reference.xyyaw, path_m)


def _chosen(places: _Places, mask: Mask) -> _Places:
    return _Places(places.stamps_ns[mask], places.xyyaw[mask], places.path_m[mask])


def _at_poses(places: _Places, reference: Trajectory, own_ns: Stamps) -> _Places:
    """The reference at the stamps of a trajectory if it is denser than that, or as it is.

    Where the trajectory has a gap, its usual step over the reference goes on. Steps are counted in
    poses of the reference, so that one that stands still while nothing is recorded makes no gap.
    """
    every = np.arange(float(len(reference)))
    true_s, own_s = (
        (stamps - reference.stamps_ns[0]) * 1e-9 for stamps in (places.stamps_ns, own_ns)
    )
    steps = np.interp(own_s, true_s, every)
    usual = float(np.median(np.diff(steps))) if steps.size > 1 else 0.0
    if usual <= DENSER:
        return places
    before = np.arange(steps[0] - usual, -TINY, -usual)
    after = np.arange(steps[-1] + usual, every[-1] + TINY, usual)
    gaps = np.flatnonzero(np.diff(steps) > GAP * usual)
    within = [np.arange(steps[k] + usual, steps[k + 1] - 0.5 * usual, usual) for k in gaps]
    lacking_s = np.interp(np.concatenate([before, after, *within]), every, true_s)
    lacking_ns = reference.stamps_ns[0] + np.rint(lacking_s * 1e9).astype(np.int64)
    stamps_ns = np.unique(np.concatenate([own_ns, lacking_ns]))
    stamps_ns = stamps_ns[covered(reference, stamps_ns)]
    at_s = (stamps_ns - reference.stamps_ns[0]) * 1e-9
    return _Places(stamps_ns, reference.at(stamps_ns), np.interp(at_s, true_s, places.path_m))


def nearest(stamps_ns: Stamps, at_ns: Stamps) -> tuple[Indices, Mask]:
    """Index of the nearest of some stamps (increasing, at least one), and if it is near enough."""
    after = np.clip(np.searchsorted(stamps_ns, at_ns), 0, stamps_ns.size - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(stamps_ns[before] - at_ns) <= np.abs(stamps_ns[after] - at_ns)
    index: Indices = np.where(earlier, before, after)
    near: Mask = np.abs(stamps_ns[index] - at_ns) < SLACK_S * 1e9
    return index, near
