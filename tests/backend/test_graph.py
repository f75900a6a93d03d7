"""The pose graph: analytic cases, known graphs recovered, agreement of its two forms."""

from __future__ import annotations

import numpy as np
import pytest

from backend.constraint import Constraint
from backend.graph import PoseGraph, optimise
from backend.graph_arrays import ConstraintArrays, square_roots
from backend.graph_start import synchronised
from datasets.messages import Array
from datasets.se2 import between, compose, inverse, pose_matrices, se2, xyyaw_rows


def constraint(a: int, b: int, pose: tuple[float, float, float], information: Array) -> Constraint:
    return Constraint(a, b, se2(*pose), information, "odometry")


def square_loop(rng: np.random.Generator, side: int = 5) -> tuple[Array, ConstraintArrays]:
    """Poses (4 * side, 3) on a square of 1 m steps, and noisy constraints that close it."""
    steps = np.array([(1.0, 0.0, np.pi / 2 if i % side == side - 1 else 0.0) for i in range(80)])
    poses = [np.zeros(3)]
    for step in steps[: 4 * side - 1]:
        poses.append(compose(poses[-1][None], step[None])[0])
    truth = np.array(poses)
    n = len(truth)
    from_nodes, to_nodes = np.arange(n), (np.arange(n) + 1) % n
    sigmas = np.array([0.05, 0.02, 0.01])
    exact = between(truth[from_nodes], truth[to_nodes])
    measured = compose(exact, rng.normal(0.0, 1.0, (n, 3)) * sigmas)
    information = np.tile(np.diag(sigmas**-2.0), (n, 1, 1))
    return truth, ConstraintArrays(from_nodes, to_nodes, measured, information)


def test_a_line_measured_twice_shares_its_misclosure() -> None:
    info = np.diag([100.0, 100.0, 1e4])
    constraints = [
        constraint(0, 1, (1.0, 0.0, 0.0), info),
        constraint(1, 2, (1.0, 0.0, 0.0), info),
        constraint(0, 2, (2.3, 0.0, 0.0), info),
    ]
    start = np.array([se2(0, 0, 0), se2(0.7, 0.2, 0.1), se2(2.5, -0.3, -0.2)])
    result = optimise(start, constraints)
    expected = [(0, 0, 0), (1.1, 0, 0), (2.2, 0, 0)]
    np.testing.assert_allclose(xyyaw_rows(result.T_map_nodes), expected, atol=1e-6)
    assert result.chi2 == pytest.approx(3 * 100.0 * 0.1**2, rel=1e-6)
    assert result.converged


def test_a_triangle_with_exact_measurements_is_found_from_a_bad_start() -> None:
    truth = np.array([(0.3, -0.2, 0.4), (4.0, 0.5, 2.5), (1.0, 3.0, -2.0)])
    a, b = np.array([0, 1, 2]), np.array([1, 2, 0])
    info = np.tile(np.diag([50.0, 80.0, 300.0]), (3, 1, 1))
    arrays = ConstraintArrays(a, b, between(truth[a], truth[b]), info)
    start = truth + np.array([(0, 0, 0), (1.0, -1.0, 1.2), (-0.5, 1.0, -1.2)])
    result = optimise(pose_matrices(start), arrays)
    np.testing.assert_allclose(result.T_map_nodes, pose_matrices(truth), atol=1e-6)


def test_information_is_in_the_axes_of_the_to_node() -> None:
    """Node 1 looks along map y: what is sure along its x must fix the map's y, and only that."""
    constraints = [
        constraint(0, 1, (1.0, 0.0, np.pi / 2), np.diag([1e6, 1e-3, 1e6])),
        constraint(0, 1, (1.2, 0.4, np.pi / 2), np.diag([1.0, 1.0, 1.0])),
    ]
    result = optimise(np.array([se2(0, 0, 0), se2(0.5, 0.5, 1.4)]), constraints)
    x, y, yaw = xyyaw_rows(result.T_map_nodes)[1]
    assert (x, y, yaw) == pytest.approx((1.2, 0.0, np.pi / 2), abs=1e-3)


def test_an_unobserved_direction_is_taken_from_the_constraint_that_sees_it() -> None:
    """A corridor's match knows nothing along the corridor (45 deg here); odometry does."""
    along = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    match = np.diag([400.0, 400.0, 1e4])
    match -= 400.0 * np.outer(along, along)
    assert np.linalg.matrix_rank(match) == 2
    constraints = [
        constraint(0, 1, (1.0, 1.0, 0.0), np.diag([1.0, 1.0, 1.0])),
        constraint(0, 1, (5.0, 5.2, 0.0), match),
    ]
    x, y, _ = xyyaw_rows(optimise(np.array([se2(0, 0, 0)] * 2), constraints).T_map_nodes)[1]
    assert x + y == pytest.approx(2.0, abs=1e-3)
    assert y - x == pytest.approx(0.2, abs=1e-3)


def test_a_direction_that_nothing_observes_stays_at_its_start() -> None:
    constraints = [constraint(0, 1, (1.0, 7.0, 0.1), np.diag([100.0, 0.0, 1e4]))]
    result = optimise(np.array([se2(0, 0, 0), se2(1.4, 0.5, 0.1)]), constraints)
    x, y, yaw = xyyaw_rows(result.T_map_nodes)[1]
    assert np.hypot(x - 1.4, y - 0.5) == pytest.approx(
        abs(np.cos(0.1) * 0.4 + np.sin(0.1) * (0.5 - 7.0)), abs=1e-3
    )
    assert yaw == pytest.approx(0.1, abs=1e-6)


def test_parts_that_are_not_joined_each_keep_their_first_node() -> None:
    info = np.diag([100.0, 100.0, 100.0])
    constraints = [
        constraint(0, 2, (1.0, 0.0, 0.0), info),
        constraint(3, 1, (0.0, 2.0, 0.0), info),
    ]
    start = np.array([se2(0, 0, 0), se2(5, 5, 0), se2(0.5, 0, 0), se2(5, 4, 0), se2(9, 9, 1)])
    found = xyyaw_rows(optimise(start, constraints).T_map_nodes)
    expected = [(0, 0, 0), (5, 5, 0), (1, 0, 0), (5, 3, 0), (9, 9, 1)]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_square_loop_is_recovered_within_its_noise() -> None:
    normalised = []
    for seed in range(20):
        truth, arrays = square_loop(np.random.default_rng(seed))
        result = optimise(pose_matrices(truth), arrays)
        normalised.append(result.chi2)
    # 3 equations close the loop: 3 degrees of freedom, so a mean of 3 with a sigma of 0.55.
    assert np.mean(normalised) == pytest.approx(3.0, abs=1.6)


def test_a_robust_loss_on_suspects_holds_against_a_false_closure() -> None:
    truth, arrays = square_loop(np.random.default_rng(3))
    false = ConstraintArrays(
        np.append(arrays.from_nodes, 2),
        np.append(arrays.to_nodes, 12),
        np.vstack([arrays.xyyaw, [[0.0, 0.0, 0.0]]]),
        np.concatenate([arrays.information, arrays.information[:1]]),
    )
    suspects = np.arange(len(false)) == len(arrays)
    start = pose_matrices(truth)

    def error_m(loss: str | None) -> float:
        found = optimise(start, false, loss=loss, suspects=suspects)  # type: ignore[arg-type]
        return float(np.abs(found.T_map_nodes[:, :2, 2] - truth[:, :2]).max())

    assert error_m(None) > 1.0
    assert error_m("geman-mcclure") < 0.3
    assert error_m("geman-mcclure") < error_m("huber") < error_m(None)


def test_without_any_start_the_constraints_alone_give_one() -> None:
    truth, arrays = square_loop(np.random.default_rng(7))
    blank = np.zeros_like(truth)
    blank[0] = truth[0]
    found = synchronised(blank, arrays, [0])
    np.testing.assert_allclose(found[:, :2], truth[:, :2], atol=0.4)
    result = optimise(pose_matrices(blank), arrays)
    best = optimise(pose_matrices(truth), arrays)
    np.testing.assert_allclose(result.T_map_nodes, best.T_map_nodes, atol=1e-3)


def test_without_any_start_each_part_keeps_its_first_node() -> None:
    truth, arrays = square_loop(np.random.default_rng(7))
    count = len(truth)
    aside = np.array([20.0, 5.0, 0.0])
    both = np.vstack([truth, truth + aside])
    twice = ConstraintArrays(
        np.concatenate([arrays.from_nodes, arrays.from_nodes + count]),
        np.concatenate([arrays.to_nodes, arrays.to_nodes + count]),
        np.vstack([arrays.xyyaw, arrays.xyyaw]),
        np.concatenate([arrays.information, arrays.information]),
    )
    blank = np.zeros_like(both)
    blank[[0, count]] = both[[0, count]]
    found = synchronised(blank, twice, [0, count])
    np.testing.assert_allclose(found[count:, :2], found[:count, :2] + aside[:2], atol=1e-3)
    np.testing.assert_allclose(found[:, :2], both[:, :2], atol=0.4)


def test_the_same_graph_gives_the_same_bits() -> None:
    truth, arrays = square_loop(np.random.default_rng(5))
    first = optimise(pose_matrices(truth), arrays, loss="cauchy")
    again = optimise(pose_matrices(truth), arrays, loss="cauchy")
    assert first.T_map_nodes.tobytes() == again.T_map_nodes.tobytes()


def test_a_constraint_on_a_missing_node_is_named() -> None:
    with pytest.raises(ValueError, match="beyond the 2"):
        optimise(np.array([np.eye(3)] * 2), [constraint(0, 2, (1, 0, 0), np.eye(3))])


def test_roots_of_rank_deficient_information_multiply_back() -> None:
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(50, 3, 3))
    roots[::2, 2] = 0.0
    information = np.swapaxes(roots, 1, 2) @ roots
    found = square_roots(information)
    np.testing.assert_allclose(np.swapaxes(found, 1, 2) @ found, information, atol=1e-9)
    with pytest.raises(ValueError, match="negative eigenvalue"):
        square_roots(np.diag([1.0, -0.1, 1.0])[None])


def running(truth: Array, arrays: ConstraintArrays, start: Array) -> PoseGraph:
    """The graph fed node by node: chain constraints as odometry, the others as closures."""
    graph = PoseGraph()
    for node in range(len(truth)):
        assert graph.add_node(start[node]) == node
        newest = np.maximum(arrays.from_nodes, arrays.to_nodes)
        for row in np.flatnonzero(newest == node):
            a, b = int(arrays.from_nodes[row]), int(arrays.to_nodes[row])
            T = pose_matrices(arrays.xyyaw[row : row + 1])[0]
            kind = "odometry" if abs(a - b) == 1 else "loop"
            graph.add_constraint(Constraint(a, b, T, arrays.information[row], kind))
        graph.update()
    return graph


def test_the_running_graph_agrees_with_the_batch() -> None:
    truth, arrays = square_loop(np.random.default_rng(1))
    start = pose_matrices(truth + np.random.default_rng(2).normal(0.0, 0.1, truth.shape))
    start[0] = pose_matrices(truth)[0]
    graph = running(truth, arrays, start)
    batch = optimise(start, arrays).T_map_nodes
    np.testing.assert_allclose(graph.poses(), batch, atol=2e-3)
    np.testing.assert_allclose(graph.pose(7), batch[7], atol=2e-3)
    np.testing.assert_allclose(graph.pose(0), start[0], atol=1e-9)


def test_a_chain_waits_at_the_poses_it_was_given() -> None:
    graph = PoseGraph()
    given = np.array([se2(0, 0, 0), se2(1.0, 0.1, 0.2), se2(2, 0, 0.1)])
    for node, T in enumerate(given):
        graph.add_node(T)
        if node:
            graph.add_constraint(constraint(node - 1, node, (1, 0, 0), np.eye(3) * 100))
        graph.update()
    np.testing.assert_array_equal(graph.poses(), given)
    assert len(graph) == 3


def test_a_closure_after_100_m_of_drift_converges() -> None:
    """Four sides of 25 m with a steady turn of 0.03 rad/m in the odometry: 26 m off at the end."""
    n = 300
    corner = np.where((np.arange(n - 1) + 1) % (n // 4) == 0, np.pi / 2, 0.0)
    steps = np.column_stack([np.full(n - 1, 100 / n), np.zeros(n - 1), corner])
    truth, chain = [np.zeros(3)], [np.zeros(3)]
    measured = steps + np.array([0.0, 0.0, 3.0 / n])
    for step, seen in zip(steps, measured, strict=True):
        truth.append(compose(truth[-1][None], step[None])[0])
        chain.append(compose(chain[-1][None], seen[None])[0])
    assert np.hypot(*(chain[-1] - truth[-1])[:2]) > 25.0
    closure = between(np.array(truth[:1]), np.array(truth[-1:]))
    arrays = ConstraintArrays(
        np.append(np.arange(n - 1), 0),
        np.append(np.arange(1, n), n - 1),
        np.vstack([measured, closure]),
        np.tile(np.diag([0.02**-2, 0.02**-2, 0.01**-2]), (n, 1, 1)),
    )
    graph = running(np.array(truth), arrays, pose_matrices(np.array(chain)))
    batch = optimise(pose_matrices(np.array(chain)), arrays)
    np.testing.assert_allclose(graph.poses()[:, :2, 2], batch.T_map_nodes[:, :2, 2], atol=0.02)
    assert np.hypot(*(graph.pose(n - 1)[:2, 2] - truth[-1][:2])) < 0.05


def test_covariances_are_those_of_many_repetitions() -> None:
    """The spread of 400 noisy squares, solved, is what the graph says of one of them."""
    a, b, node = 4, 12, 10
    lonely, relative = [], []
    for seed in range(400):
        truth, arrays = square_loop(np.random.default_rng(seed))
        T = optimise(pose_matrices(truth), arrays).T_map_nodes
        exact = pose_matrices(truth)
        lonely.append(xyyaw_rows((inverse(exact[node]) @ T[node])[None])[0])
        seen = inverse(inverse(exact[a]) @ exact[b]) @ inverse(T[a]) @ T[b]
        relative.append(xyyaw_rows(seen[None])[0])
    graph = running(truth, arrays, pose_matrices(truth))
    for errors, covariance in (
        (np.array(lonely), graph.marginal_covariance(node)),
        (np.array(relative), graph.relative_covariance(a, b)),
    ):
        squared = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors)
        assert squared.mean() == pytest.approx(3.0, rel=0.15)
        np.testing.assert_allclose(np.sqrt(np.diag(covariance)), errors.std(axis=0), rtol=0.12)


def test_an_unobserved_direction_does_not_stop_the_running_graph() -> None:
    graph = PoseGraph()
    for node in range(6):
        graph.add_node(se2(float(node), 0.3 * node, 0.0))
        if node:
            info = np.diag([0.0 if node == 3 else 100.0, 100.0, 1e4])
            graph.add_constraint(constraint(node - 1, node, (1, 0, 0), info))
    graph.add_constraint(Constraint(0, 2, se2(2, 0, 0), np.diag([100.0, 100, 1e4]), "loop"))
    graph.update()
    found = xyyaw_rows(graph.poses())
    expected = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0), (4, 0, 0), (5, 0, 0)]
    np.testing.assert_allclose(found[:, 1:], np.array(expected)[:, 1:], atol=0.02)
    np.testing.assert_allclose(np.diff(found[:, 0])[[0, 1, 3, 4]], 1.0, atol=0.01)
    assert graph.marginal_covariance(5)[0, 0] > 10.0  # nobody knows how far along
    assert graph.marginal_covariance(2)[0, 0] < 0.1


def test_a_constraint_on_a_node_to_come_is_refused() -> None:
    graph = PoseGraph()
    graph.add_node(np.eye(3))
    with pytest.raises(ValueError, match="two of the 1 nodes"):
        graph.add_constraint(constraint(0, 1, (1, 0, 0), np.eye(3)))
