"""From the poses of a few nodes to those of all: exact, continuous, and theirs where known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.spread import spread
from datasets.messages import Array
from datasets.se2 import between, pose_matrices, se2, xyyaw_rows

SEEDS = st.integers(0, 2**32 - 1)


def wandering(random: np.random.Generator, count: int) -> Array:
    """(N, 3, 3) poses a few decimetres apart."""
    poses = [se2(*random.uniform(-10.0, 10.0, 2), random.uniform(-3.1, 3.1))]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se2(random.uniform(0.0, 0.4), 0.0, random.normal(0.0, 0.3)))
    return np.array(poses)


def ways(T: Array) -> Array:
    steps = np.hypot(*np.diff(T[:, :2, 2], axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)]) + 1e-3 * np.arange(len(T))


@settings(deadline=None)
@given(seed=SEEDS, count=st.integers(1, 40), known=st.integers(1, 6))
def test_one_correction_for_all_is_kept_exactly(seed: int, count: int, known: int) -> None:
    random = np.random.default_rng(seed)
    T_odom = wandering(random, count)
    T_map_odom = se2(*random.uniform(-50.0, 50.0, 2), random.uniform(-3.1, 3.1))
    fixed = np.sort(random.choice(count, size=min(known, count), replace=False))
    T_map = spread(fixed, T_map_odom @ T_odom[fixed], T_odom, ways(T_odom))
    assert T_map == pytest.approx(T_map_odom @ T_odom, abs=1e-9)


@settings(deadline=None)
@given(seed=SEEDS, count=st.integers(2, 40), known=st.integers(1, 6))
def test_known_poses_are_kept_and_the_ends_go_along(seed: int, count: int, known: int) -> None:
    random = np.random.default_rng(seed)
    T_odom = wandering(random, count)
    fixed = np.sort(random.choice(count, size=min(known, count), replace=False))
    corrections = np.array(
        [se2(*random.uniform(-2.0, 2.0, 2), random.uniform(-0.5, 0.5)) for _ in range(len(fixed))]
    )
    T_fixed = corrections @ T_odom[fixed]
    T_map = spread(fixed, T_fixed, T_odom, ways(T_odom))
    assert T_map[fixed] == pytest.approx(T_fixed, abs=1e-9)
    first, last = fixed[0], fixed[-1]
    assert T_map[:first] == pytest.approx(corrections[0] @ T_odom[:first], abs=1e-9)
    assert T_map[last:] == pytest.approx(corrections[-1] @ T_odom[last:], abs=1e-9)


@settings(deadline=None)
@given(seed=SEEDS)
def test_nothing_jumps(seed: int) -> None:
    """Small corrections change each step by no more than their share of it."""
    random = np.random.default_rng(seed)
    T_odom = wandering(random, 200)
    fixed = np.arange(10, 200, 30)
    sizes = np.array([0.3, 0.3, 0.1])
    corrections = pose_matrices(random.uniform(-1.0, 1.0, (len(fixed), 3)) * sizes)
    centre = np.array([se2(*T_odom[k, :2, 2], 0.0) for k in fixed])
    T_fixed = centre @ corrections @ np.linalg.inv(centre) @ T_odom[fixed]
    T_map = spread(fixed, T_fixed, T_odom, ways(T_odom))
    before, after = xyyaw_rows(T_odom), xyyaw_rows(T_map)
    change = between(after[:-1], after[1:]) - between(before[:-1], before[1:])
    change[:, 2] = np.arctan2(np.sin(change[:, 2]), np.cos(change[:, 2]))
    assert np.abs(change[:, :2]).max() < 0.25
    assert np.abs(change[:, 2]).max() < 0.06


def test_a_correction_is_shared_out_by_the_way() -> None:
    """Straight on for 1, 2 and 1 m; the end is to lie 0.4 m further: 0.1, 0.2 and 0.1 m each."""
    T_odom = np.array([se2(x, 0.0, 0.0) for x in (0.0, 1.0, 3.0, 4.0)])
    T_fixed = np.array([se2(0.0, 0.0, 0.0), se2(4.4, 0.0, 0.0)])
    T_map = spread(np.array([0, 3]), T_fixed, T_odom, np.array([0.0, 1.0, 3.0, 4.0]))
    assert T_map[:, 0, 2] == pytest.approx([0.0, 1.1, 3.3, 4.4])
    T_fixed[1] = se2(4.0, 0.0, 0.4)
    T_map = spread(np.array([0, 3]), T_fixed, T_odom, np.array([0.0, 1.0, 3.0, 4.0]))
    assert xyyaw_rows(T_map)[:, 2] == pytest.approx([0.0, 0.1, 0.3, 0.4])


def test_headings_are_shared_out_the_shorter_way_round() -> None:
    T_odom = np.array([se2(0.0, 0.0, 3.1)] * 3)
    T_fixed = np.array([se2(0.0, 0.0, 3.1), se2(0.0, 0.0, -3.1)])
    T_map = spread(np.array([0, 2]), T_fixed, T_odom, np.arange(3.0))
    assert math.cos(xyyaw_rows(T_map)[1, 2] - math.pi) == pytest.approx(1.0)


def test_standing_still_between_two_known_poses_divides_by_nothing() -> None:
    T_odom = np.array([np.eye(3)] * 4)
    T_map = spread(np.array([0, 3]), T_odom[[0, 3]], T_odom, np.zeros(4))
    assert np.isfinite(T_map).all()
