"""Which loop closures agree with each other: pairwise consistency maximisation.

Two closures and the odometry between their ends make a cycle. If both are right it closes within
what odometry and the two measurements are unsure of. Closures that agree with near ones form
groups; groups that contradict others are left out, the one with the most contradictions first.
Source: Mangelson et al., Pairwise Consistent Measurement Set Maximization, ICRA 2018; the
maximum clique by greedy removal, as long as contradictions are left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from backend.graph import optimise
from backend.graph_arrays import ConstraintArrays, Indices, Mask, pseudo_inverses
from datasets.messages import Array
from datasets.se2 import adjoints, between, compose, logarithm, pose_matrices, xyyaw_rows

# chi2 with 3 degrees of freedom: one in a thousand, and the median.
CHI2_LIMIT = 16.27
CHI2_MEDIAN = 2.366

NEAR_NODES = 30  # both ends of two near closures together are no further apart
NEAR_CLOSURES = 8
GROUP_MOST = 10
GROUPS_COMPARED = 200
# Below this many pairs a scale is not to be had from their median.
PAIRS_FOR_SCALE = 10


@dataclass(frozen=True, slots=True)
class OdometryChain:
    """Dead reckoning over all nodes. xyyaw : (N, 3). spread : (N, 3, 3), covariance gathered from
    node 0 on, of twists in the axes of the origin, so that differences hold between any two."""

    xyyaw: Array
    spread: Array


@dataclass(frozen=True, slots=True)
class Consistency:
    """What the closures say of each other.

    scale     : factor >= 1 by which covariances are too small, from the median of near pairs.
    groups    : (M,) int64, closures near each other that agree, at most 10 in one group.
    support   : (M,) int64, near closures that agree with each.
    contrary  : (M,) bool, groups left out because they contradict others.
    conflicts : (M,) int64, closures that each one's group contradicted.
    """

    scale: float
    groups: Indices
    support: Indices
    contrary: Mask
    conflicts: Indices


def odometry_chain(nodes_xyyaw: Array, known: ConstraintArrays) -> OdometryChain:
    """The poses by the known constraints alone, and how far they can have drifted.

    Only constraints between neighbouring nodes lower the drift, so it is an upper bound; where a
    step was not measured, anything goes.
    """
    X = xyyaw_rows(optimise(pose_matrices(nodes_xyyaw), known).T_map_nodes)
    information = np.tile(np.eye(3) * 1e-6, (len(X), 1, 1))
    forward = np.flatnonzero(known.to_nodes - known.from_nodes == 1)
    np.add.at(information, known.to_nodes[forward], known.information[forward])
    steps = adjoints(X) @ np.linalg.inv(information) @ np.swapaxes(adjoints(X), 1, 2)
    steps[0] = 0.0
    return OdometryChain(X, np.cumsum(steps, axis=0))


def consistency(chain: OdometryChain, loops: ConstraintArrays) -> Consistency:
    """Compare closures that are near each other, then the groups which these form."""
    count = len(loops)
    near = _pairs(loops, NEAR_NODES, NEAR_CLOSURES)
    chi2 = cycle_chi2(chain, loops, near)
    scale = 1.0
    if len(near) > PAIRS_FOR_SCALE:
        scale = max(1.0, float(np.median(chi2)) / CHI2_MEDIAN)
    agreeing = near[chi2 <= CHI2_LIMIT * scale]
    support = np.bincount(agreeing.ravel(), minlength=count)
    groups = _groups(loops, agreeing)
    sizes = np.bincount(groups, minlength=int(groups.max(initial=-1)) + 1)
    order = np.argsort(groups, kind="stable")
    first = np.cumsum(sizes) - sizes
    middle = order[first + sizes // 2]

    compared = loops.pick(middle)
    pairs = _pairs(compared, np.inf, GROUPS_COMPARED)
    against = pairs[cycle_chi2(chain, compared, pairs) > CHI2_LIMIT * scale]
    left_out, conflicts = _without_contradictions(against, sizes)
    return Consistency(scale, groups, support, left_out[groups], conflicts[groups])


def cycle_chi2(chain: OdometryChain, loops: ConstraintArrays, pairs: Indices) -> Array:
    """Squared Mahalanobis length, (P,), of the misclosure of each pair's cycle.

    pairs : (P, 2) rows of ``loops``. The cycle of k, l: back through k, along the odometry from
    k's first end to l's, through l, and along the odometry to k's second end.
    """
    z, covariance, a, b = _forwards(loops)
    k, l = pairs[:, 0], pairs[:, 1]  # noqa: E741
    first, first_covariance = _odometry(chain, a[k], a[l])
    second, second_covariance = _odometry(chain, b[l], b[k])
    rest = compose(z[l], second)
    error = logarithm(between(z[k], compose(first, rest)))
    origin = np.zeros_like(error)
    to_end, through_l = adjoints(between(second, origin)), adjoints(between(rest, origin))
    total = (
        covariance[k]
        + second_covariance
        + to_end @ covariance[l] @ np.swapaxes(to_end, 1, 2)
        + through_l @ first_covariance @ np.swapaxes(through_l, 1, 2)
    )
    return np.einsum("mi,mij,mj->m", error, _inverses(total), error)


def _inverses(covariances: Array) -> Array:
    """(P, 3, 3); where one is singular, as of closures that claim to be exact, pseudo-inverses."""
    try:
        return np.asarray(np.linalg.inv(covariances), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(covariances, hermitian=True), dtype=np.float64)


def _forwards(loops: ConstraintArrays) -> tuple[Array, Array, Indices, Indices]:
    """Measurements with their covariances, all told from the earlier node to the later."""
    a, b = loops.from_nodes, loops.to_nodes
    back = a > b
    covariance = pseudo_inverses(loops.information)
    turned = adjoints(loops.xyyaw)
    covariance = np.where(
        back[:, None, None], turned @ covariance @ np.swapaxes(turned, 1, 2), covariance
    )
    inverted = between(loops.xyyaw, np.zeros_like(loops.xyyaw))
    z = np.where(back[:, None], inverted, loops.xyyaw)
    return z, covariance, np.where(back, b, a), np.where(back, a, b)


def _odometry(chain: OdometryChain, i: Indices, j: Indices) -> tuple[Array, Array]:
    """Pose of nodes j seen from i by odometry, and its covariance in the axes of j."""
    low, high = np.minimum(i, j), np.maximum(i, j)
    origin = np.zeros((len(i), 3))
    to_j = adjoints(between(chain.xyyaw[j], origin))
    gathered = chain.spread[high] - chain.spread[low]
    return between(chain.xyyaw[i], chain.xyyaw[j]), to_j @ gathered @ np.swapaxes(to_j, 1, 2)


def _pairs(loops: ConstraintArrays, within: float, most: int) -> Indices:
    """Rows of closures (P, 2), each with its ``most`` nearest by the nodes of both their ends."""
    from scipy.spatial import KDTree  # noqa: PLC0415

    if len(loops) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    ends = np.sort(np.column_stack([loops.from_nodes, loops.to_nodes]), axis=1).astype(float)
    neighbours = min(most + 1, len(loops))
    _, found = KDTree(ends).query(ends, k=neighbours, p=1, distance_upper_bound=within)
    mine = np.repeat(np.arange(len(loops)), neighbours)
    other = np.asarray(found).ravel()
    real = (other < len(loops)) & (other != mine)
    pairs = np.sort(np.column_stack([mine[real], other[real]]), axis=1).astype(np.int64)
    return np.unique(pairs, axis=0)


def _groups(loops: ConstraintArrays, agreeing: Indices) -> Indices:
    """Group of each closure (M,): connected by agreement, cut into runs of at most 10."""
    from scipy.sparse import coo_matrix  # noqa: PLC0415
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    count = len(loops)
    links = coo_matrix(
        (np.ones(len(agreeing)), (agreeing[:, 0], agreeing[:, 1])), shape=(count, count)
    )
    _, parts = connected_components(links, directed=False)
    order = np.lexsort((np.minimum(loops.from_nodes, loops.to_nodes), parts))
    sizes = np.bincount(parts)
    rank = np.arange(count) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    groups = np.empty(count, dtype=np.int64)
    runs = parts[order] * (count + 1) + rank // GROUP_MOST
    groups[order] = np.unique(runs, return_inverse=True)[1]
    return groups


def _without_contradictions(against: Indices, sizes: npt.NDArray[np.int64]) -> tuple[Mask, Indices]:
    """Leave out groups, most contradicted for their size first, until no two contradict."""
    count = len(sizes)

    def contradicted(pairs: Indices) -> Array:
        weight = np.bincount(pairs[:, 0], sizes[pairs[:, 1]].astype(float), count)
        weight += np.bincount(pairs[:, 1], sizes[pairs[:, 0]].astype(float), count)
        return np.asarray(weight, dtype=np.float64)

    conflicts = contradicted(against).astype(np.int64)
    left_out = np.zeros(count, dtype=bool)
    while len(against):
        worst = int(np.argmax(contradicted(against) / np.sqrt(sizes)))
        left_out[worst] = True
        against = against[(against != worst).all(axis=1)]
    return left_out, conflicts
