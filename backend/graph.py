"""The pose graph in GTSAM: all of it at once (``optimise``), or while running (``PoseGraph``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from backend.constraint import Constraint
from backend.graph_arrays import (
    ConstraintArrays,
    Mask,
    pose_matrices,
    wrapped_rad,
    xyyaw_rows,
)
from backend.graph_factors import Loss, add_anchor, add_constraints, poses_of, values_of
from datasets.messages import Array

if TYPE_CHECKING:
    import gtsam

# Gauss-Newton converges quadratically: after a step this small the next is below a micrometre.
SMALL_STEP_M = 1e-3
SMALL_STEP_RAD = 1e-4
SMALL_GAIN = 1e-5


@dataclass(frozen=True, slots=True)
class Optimised:
    """What the batch optimisation found.

    T_map_nodes : (N, 3, 3).
    chi2        : sum of the squared Mahalanobis residuals, without any robust loss.
    iterations  : linear systems solved.
    converged   : False where the cap on iterations came first.
    """

    T_map_nodes: Array
    chi2: float
    iterations: int
    converged: bool


def optimise(
    T_map_nodes: Array,
    constraints: ConstraintArrays | Sequence[Constraint],
    *,
    loss: Loss | None = None,
    loss_scale: float = 2.0,
    suspects: Mask | None = None,
    iterations: int = 30,
) -> Optimised:
    """Find the poses that agree best with all constraints.

    T_map_nodes : (N, 3, 3), start, not changed. The first node of each connected part stays.
    loss        : robust loss on the constraints marked by ``suspects`` ((M,), default all), with
                  its bend at ``loss_scale`` standard deviations.

    Gauss-Newton from the start given; where that raises the error or meets a direction that no
    constraint observes, Levenberg-Marquardt, which leaves such a direction where it was.

    Raises ValueError for a constraint on a node that is not there.
    """
    arrays = (
        constraints
        if isinstance(constraints, ConstraintArrays)
        else ConstraintArrays.of(constraints)
    )
    start = xyyaw_rows(T_map_nodes)
    if not len(arrays):
        return Optimised(T_map_nodes.copy(), 0.0, 0, True)
    found, steps, converged = _solve(start, arrays, (loss, loss_scale, suspects), iterations)
    chi2 = float(arrays.chi2(found).sum())
    return Optimised(pose_matrices(found), chi2, steps, converged)


def _solve(
    start: Array,
    arrays: ConstraintArrays,
    robust: tuple[Loss | None, float, Mask | None],
    iterations: int,
) -> tuple[Array, int, bool]:
    import gtsam  # noqa: PLC0415

    graph = gtsam.NonlinearFactorGraph()
    anchors = first_nodes(len(start), arrays)
    for node in anchors:
        add_anchor(graph, node, start[node])
    add_constraints(graph, arrays, *robust)
    # METIS halves the cost of dense graphs, and aborts on nodes that nothing joins.
    dense = len(arrays) > 3 * len(start) > 300 and len(anchors) == 1
    order = gtsam.Ordering.MetisNonlinearFactorGraph if dense else None
    ordering = (order or gtsam.Ordering.ColamdNonlinearFactorGraph)(graph)

    parameters = gtsam.GaussNewtonParams()
    parameters.setOrdering(ordering)
    best, best_xyyaw = values_of(start), start
    optimiser = gtsam.GaussNewtonOptimizer(graph, best, parameters)
    error = optimiser.error()
    for step in range(1, iterations + 1):
        try:
            optimiser.iterate()
        except RuntimeError:  # an unobserved direction
            return _solve_damped(graph, best, ordering, step, iterations)
        new_error = optimiser.error()
        if not new_error <= error * (1.0 + SMALL_GAIN) + 1e-9:
            return _solve_damped(graph, best, ordering, step, iterations)
        values = optimiser.values()
        new_xyyaw = poses_of(values)
        moved = np.abs(new_xyyaw - best_xyyaw)
        moved[:, 2] = np.abs(wrapped_rad(moved[:, 2]))
        settled = moved[:, :2].max() < SMALL_STEP_M and moved[:, 2].max() < SMALL_STEP_RAD
        if settled or error - new_error <= SMALL_GAIN * error:
            return new_xyyaw, step, True
        best, best_xyyaw, error = values, new_xyyaw, new_error
    return best_xyyaw, iterations, False


def _solve_damped(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    ordering: gtsam.Ordering,
    steps: int,
    iterations: int,
) -> tuple[Array, int, bool]:
    """Levenberg-Marquardt from where Gauss-Newton was last good."""
    import gtsam  # noqa: PLC0415

    cap = max(iterations - steps, 1)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setOrdering(ordering)
    parameters.setMaxIterations(cap)
    parameters.setRelativeErrorTol(SMALL_GAIN)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    found = poses_of(optimiser.optimizeSafely())
    return found, steps + optimiser.iterations(), optimiser.iterations() < cap


def first_nodes(count: int, arrays: ConstraintArrays) -> list[int]:
    """The lowest node of each connected part of a graph of ``count`` nodes, ascending."""
    from scipy.sparse import coo_matrix  # noqa: PLC0415
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    if max(arrays.from_nodes.max(), arrays.to_nodes.max()) >= count:
        raise ValueError(f"a constraint names a node beyond the {count} there are")
    ones = np.ones(len(arrays))
    links = coo_matrix((ones, (arrays.from_nodes, arrays.to_nodes)), shape=(count, count))
    _, labels = connected_components(links, directed=False)
    firsts = np.unique(labels, return_index=True)[1]
    return sorted(firsts.tolist())
