"""The pose graph: analytic cases, known graphs recovered, agreement of its two forms."""

from __future__ import annotations

import numpy as np
import pytest

from backend.constraint import Constraint
from backend.graph import optimise
from backend.graph_arrays import (
    ConstraintArrays,
    between,
    compose,
    pose_matrices,
    square_roots,
    xyyaw_rows,
)
from datasets.messages import Array
from datasets.se2 import se2


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
