"""Is the map right as a whole? Where its own scans contradict each other it is not.

Scans of one place, taken at different times, are laid over each other at their final poses. A
point of one scan may be seen by the other, be hidden from it, or lie where the other's beams went
through: that is a contradiction. Noise, glass and things that move make some everywhere. Where much
of what can be compared is contradicted over metres of driving, a pass lies at a wrong place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from backend import free_space_kernels
from backend.free_space import GAP_RAD, MARGIN_M, MARGIN_SHARE, Viewers
from datasets.messages import Array
from frontend.nodes import Node

Indices = npt.NDArray[np.int64]

SAMPLE_M: Final = 1.0
"""Distance travelled between two nodes that are looked at."""
NEAR_M: Final = 6.0
WITHIN_M: Final = 12.0
"""Nodes nearer to each other than NEAR_M are compared, by their points within WITHIN_M."""
OTHER_PASS_M: Final = 20.0
"""Nodes this far from each other along the drive belong to different passes of a place."""
SAME_PASS_M: Final = (1.0, 6.0)
"""How far from each other along the drive two nodes of one pass are, to be compared."""
PASSES: Final = 3
PASS_APART_M: Final = 5.0
"""Each node is compared with so many passes, which are this far from each other along the drive."""
COMPARED_POINTS: Final = 40
"""Nodes with fewer points that can be compared say nothing."""
SMOOTHED: Final = 2
"""Samples before and after one whose median counts: a contradiction must last."""
CONTRADICTED_SHARE: Final = 0.3
"""Of the points compared. On the recordings whose maps are right the highest is 0.26, on those
whose maps are wrong 0.5 and more."""
SHORTEST: Final = {"other": 3, "same": 2}
"""Samples in a row that make a place doubtful, for other passes and for the same one."""


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A stretch of the drive whose scans contradict those of other passes, or of its own.

    x_m, y_m : the middle of the stretch in the map.
    from_ns, to_ns : stamps of its first and last scan.
    share    : of the points compared that other scans saw through, at the worst.
    passes   : "other" or "same".
    other_ns : the stamp of a scan that contradicts it.
    """

    x_m: float
    y_m: float
    from_ns: int
    to_ns: int
    share: float
    passes: str
    other_ns: int


@dataclass(frozen=True, slots=True)
class Contradictions:
    """All stretches, the worst first, and the share of contradicted points among all compared."""

    places: tuple[Contradiction, ...]
    share: float
    compared: int


def contradictions(nodes: Sequence[Node], T_map_nodes: Array) -> Contradictions:
    """Compare each metre of the drive with the other passes of the place.

    T_map_nodes : (N, 3, 3).
    """
    pairs, kinds = _pairs(nodes, T_map_nodes)
    if not len(pairs):
        return Contradictions((), 0.0, 0)
    counts = _compared(nodes, T_map_nodes, pairs)
    both = counts[:, 0] + counts[:, 1]
    other = kinds == 1
    share = float(counts[other, 1].sum() / max(1, both[other].sum()))
    places = [
        place
        for kind, passes in ((1, "other"), (0, "same"))
        for place in _places(
            nodes, T_map_nodes, pairs[kinds == kind], counts[kinds == kind], passes
        )
    ]
    places.sort(key=lambda place: (-place.share, place.from_ns))
    return Contradictions(tuple(places), share, int(both[other].sum()))


def _pairs(nodes: Sequence[Node], T_map_nodes: Array) -> tuple[Indices, Indices]:
    """(M, 2) nodes to compare, the one looked at first; and (M,) 1 for other passes, 0 for one."""
    from scipy.spatial import cKDTree  # noqa: PLC0415

    xy = T_map_nodes[:, :2, 2]
    way_m = np.array([node.way_m for node in nodes])
    looked_at, last_m = [], -np.inf
    for index, here_m in enumerate(way_m.tolist()):
        if here_m - last_m >= SAMPLE_M:
            looked_at.append(index)
            last_m = here_m
    if not looked_at:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)
    pairs: list[tuple[int, int]] = []
    kinds: list[int] = []
    neighbours = cKDTree(xy).query_ball_point(xy[looked_at], NEAR_M, return_sorted=True)
    for index, found in zip(looked_at, neighbours, strict=True):
        near = np.array(found, dtype=np.int64)
        apart_m = np.abs(way_m[near] - way_m[index])
        away_m = np.hypot(*(xy[near] - xy[index]).T)
        others: list[int] = []
        of_others = apart_m > OTHER_PASS_M
        for other in near[of_others][np.argsort(away_m[of_others], kind="stable")].tolist():
            if all(abs(way_m[other] - way_m[known]) > PASS_APART_M for known in others):
                others.append(other)
                if len(others) == PASSES:
                    break
        pairs += [(index, other) for other in others]
        kinds += [1] * len(others)
        same = near[(apart_m > SAME_PASS_M[0]) & (apart_m < SAME_PASS_M[1])]
        if len(same):
            middle_m = 0.5 * sum(SAME_PASS_M)
            best = int(np.argmin(np.abs(np.abs(way_m[same] - way_m[index]) - middle_m)))
            pairs.append((index, int(same[best])))
            kinds.append(0)
    return np.array(pairs, dtype=np.int64).reshape(-1, 2), np.array(kinds, dtype=np.int64)


def _compared(nodes: Sequence[Node], T_map_nodes: Array, pairs: Indices) -> Indices:
    """(M, 2) points that both scans of a pair saw, and points that one saw through; both ways."""
    scans = Viewers.of(nodes, list(T_map_nodes))
    total = np.zeros((len(pairs), 2), dtype=np.int64)
    for first, second in ((0, 1), (1, 0)):
        out = np.empty((len(pairs), 3), dtype=np.int64)
        free_space_kernels.compare_views(
            np.ascontiguousarray(pairs[:, first]),
            np.ascontiguousarray(pairs[:, second]),
            scans.poses,
            scans.starts,
            scans.bearings,
            scans.ranges,
            WITHIN_M,
            GAP_RAD,
            MARGIN_M,
            MARGIN_SHARE,
            out,
        )
        total += out[:, :2]
    return total


def _places(
    nodes: Sequence[Node], T_map_nodes: Array, pairs: Indices, counts: Indices, passes: str
) -> list[Contradiction]:
    """The stretches along which the median of the shares is too high."""
    looked_at, row_of = np.unique(pairs[:, 0], return_inverse=True)
    sums = np.zeros((len(looked_at), 2), dtype=np.int64)
    np.add.at(sums, row_of, counts)
    both = sums.sum(axis=1)
    telling = both >= COMPARED_POINTS
    looked_at, share = looked_at[telling], sums[telling, 1] / both[telling]
    count = len(share)
    smooth = np.array(
        [np.median(share[max(0, k - SMOOTHED) : k + SMOOTHED + 1]) for k in range(count)]
    )
    way_m = np.array([nodes[index].way_m for index in looked_at.tolist()])
    found: list[Contradiction] = []
    run: list[int] = []
    for k in [*range(count), -1]:
        is_high = k >= 0 and smooth[k] > CONTRADICTED_SHARE
        if is_high and (not run or way_m[k] - way_m[run[-1]] < PASS_APART_M):
            run.append(k)
            continue
        if len(run) >= SHORTEST[passes]:
            rows = looked_at[run]
            middle = int(rows[len(rows) // 2])
            against = pairs[(pairs[:, 0] == middle), 1]
            x_m, y_m = T_map_nodes[middle, :2, 2].tolist()
            found.append(
                Contradiction(
                    x_m,
                    y_m,
                    nodes[int(rows[0])].scan.stamp_ns,
                    nodes[int(rows[-1])].scan.stamp_ns,
                    float(smooth[run].max()),
                    passes,
                    nodes[int(against[0])].scan.stamp_ns,
                )
            )
        run = [k] if is_high else []
    return found
