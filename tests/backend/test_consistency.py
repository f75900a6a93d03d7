"""Cycles of two closures and odometry: closed forms, and closures that contradict others."""

from __future__ import annotations

import numpy as np
import pytest

from backend.consistency import consistency, cycle_chi2, odometry_chain
from backend.graph_arrays import ConstraintArrays
from datasets.messages import Array
from datasets.se2 import between, compose


def straight(count: int, sigma: float) -> tuple[Array, ConstraintArrays]:
    """Nodes 1 m apart on the x axis with exact odometry of a given sigma (m and rad)."""
    nodes = np.column_stack([np.arange(float(count)), np.zeros((count, 2))])
    a = np.arange(count - 1)
    information = np.tile(np.eye(3) / sigma**2, (count - 1, 1, 1))
    return nodes, ConstraintArrays(a, a + 1, between(nodes[a], nodes[a + 1]), information)


def closures(
    nodes: Array, ends: list[tuple[int, int]], errors: Array, sigma: float
) -> ConstraintArrays:
    a, b = np.array(ends).T
    exact = between(nodes[a], nodes[b])
    information = np.tile(np.eye(3) / sigma**2, (len(ends), 1, 1))
    return ConstraintArrays(a, b, compose(exact, errors), information)


def test_a_cycle_counts_each_side_once() -> None:
    """2 steps on one side, 3 on the other, 2 closures; only x disagrees, by 0.7 m.

    Along a straight line x is free of lever arms: its variance is the plain sum.
    """
    nodes, odometry = straight(30, 0.1)
    loops = closures(nodes, [(3, 20), (5, 23)], np.array([[0.0, 0, 0], [0.7, 0, 0]]), 0.2)
    chain = odometry_chain(nodes, odometry)
    chi2 = cycle_chi2(chain, loops, np.array([[0, 1]]))
    assert chi2[0] == pytest.approx(0.7**2 / (5 * 0.1**2 + 2 * 0.2**2), rel=1e-3)


def test_a_cycle_is_the_same_from_either_end_and_in_either_order() -> None:
    nodes, odometry = straight(30, 0.1)
    rng = np.random.default_rng(0)
    loops = closures(nodes, [(3, 20), (5, 23)], rng.normal(0.0, 0.02, (2, 3)), 0.05)
    turned = ConstraintArrays(
        loops.to_nodes,
        loops.from_nodes,
        between(loops.xyyaw, np.zeros((2, 3))),
        loops.information,
    )
    chain = odometry_chain(nodes, odometry)
    pair = np.array([[0, 1]])
    chi2 = cycle_chi2(chain, loops, pair)
    assert cycle_chi2(chain, loops, pair[:, ::-1]) == pytest.approx(chi2, rel=0.02)
    assert cycle_chi2(chain, turned, pair) == pytest.approx(chi2, rel=0.35)  # lever arms


def test_cycles_of_right_measurements_are_chi_squared() -> None:
    """Noise as declared: the cycles' squared lengths have mean 3 and median 2.37."""
    nodes, exact = straight(40, 0.02)
    rng = np.random.default_rng(4)
    found = []
    for _ in range(300):
        noisy = compose(exact.xyyaw, rng.normal(0.0, 0.02, (39, 3)))
        odometry = ConstraintArrays(exact.from_nodes, exact.to_nodes, noisy, exact.information)
        loops = closures(nodes, [(2, 30), (6, 35)], rng.normal(0.0, 0.05, (2, 3)), 0.05)
        chain = odometry_chain(nodes, odometry)
        found.append(float(cycle_chi2(chain, loops, np.array([[0, 1]]))[0]))
    assert np.mean(found) == pytest.approx(3.0, rel=0.15)
    assert np.median(found) == pytest.approx(2.37, rel=0.2)


def test_the_closure_that_contradicts_the_others_is_left_out() -> None:
    nodes, odometry = straight(60, 0.01)
    ends = [(2, 40), (4, 43), (6, 45), (9, 50), (5, 44)]
    errors = np.zeros((5, 3))
    errors[4] = (1.5, 0.5, 0.3)
    said = consistency(odometry_chain(nodes, odometry), closures(nodes, ends, errors, 0.05))
    assert said.contrary.tolist() == [False, False, False, False, True]
    assert said.support[:4].min() >= 3
    assert said.support[4] == 0
    assert said.conflicts[4] == 4


def test_a_group_of_false_closures_falls_to_a_larger_group() -> None:
    """Three that agree with each other, as a repeated door would, against six."""
    nodes, odometry = straight(100, 0.01)
    right = [(k, k + 50) for k in range(0, 18, 3)]
    wrong = [(k, k + 50) for k in range(30, 39, 3)]
    errors = np.vstack([np.zeros((6, 3)), np.tile([2.0, 0.0, 0.0], (3, 1))])
    loops = closures(nodes, right + wrong, errors, 0.05)
    said = consistency(odometry_chain(nodes, odometry), loops)
    assert said.contrary.tolist() == [False] * 6 + [True] * 3
    assert said.support.min() >= 1


def test_too_small_covariances_show_in_the_scale() -> None:
    nodes, odometry = straight(120, 0.01)
    rng = np.random.default_rng(2)
    ends = [(k, k + 60) for k in range(0, 50, 2)]
    loops = closures(nodes, ends, rng.normal(0.0, 0.5, (25, 3)), 0.5)
    honest = consistency(odometry_chain(nodes, odometry), loops)
    assert honest.scale < 1.6
    boasting = loops.weighted(np.full(25, 100.0))
    said = consistency(odometry_chain(nodes, odometry), boasting)
    assert said.scale == pytest.approx(100.0, rel=0.5)
    assert not said.contrary.any()


def test_one_closure_has_nothing_to_be_compared_with() -> None:
    nodes, odometry = straight(10, 0.1)
    loops = closures(nodes, [(1, 8)], np.zeros((1, 3)), 0.1)
    said = consistency(odometry_chain(nodes, odometry), loops)
    assert (said.scale, said.support.tolist(), said.contrary.tolist()) == (1.0, [0], [False])
