"""The pose graph in GTSAM: all of it at once (``optimise``), or while running (``PoseGraph``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from backend.constraint import Constraint
from backend.graph_arrays import ConstraintArrays, Mask, first_nodes
from backend.graph_factors import Loss, add_anchor, add_constraints, poses_of, values_of
from backend.graph_start import synchronised
from datasets.messages import Array
from datasets.se2 import between, inverse, pose_matrices, wrapped_rad, xyyaw, xyyaw_rows

if TYPE_CHECKING:
    import gtsam

# Gauss-Newton converges quadratically: after a step this small the next is below a micrometre.
SMALL_STEP_M = 1e-3
SMALL_STEP_RAD = 1e-4
SMALL_GAIN = 1e-7
# With a robust loss, and damped, steps shrink by a factor: there the error must tell.
SMALL_ROBUST_GAIN = 1e-5
POLISHING_STEPS = 5
# Half of chi2 for each constraint: 30 times what is expected where information is right.
BAD_ERROR = 50.0

# While running. A threshold for metres and radians alike: GTSAM has one number for both.
RELINEARISE = 0.1
PENDING_NODES = 64
SETTLING_UPDATES = 5
SETTLED_M = 0.5
SETTLED_RAD = 0.05
# What nothing observes is held where it was put, by about as much as a map is wide.
HELD_SIGMA = 100.0


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

    Gauss-Newton from the start given. Where that raises the error or meets a direction that no
    constraint observes, Levenberg-Marquardt goes on from there, or from ``synchronised`` poses
    where these are better; it leaves such a direction where it was. Where the error stays far
    above what the information promises, ``synchronised`` poses are tried as well.

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

    gain = SMALL_GAIN if robust[0] is None else SMALL_ROBUST_GAIN
    found, steps, state = _gauss_newton(graph, start, ordering, iterations, gain)
    if state != "failed" and graph.error(values_of(found)) < BAD_ERROR * len(arrays):
        return found, steps, state == "converged"
    fresh = synchronised(start, arrays, anchors)
    if state == "converged":  # maybe to the wrong side of half a turn
        other, more, _ = _gauss_newton(graph, fresh, ordering, iterations, gain)
        better = graph.error(values_of(other)) < graph.error(values_of(found))
        return (other if better else found), steps + more, True
    if graph.error(values_of(fresh)) < graph.error(values_of(found)):
        found = fresh
    cap = max(iterations - steps, 1)
    found, more, converged = _levenberg_marquardt(graph, found, ordering, cap)
    steps += more
    if converged:  # damped steps end early in weak directions
        found, more, _ = _gauss_newton(graph, found, ordering, POLISHING_STEPS, gain)
        steps += more
    return found, steps, converged


def _gauss_newton(
    graph: gtsam.NonlinearFactorGraph,
    start: Array,
    ordering: gtsam.Ordering,
    iterations: int,
    gain: float,
) -> tuple[Array, int, Literal["converged", "capped", "failed"]]:
    """Poses, steps taken, and how it ended; failed: the last good poses."""
    import gtsam  # noqa: PLC0415

    parameters = gtsam.GaussNewtonParams()
    parameters.setOrdering(ordering)
    optimiser = gtsam.GaussNewtonOptimizer(graph, values_of(start), parameters)
    found, error = start, optimiser.error()
    for step in range(1, iterations + 1):
        try:
            optimiser.iterate()
        except RuntimeError:  # an unobserved direction
            return found, step, "failed"
        new_error = optimiser.error()
        if not new_error <= error * (1.0 + gain) + 1e-9:
            return found, step, "failed"
        new = poses_of(optimiser.values())
        moved = new - found
        turned = np.abs(wrapped_rad(moved[:, 2])).max()
        settled = np.abs(moved[:, :2]).max() < SMALL_STEP_M and turned < SMALL_STEP_RAD
        if settled or error - new_error <= gain * error:
            return new, step, "converged"
        found, error = new, new_error
    return found, iterations, "capped"


def _levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph, start: Array, ordering: gtsam.Ordering, iterations: int
) -> tuple[Array, int, bool]:
    import gtsam  # noqa: PLC0415

    # Damping that follows how well each step was predicted; tried against fixed factors, it takes
    # two thirds of the time on M3500b.
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setUseFixedLambdaFactor(False)
    parameters.setlambdaInitial(1e-3)
    parameters.setOrdering(ordering)
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(SMALL_ROBUST_GAIN)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values_of(start), parameters)
    found = poses_of(optimiser.optimizeSafely())
    return found, optimiser.iterations(), optimiser.iterations() < iterations


class PoseGraph:
    """The graph while running: incremental smoothing (iSAM2) over nodes 0, 1, 2, ...

    A node waits with its constraints, at the pose it was given, until a loop closure comes or 64
    wait: as long as the graph is a chain, its poses are what the front end composed. Measured on
    1500 nodes with 340-380 closures: add and update 2.3-4.1 ms at the 99th percentile, worst 14.

    Cholesky is five times faster than QR here, and fails only where a direction is not observed;
    the graph is then built again once, by QR, with every node held loosely where it was put.
    Source: Kaess et al., iSAM2, IJRR 2012.
    """

    def __init__(self) -> None:
        self._constraints: list[Constraint] = []
        self._waiting_poses: list[Array] = []
        self._taken_nodes = 0
        self._taken_constraints = 0
        self._closure_waits = False
        self._held = False
        self._isam2 = _new_isam2(held=False)

    def __len__(self) -> int:
        return self._taken_nodes + len(self._waiting_poses)

    def add_node(self, T_map_node: Array) -> int:
        """A node at its predicted pose; the first one anchors the map. Returns its number."""
        if T_map_node.shape != (3, 3) or not np.isfinite(T_map_node).all():
            raise ValueError("T_map_node must be a finite (3, 3) matrix")
        self._waiting_poses.append(T_map_node)
        return len(self) - 1

    def add_constraint(self, constraint: Constraint) -> None:
        """A measurement between two nodes that are in the graph."""
        ends = (constraint.from_node, constraint.to_node)
        if ends[0] == ends[1] or min(ends) < 0 or max(ends) >= len(self):
            raise ValueError(f"a constraint must join two of the {len(self)} nodes, not {ends}")
        self._constraints.append(constraint)
        self._closure_waits |= constraint.kind == "loop"

    def update(self) -> None:
        """Take in what waits, if a closure is among it or enough has gathered."""
        if self._closure_waits or len(self._waiting_poses) >= PENDING_NODES:
            self._take()

    def pose(self, node: int) -> Array:
        """T_map_node, (3, 3)."""
        if node >= self._taken_nodes:
            return self._waiting_poses[node - self._taken_nodes].copy()
        found = self._isam2.calculateEstimatePose2(node)
        return pose_matrices(np.array([[found.x(), found.y(), found.theta()]]))[0]

    def poses(self) -> Array:
        """All T_map_node, (N, 3, 3)."""
        taken = pose_matrices(self._taken_xyyaw())
        return np.concatenate([taken, np.array(self._waiting_poses).reshape(-1, 3, 3)])

    def marginal_covariance(self, node: int) -> Array:
        """Covariance (3, 3) of a node's pose in the map, in the node's axes: x, y, yaw.

        Takes in what waits. Costs 0.02 ms for the newest node, 0.1 ms for any.
        """
        self._take()
        covariance: Array = np.asarray(self._isam2.marginalCovariance(node))
        return covariance

    def relative_covariance(self, a: int, b: int) -> Array:
        """Covariance (3, 3) of the pose of b seen from a, in the axes of b: x, y, yaw.

        Exact to first order, correlations included. Takes in what waits; costs 2.5 ms.
        """
        self._take()
        joint = self._isam2.jointMarginalCovariance([a, b])
        T_b_a = inverse(self.pose(b)) @ self.pose(a)
        x, y, _ = xyyaw(T_b_a)
        adjoint = T_b_a.copy()
        adjoint[:2, 2] = y, -x
        J = np.hstack([-adjoint, np.eye(3)])
        both = np.block([[joint.at(a, a), joint.at(a, b)], [joint.at(b, a), joint.at(b, b)]])
        covariance: Array = J @ both @ J.T
        return covariance

    def _take(self) -> None:
        if not self._waiting_poses and self._taken_constraints == len(self._constraints):
            return
        new = ConstraintArrays.of(self._constraints[self._taken_constraints :])
        nodes = xyyaw_rows(np.array(self._waiting_poses).reshape(-1, 3, 3))
        try:
            self._feed(nodes, new, self._taken_nodes)
            self._settle(nodes)
        except RuntimeError:  # a direction that nothing observes
            if self._held:
                raise
            # What iSAM2 has estimated is in doubt now, what it was last linearised at is not.
            before = poses_of(self._isam2.getLinearizationPoint())[: self._taken_nodes]
            self._held, self._isam2 = True, _new_isam2(held=True)
            everything = ConstraintArrays.of(self._constraints)
            self._feed(np.vstack([before, nodes]), everything, 0)
            self._settle(nodes)
        self._taken_nodes += len(nodes)
        self._taken_constraints = len(self._constraints)
        self._waiting_poses = []
        self._closure_waits = False

    def _feed(self, nodes: Array, constraints: ConstraintArrays, first: int) -> None:
        import gtsam  # noqa: PLC0415

        graph = gtsam.NonlinearFactorGraph()
        if first == 0 and len(nodes):
            add_anchor(graph, 0, nodes[0])
        if self._held:
            for node, given in enumerate(nodes, start=first):
                add_anchor(graph, node, given, HELD_SIGMA)
        add_constraints(graph, constraints)
        self._isam2.update(graph, values_of(nodes, first))

    def _settle(self, nodes: Array) -> None:
        """After a closure that moved the newest of the ``nodes`` far, iterate.

        The update that takes a closure moves only the linear solution; each further one is a
        Gauss-Newton step on what moved. After 100 m of drift three are enough. Where little
        moved, the next closure does as well.
        """
        if not self._closure_waits or not len(nodes):
            return
        last = self._isam2.calculateEstimatePose2(self._taken_nodes + len(nodes) - 1)
        x, y, yaw = between(nodes[-1:], np.array([[last.x(), last.y(), last.theta()]]))[0]
        if np.hypot(x, y) < SETTLED_M and abs(yaw) < SETTLED_RAD:
            return
        for _ in range(SETTLING_UPDATES):
            if self._isam2.update().getVariablesRelinearized() == 0:
                return

    def _taken_xyyaw(self) -> Array:
        if not self._taken_nodes:
            return np.zeros((0, 3))
        return poses_of(self._isam2.calculateEstimate())


def _new_isam2(*, held: bool) -> gtsam.ISAM2:
    import gtsam  # noqa: PLC0415

    parameters = gtsam.ISAM2Params()
    kinds = gtsam.ISAM2Params.Factorization
    parameters.factorization = kinds.QR if held else kinds.CHOLESKY
    parameters.relinearizeSkip = 1
    parameters.enablePartialRelinearizationCheck = True
    parameters.setRelinearizeThreshold(RELINEARISE)
    return gtsam.ISAM2(parameters)
