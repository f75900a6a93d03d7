"""Covariances of many pairs at once, against the dense inverse and against GTSAM."""

from __future__ import annotations

import numpy as np
import pytest

from backend.graph_arrays import ConstraintArrays
from backend.graph_covariance import relative_covariances
from backend.graph_factors import add_anchor, add_constraints, values_of
from datasets.messages import Array
from datasets.se2 import adjoints, between


def graph(seed: int) -> tuple[Array, ConstraintArrays, ConstraintArrays]:
    """60 nodes at random, a chain with 25 closures and exact measurements; 20 pairs asked."""
    rng = np.random.default_rng(seed)
    nodes = rng.normal(0.0, 1.0, (60, 3)) * (5.0, 5.0, 2.0)
    a = np.concatenate([np.arange(59), rng.integers(0, 30, 45)])
    b = np.concatenate([np.arange(1, 60), rng.integers(30, 60, 45)])
    roots = rng.normal(size=(len(a), 3, 3)) * (10.0, 20.0, 50.0)
    information = np.swapaxes(roots, 1, 2) @ roots
    everything = ConstraintArrays(a, b, between(nodes[a], nodes[b]), information)
    return nodes, everything.pick(np.arange(84)), everything.pick(np.arange(84, 104))


def test_they_are_those_of_the_dense_inverse() -> None:
    nodes, constraints, queries = graph(0)
    H = np.eye(3 * len(nodes)) * 1e-6
    H[:3, :3] += np.eye(3) * 1e6
    J_from = -adjoints(between(nodes[constraints.to_nodes], nodes[constraints.from_nodes]))
    for a, b, J, info in zip(
        constraints.from_nodes,
        constraints.to_nodes,
        J_from,
        constraints.information,
        strict=True,
    ):
        rows = np.r_[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]
        both = np.hstack([J, np.eye(3)])
        H[np.ix_(rows, rows)] += both.T @ info @ both
    dense = np.linalg.inv(H)
    found = relative_covariances(nodes, constraints, queries)
    for row, (a, b) in enumerate(zip(queries.from_nodes, queries.to_nodes, strict=True)):
        rows = np.r_[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]
        J = np.hstack([-adjoints(between(nodes[b : b + 1], nodes[a : a + 1]))[0], np.eye(3)])
        expected = J @ dense[np.ix_(rows, rows)] @ J.T
        np.testing.assert_allclose(found[row], expected, rtol=1e-5, atol=1e-12)


def test_they_are_those_of_gtsam() -> None:
    import gtsam

    nodes, constraints, queries = graph(1)
    factors = gtsam.NonlinearFactorGraph()
    add_anchor(factors, 0, nodes[0])
    add_constraints(factors, constraints)
    marginals = gtsam.Marginals(factors, values_of(nodes))
    found = relative_covariances(nodes, constraints, queries)
    for row, (a, b) in enumerate(zip(queries.from_nodes, queries.to_nodes, strict=True)):
        joint = marginals.jointMarginalCovariance([int(a), int(b)])
        T_b_a = between(nodes[b : b + 1], nodes[a : a + 1])
        J = -adjoints(T_b_a)[0]
        cross = J @ joint.at(a, b)
        expected = J @ joint.at(a, a) @ J.T + cross + cross.T + joint.at(b, b)
        np.testing.assert_allclose(found[row], expected, rtol=1e-3, atol=1e-9)


def test_a_single_step_is_known_as_well_as_it_was_measured() -> None:
    nodes = np.array([(0.0, 0.0, 0.3), (2.0, 1.0, -1.0), (9.0, 9.0, 0.0)])
    step = ConstraintArrays(
        np.array([0]),
        np.array([1]),
        between(nodes[:1], nodes[1:2]),
        np.diag([100.0, 400.0, 1e4])[None],
    )
    asked = ConstraintArrays(
        np.array([0, 0]), np.array([1, 2]), np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1))
    )
    known, unknown = relative_covariances(nodes, step, asked)
    np.testing.assert_allclose(known, np.diag([0.01, 0.0025, 1e-4]), rtol=1e-3, atol=1e-9)
    # nothing joins node 2: it is held where it was put, as the gauge of its own part
    assert unknown[2, 2] == pytest.approx(2e-6, rel=0.1)


def test_the_same_graph_gives_the_same_bits() -> None:
    nodes, constraints, queries = graph(2)
    first = relative_covariances(nodes, constraints, queries)
    assert first.tobytes() == relative_covariances(nodes, constraints, queries).tobytes()
