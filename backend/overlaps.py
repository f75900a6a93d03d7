"""Which scans see the same: pairs of nodes near each other in space, whenever they were there."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datasets.messages import Array

Indices = npt.NDArray[np.int64]

NEXT_IN_TIME = 3
ONE_PASS_GAP = 6
"""Nodes whose numbers differ by more belong to different passes of the place."""
FARTHEST = 1.6


FULL_VIEW = 0.6
"""Length of the mean direction of a scan that sees half the plane; a full turn has none."""


def views_of(bearings_rad: Array, starts: Indices) -> Array:
    """(N, 2) where each scan looks: the mean of its points' directions, in the base's axes.

    bearings_rad : (P,) of the points of all scans, one scan after the other; starts : (N + 1,).
    The length tells how one-sided a scan is: 1 a single direction, 0 all around.
    """
    counts = np.maximum(np.diff(starts), 1)
    sums = [
        np.concatenate([[0.0], np.cumsum(part)])
        for part in (np.cos(bearings_rad), np.sin(bearings_rad))
    ]
    mean = np.column_stack([total[starts[1:]] - total[starts[:-1]] for total in sums])
    return mean / counts[:, None]


def overlapping_pairs(
    nodes_xyyaw: Array, views: Array, reach_m: float, neighbours: int
) -> tuple[Indices, Indices]:
    """Pairs (earlier, later) of nodes worth matching.

    nodes_xyyaw : (N, 3) in the map, in the order of time; views : (N, 2), see ``views_of``.

    Each node is paired with the NEXT_IN_TIME before it and with up to ``neighbours`` others within
    reach_m: first the nearest of each pass of the place, so that no pass is left out, then the
    nearest of all (nearness: distance / reach + angle between the views / 2 rad, the angle counting
    less the more a scan sees all around).
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415

    count = len(nodes_xyyaw)
    chains = [
        (np.arange(count - k), np.arange(k, count))
        for k in range(1, min(NEXT_IN_TIME, count - 1) + 1)
    ]
    near = cKDTree(nodes_xyyaw[:, :2]).query_pairs(reach_m, output_type="ndarray").astype(np.int64)
    near = near[near[:, 1] - near[:, 0] > NEXT_IN_TIME]
    apart = nodes_xyyaw[near[:, 1]] - nodes_xyyaw[near[:, 0]]
    facing = nodes_xyyaw[:, 2] + np.arctan2(views[:, 1], views[:, 0])
    one_sided = np.minimum(np.hypot(views[:, 0], views[:, 1]) / FULL_VIEW, 1.0)
    turn = facing[near[:, 1]] - facing[near[:, 0]]
    turn = np.abs(np.arctan2(np.sin(turn), np.cos(turn)))
    turn *= np.minimum(one_sided[near[:, 0]], one_sided[near[:, 1]])
    cost = np.hypot(apart[:, 0], apart[:, 1]) / reach_m + turn / 2.0
    near, cost = near[cost < FARTHEST], cost[cost < FARTHEST]
    by_node = np.lexsort((near[:, 0], near[:, 1]))
    near, cost = near[by_node], cost[by_node]
    # a pass of the place: a run of consecutive node numbers among a node's neighbours
    new_pass = np.ones(len(near), dtype=bool)
    new_pass[1:] = (near[1:, 1] != near[:-1, 1]) | (near[1:, 0] - near[:-1, 0] > ONE_PASS_GAP)
    passes = np.cumsum(new_pass)
    best_first = np.lexsort((cost, passes))
    leads = np.zeros(len(near), dtype=bool)
    first_of_pass = np.ones(len(near), dtype=bool)
    first_of_pass[1:] = np.diff(passes[best_first]) > 0
    leads[best_first[first_of_pass]] = True
    ranked = np.lexsort((cost, ~leads, near[:, 1]))
    near = near[ranked]
    starts = np.ones(len(near), dtype=bool)
    starts[1:] = np.diff(near[:, 1]) > 0
    begin = np.maximum.accumulate(np.where(starts, np.arange(len(near)), 0))
    near = near[np.arange(len(near)) - begin < neighbours]
    from_nodes = np.concatenate([*(a for a, _ in chains), near[:, 0]])
    to_nodes = np.concatenate([*(b for _, b in chains), near[:, 1]])
    by_pair = np.lexsort((from_nodes, to_nodes))
    return from_nodes[by_pair], to_nodes[by_pair]
