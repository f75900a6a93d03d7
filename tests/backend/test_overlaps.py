"""Which nodes are paired, against the rule applied node by node."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.overlaps import (
    FARTHEST,
    FULL_VIEW,
    NEXT_IN_TIME,
    ONE_PASS_GAP,
    overlapping_pairs,
    views_of,
)
from datasets.messages import Array

SEEDS = st.integers(0, 2**32 - 1)


def by_the_rule(
    nodes: Array, views: Array, reach_m: float, neighbours: int
) -> list[tuple[int, int]]:
    """(later, earlier) pairs, sorted."""
    pairs = []
    for late in range(len(nodes)):
        pairs += [(late, late - k) for k in range(1, NEXT_IN_TIME + 1) if late - k >= 0]
        costs = {}
        for early in range(late - NEXT_IN_TIME):
            away_m = math.dist(nodes[late, :2], nodes[early, :2])
            facing = [nodes[k, 2] + math.atan2(views[k, 1], views[k, 0]) for k in (late, early)]
            turn = facing[0] - facing[1]
            turn = abs(math.atan2(math.sin(turn), math.cos(turn)))
            turn *= min(1.0, *(math.hypot(*views[k]) / FULL_VIEW for k in (late, early)))
            cost = away_m / reach_m + turn / 2.0
            if away_m <= reach_m and cost < FARTHEST:
                costs[early] = cost
        passes: list[list[int]] = []
        for early in sorted(costs):
            if passes and early - passes[-1][-1] <= ONE_PASS_GAP:
                passes[-1].append(early)
            else:
                passes.append([early])
        leads = [min(one, key=lambda k: costs[k]) for one in passes]
        rest = [k for k in costs if k not in leads]
        ranked = sorted(leads, key=lambda k: costs[k]) + sorted(rest, key=lambda k: costs[k])
        pairs += [(late, early) for early in ranked[:neighbours]]
    return sorted(pairs)


def ahead(count: int) -> Array:
    """Scans that see the half plane ahead."""
    return np.tile([0.64, 0.0], (count, 1))


def drive(random: np.random.Generator, count: int, size_m: float) -> Array:
    """(N, 3) poses going round and round."""
    turn = np.cumsum(random.uniform(0.1, 0.3, count))
    radius = size_m * (1.0 + 0.2 * np.sin(0.1 * turn))
    places = radius[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    places += random.normal(0.0, 0.05, places.shape)
    yaws = turn + random.choice([0.0, math.pi], count, p=[0.8, 0.2])
    return np.column_stack([places, np.arctan2(np.sin(yaws), np.cos(yaws))])


@settings(deadline=None, max_examples=60)
@given(
    seed=SEEDS,
    count=st.integers(1, 90),
    size_m=st.floats(0.3, 5.0),
    reach_m=st.floats(0.2, 4.0),
    neighbours=st.integers(1, 8),
    half=st.booleans(),
)
def test_pairs_are_those_of_the_rule(
    seed: int, count: int, size_m: float, reach_m: float, neighbours: int, half: bool
) -> None:
    random = np.random.default_rng(seed)
    nodes = drive(random, count, size_m)
    views = np.tile([0.64, 0.0], (count, 1)) if half else random.normal(0.0, 0.4, (count, 2))
    early, late = overlapping_pairs(nodes, views, reach_m, neighbours)
    found = list(zip(late.tolist(), early.tolist(), strict=True))
    assert found == by_the_rule(nodes, views, reach_m, neighbours)
    assert (early < late).all()
    assert early.dtype == late.dtype == np.int64


def test_no_pass_of_a_place_is_left_out() -> None:
    """Three laps; the last but one is much nearer than the first: both are among the pairs."""
    lap = np.column_stack([np.arange(20) * 0.2, np.zeros(20), np.zeros(20)])
    elsewhere = np.column_stack([100.0 + np.arange(30), np.zeros(30), np.zeros(30)])
    first, second, third = (lap + np.array([0.0, offset, 0.0]) for offset in (1.5, 0.1, 0.0))
    drive = np.concatenate([first, elsewhere, second, elsewhere, third])
    early, late = overlapping_pairs(drive, ahead(len(drive)), 2.5, 3)
    of_middle = early[(late == 110) & (early < 107)]
    assert set(of_middle.tolist()) == {10, 60, 106}, "of each lap the nearest"


def test_a_node_is_not_paired_beyond_its_reach_or_turned_away() -> None:
    nodes = np.zeros((12, 3))
    nodes[:, 0] = np.arange(12) * 100.0
    nodes[8] = [0.0, 2.6, 0.0]  # out of reach of node 0
    nodes[9] = [100.0, 1.0, 0.0]  # within reach of node 1
    nodes[10] = [200.0, 1.0, math.pi]  # near node 2 but looking the other way: cost 0.4 + 1.57
    early, late = overlapping_pairs(nodes, ahead(12), 2.5, 6)
    far = [(int(a), int(b)) for a, b in zip(early, late, strict=True) if b - a > NEXT_IN_TIME]
    assert far == [(1, 9)]


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_nodes_are_paired_with_all_before_them(count: int) -> None:
    early, late = overlapping_pairs(np.zeros((count, 3)), ahead(count), 2.5, 6)
    wanted = [(a, b) for b in range(count) for a in range(b)]
    assert list(zip(early.tolist(), late.tolist(), strict=True)) == sorted(
        wanted, key=lambda pair: pair[::-1]
    )


def test_two_lidars_that_look_the_same_way_are_paired_whatever_the_base_does() -> None:
    """Out with the front lidar, back with the rear one; a full turn looks every way."""
    out_and_back = np.zeros((40, 3))
    out_and_back[:, 0] = np.concatenate([np.arange(20), np.arange(20)[::-1]]) * 0.5
    out_and_back[20:, 1:] = 0.2, math.pi
    front, rear = np.array([0.64, 0.0]), np.array([-0.64, 0.0])
    both = np.where(np.arange(40)[:, None] < 20, front, rear)

    def between_legs(views: Array) -> int:
        early, late = overlapping_pairs(out_and_back, views, 2.5, 6)
        return int(np.count_nonzero((early < 16) & (late >= 24)))

    assert between_legs(np.tile(front, (40, 1))) == 0
    assert between_legs(both) > 40
    assert between_legs(np.zeros((40, 2))) > 40


def test_a_view_is_the_mean_direction_of_its_points() -> None:
    half, turn = np.linspace(-1.0, 1.0, 181) * math.pi / 2, np.arange(360) * math.pi / 180
    bearings = np.concatenate([half, turn, half + 1.0, np.empty(0)])
    starts = np.cumsum([0, 181, 360, 181, 0]).astype(np.int64)
    views = views_of(bearings, starts)
    assert views[0] == pytest.approx([2.0 / math.pi, 0.0], abs=0.01)
    assert views[1] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert math.atan2(views[2, 1], views[2, 0]) == pytest.approx(1.0)
    assert not views[3].any()
