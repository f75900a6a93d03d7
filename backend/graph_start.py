"""A start for the batch optimisation from the constraints alone, where the given one is bad."""

from __future__ import annotations

import numpy as np

from backend.graph_arrays import ConstraintArrays, Indices, square_roots
from backend.graph_factors import ANCHOR_SIGMA, MAX_INFORMATION
from datasets.messages import Array
from datasets.se2 import wrapped_rad

# Where nothing was measured a trace of information keeps both linear systems solvable.
LEAST_INFORMATION = 1e-6


def synchronised(nodes_xyyaw: Array, constraints: ConstraintArrays, anchors: list[int]) -> Array:
    """Poses (N, 3) by two linear problems: first all yaws, then, those held, all positions.

    nodes_xyyaw : (N, 3); only the rows of ``anchors``, one node for each connected part, count,
                  and positions in directions that nothing observes.

    No start is needed, and large errors in heading do not matter: from here the MIT, Intel and
    CSAIL graphs converge in 2-4 steps. Costs about as much as two steps of Gauss-Newton.
    Source: Carlone et al., Initialization techniques for 3D SLAM, ICRA 2015 (chordal).
    """
    yaws_rad = _yaws(nodes_xyyaw, constraints, anchors)
    return np.column_stack([_positions(nodes_xyyaw, yaws_rad, constraints, anchors), yaws_rad])


def _yaws(nodes_xyyaw: Array, constraints: ConstraintArrays, anchors: list[int]) -> Array:
    import gtsam  # noqa: PLC0415

    noise, factor = gtsam.noiseModel.Isotropic, gtsam.BetweenFactorRot2
    graph = gtsam.NonlinearFactorGraph()
    # fastSyncRot2 takes one prior: the other anchors are held by the first.
    held, first = noise.Sigma(1, ANCHOR_SIGMA), anchors[0]
    graph.addPriorRot2(first, gtsam.Rot2(float(nodes_xyyaw[first, 2])), held)
    for node in anchors[1:]:
        yaw_rad = float(nodes_xyyaw[node, 2] - nodes_xyyaw[first, 2])
        graph.add(factor(first, node, gtsam.Rot2(yaw_rad), held))
    precision = constraints.information[:, 2, 2].clip(LEAST_INFORMATION, MAX_INFORMATION)
    for a, b, yaw_rad, p in zip(
        constraints.from_nodes.tolist(),
        constraints.to_nodes.tolist(),
        constraints.xyyaw[:, 2].tolist(),
        precision.tolist(),
        strict=True,
    ):
        graph.add(factor(a, b, gtsam.Rot2(yaw_rad), noise.Precision(1, p)))
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    found = gtsam.fastSyncRot2(graph, ordering)
    return np.array([found.atRot2(node).theta() for node in range(len(nodes_xyyaw))])


def _positions(
    nodes_xyyaw: Array, yaws_rad: Array, constraints: ConstraintArrays, anchors: list[int]
) -> Array:
    """Weighted least squares in the positions, with what the yaws leave as known residuals."""
    from scipy.sparse import csc_matrix, diags_array  # noqa: PLC0415
    from scipy.sparse.linalg import spsolve  # noqa: PLC0415

    a, b, n = constraints.from_nodes, constraints.to_nodes, len(yaws_rad)
    measured, rows = constraints.xyyaw, len(constraints)
    roots = square_roots(constraints.information, MAX_INFORMATION)
    # residual = R_measured^T (R_a^T (t_b - t_a) - t_measured), to first order in the yaws
    in_to_axes = roots[:, :, :2] @ _turns(-measured[:, 2])
    slopes = in_to_axes @ _turns(-yaws_rad[a])
    known = np.einsum("mij,mj->mi", in_to_axes, measured[:, :2])
    known -= roots[:, :, 2] * wrapped_rad(yaws_rad[b] - yaws_rad[a] - measured[:, 2])[:, None]

    row = np.broadcast_to(np.arange(3 * rows).reshape(rows, 3, 1), (rows, 3, 2)).ravel()
    J = csc_matrix(
        (
            np.concatenate([slopes.ravel(), -slopes.ravel()]),
            (np.tile(row, 2), np.concatenate([_columns(b), _columns(a)])),
        ),
        shape=(3 * rows, 2 * n),
    )
    weak = np.full(2 * n, LEAST_INFORMATION)
    held = 2 * np.repeat(anchors, 2) + np.tile([0, 1], len(anchors))
    weak[held] += ANCHOR_SIGMA**-2
    target = weak * nodes_xyyaw[:, :2].ravel()
    found = spsolve(csc_matrix(J.T @ J + diags_array(weak)), J.T @ known.ravel() + target)
    positions: Array = np.asarray(found, dtype=np.float64).reshape(n, 2)
    return positions


def _columns(nodes: Indices) -> Indices:
    columns = 2 * nodes[:, None, None] + np.arange(2)
    return np.broadcast_to(columns, (len(nodes), 3, 2)).ravel()


def _turns(angles_rad: Array) -> Array:
    """Rotation matrices (M, 2, 2)."""
    c, s = np.cos(angles_rad), np.sin(angles_rad)
    return np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
