"""Which scans become nodes, where submaps end, and how well a chain of steps is known."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import inverse, se2
from frontend.match import Match, Rejected
from frontend.motion import Motion
from frontend.nodes import (
    UNOBSERVED_SIGMA_M,
    Node,
    NodeConfig,
    NodeKeeper,
    carried,
    matched_covariance,
)
from frontend.prepared import PreparedScan
from frontend.tracker import LOST, Tracked
from tests.frontend.rooms import ROOM, moved, prepared

SEEDS = st.integers(0, 2**32 - 1)


@cache
def some_scan() -> PreparedScan:
    return prepared(ROOM, se2(4.5, 3.0, 0.5), beams=90)


def tracked(
    T_odom_base: Array,
    *,
    reason: str | None = None,
    sensor: str = "lidar",
    odometry: bool = True,
    weak_sigma_m: float = 0.01,
    sigma_m: float = 0.02,
) -> Tracked:
    motion = Motion(np.eye(3), sigma_m, 0.03, np.zeros(3), 0.1, odometry)
    outcome: Match | Rejected
    if reason is None:
        outcome = Match(T_odom_base, np.eye(3), 0.9, 0.9, 0.01, weak_sigma_m, np.array([0.6, 0.8]))
    else:
        outcome = Rejected(reason)
    return Tracked(replace(some_scan(), sensor=sensor), T_odom_base, outcome, motion)


def straight(count: int, step_m: float = 0.05) -> list[Tracked]:
    return [tracked(se2(step_m * k, 0.0, 0.0)) for k in range(count)]


def kept(keeper: NodeKeeper, scans: list[Tracked]) -> list[Node]:
    for scan in scans:
        keeper.add(scan)
    return keeper.nodes


def test_nodes_stand_a_step_apart() -> None:
    nodes = kept(NodeKeeper(NodeConfig(step_m=0.2)), straight(101))
    gaps = np.diff([node.T_odom_base[0, 2] for node in nodes])
    assert (gaps > 0.2).all()
    assert (gaps < 0.2 + 0.05 + 1e-9).all()
    assert [node.index for node in nodes] == list(range(len(nodes)))
    assert [node.way_m for node in nodes] == pytest.approx([n.T_odom_base[0, 2] for n in nodes])


def test_turning_on_the_spot_makes_nodes_too() -> None:
    turning = [tracked(se2(0.0, 0.0, 0.07 * k)) for k in range(91)]  # once round
    nodes = kept(NodeKeeper(NodeConfig(step_rad=0.2)), turning)
    assert len(nodes) == 31
    assert nodes[-1].way_m == pytest.approx(0.0)


def test_standing_makes_one_node() -> None:
    assert len(kept(NodeKeeper(NodeConfig()), [tracked(np.eye(3))] * 50)) == 1


def test_the_way_counts_detours_between_nodes() -> None:
    keeper = NodeKeeper(NodeConfig(step_m=0.2))
    there_and_back = [0.0, 0.1, 0.0, 0.1, 0.0, 0.1, 0.3]
    kept(keeper, [tracked(se2(x, 0.0, 0.0)) for x in there_and_back])
    assert keeper.way_m == pytest.approx(0.7)
    assert keeper.nodes[-1].way_m == pytest.approx(0.7)


def test_a_scan_that_was_not_matched_is_no_node_but_its_way_counts() -> None:
    keeper = NodeKeeper(NodeConfig(step_m=0.2))
    scans = straight(30)
    scans[5:15] = [tracked(se2(0.05 * k, 0.0, 0.0), reason="no") for k in range(5, 15)]
    nodes = kept(keeper, scans)
    xs = [node.T_odom_base[0, 2] for node in nodes]
    assert not any(0.24 < x < 0.74 for x in xs)
    assert nodes[-1].way_m == pytest.approx(xs[-1])


def test_the_first_scan_is_a_node_though_there_was_nothing_to_match_it_to() -> None:
    node, done = NodeKeeper(NodeConfig()).add(tracked(np.eye(3), reason="first scan"))
    assert node is not None
    assert done is None
    assert not node.lost


def test_losing_the_thread_ends_a_submap_and_marks_the_next_node() -> None:
    keeper = NodeKeeper(NodeConfig(submap_min_nodes=10))
    kept(keeper, straight(20))
    before = len(keeper.nodes)
    node, done = keeper.add(tracked(se2(0.96, 0.0, 0.0), reason=LOST))
    assert node is not None
    assert node.lost
    assert done is not None
    assert [n.index for n in done.nodes] == list(range(before))
    after = kept(keeper, [tracked(se2(0.96 + 0.1 * k, 0.0, 0.0)) for k in range(1, 6)])
    assert not any(node.lost for node in after[before + 1 :])


@settings(deadline=None, max_examples=25)
@given(
    seed=SEEDS,
    way_m=st.floats(0.5, 6.0),
    fewest=st.integers(1, 12),
    more=st.integers(1, 25),
)
def test_submaps_share_out_all_nodes_in_order(
    seed: int, way_m: float, fewest: int, more: int
) -> None:
    random = np.random.default_rng(seed)
    config = NodeConfig(submap_way_m=way_m, submap_min_nodes=fewest, submap_max_nodes=fewest + more)
    keeper = NodeKeeper(config)
    T = np.eye(3)
    given_out = []
    for _ in range(150):
        T = T @ se2(random.uniform(0.0, 0.3), 0.0, random.normal(0.0, 0.1))
        reason = random.choice([None, None, None, None, "no", LOST], p=[0.24] * 4 + [0.03, 0.01])
        _, done = keeper.add(tracked(T, reason=reason))
        if done is not None:
            given_out.append(done)
    last = keeper.finish()
    assert last is not None
    assert keeper.finish() is None
    assert keeper.submaps == [*given_out, last]
    assert [submap.index for submap in keeper.submaps] == list(range(len(keeper.submaps)))
    assert [n for submap in keeper.submaps for n in submap.nodes] == keeper.nodes
    for submap, after in zip(keeper.submaps[:-1], keeper.submaps[1:], strict=True):
        assert len(submap.nodes) <= config.submap_max_nodes
        assert not any(node.lost for node in submap.nodes[1:])
        if not after.nodes[0].lost and len(submap.nodes) < config.submap_max_nodes:
            assert after.nodes[0].way_m - submap.nodes[0].way_m >= way_m
            assert len(submap.nodes) >= fewest


def test_each_sensor_has_nodes_of_its_own() -> None:
    keeper = NodeKeeper(NodeConfig(step_m=0.2))
    scans = [tracked(se2(0.05 * k, 0.0, 0.0), sensor="ab"[k % 2]) for k in range(60)]
    nodes = kept(keeper, scans)
    for sensor in "ab":
        xs = np.array([n.T_odom_base[0, 2] for n in nodes if n.scan.sensor == sensor])
        assert len(xs) > 8
        assert (np.diff(xs) > 0.2).all()


def test_a_submap_stands_in_the_frame_of_its_middle_node() -> None:
    keeper = NodeKeeper(NodeConfig())
    kept(keeper, [tracked(se2(0.3 * k, 0.1 * k, 0.1 * k)) for k in range(5)])
    submap = keeper.finish()
    assert submap is not None
    assert submap.anchor is submap.nodes[2]
    assert submap.T_anchor_base(submap.anchor) == pytest.approx(np.eye(3))
    first = submap.nodes[0]
    T = submap.anchor.T_odom_base @ submap.T_anchor_base(first)
    assert pytest.approx(first.T_odom_base) == T
    drawn = submap.draw([])
    assert drawn.score(submap.anchor.scan.points_base, np.eye(3)) > 0.9


# ---- how well a chain is known -------------------------------------------------------------------


def logarithms(matrices: Array) -> Array:
    """(N, 3) twists of poses near the identity, (N, 3, 3)."""
    yaw = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    half = 0.5 * yaw
    scale = np.where(np.abs(half) < 1e-6, 1.0, half / np.tan(np.where(half == 0.0, 1.0, half)))
    x, y = matrices[:, 0, 2], matrices[:, 1, 2]
    return np.column_stack([scale * x + half * y, scale * y - half * x, yaw])


@settings(deadline=None, max_examples=30)
@given(seed=SEEDS)
def test_carried_is_what_a_small_error_before_the_step_becomes_after_it(seed: int) -> None:
    """By finite differences, to first order and exactly."""
    random = np.random.default_rng(seed)
    T_a_b = se2(*random.uniform(-3.0, 3.0, 2), random.uniform(-3.1, 3.1))
    step = 1e-6
    errors = [inverse(T_a_b) @ moved(step * unit, 1.0) @ T_a_b for unit in np.eye(3)]
    J = logarithms(np.array(errors)).T / step
    root = random.normal(size=(3, 3))
    covariance = root @ root.T
    assert carried(covariance, T_a_b) == pytest.approx(J @ covariance @ J.T, rel=1e-4, abs=1e-4)


def test_a_carried_chain_is_that_of_many_noisy_drives() -> None:
    """Every step has an error in the axes of its end; the sum of all, as the keeper adds it up."""
    random = np.random.default_rng(6)
    steps = [se2(0.4, 0.05, 0.2)] * 12
    sigmas = np.array([0.01, 0.004, 0.006])
    covariance, T_true = np.zeros((3, 3)), np.eye(3)
    noisy = np.tile(np.eye(3), (4000, 1, 1))
    for step in steps:
        covariance = carried(covariance, step) + np.diag(sigmas**2)
        T_true = T_true @ step
        twists = sigmas * random.standard_normal((len(noisy), 3))
        noisy = noisy @ step @ np.array([moved(twist, 1.0) for twist in twists])
    measured = np.cov(logarithms(inverse(T_true) @ noisy).T)
    ratios = np.linalg.eigvals(np.linalg.solve(covariance, measured)).real
    assert (ratios > 0.85).all()
    assert (ratios < 1.15).all()


def step_of(*scans: Tracked) -> Array:
    """The covariance of the step to the second node of these scans."""
    nodes = kept(NodeKeeper(NodeConfig(step_m=0.2)), list(scans))
    assert len(nodes) == 2
    assert not nodes[0].step_covariance.any()
    assert nodes[1].step_covariance == pytest.approx(nodes[1].step_covariance.T)
    return nodes[1].step_covariance


START, END = tracked(np.eye(3)), tracked(se2(0.25, 0.0, 0.02))


def test_a_matched_step_is_known_by_its_length_however_many_scans_it_has() -> None:
    expected = matched_covariance(END.T_odom_base)
    between = [tracked(se2(0.01 * k, 0.0, 0.0)) for k in range(1, 19)]
    assert step_of(START, END) == pytest.approx(expected)
    assert step_of(START, *between, END) == pytest.approx(expected)
    longer = matched_covariance(se2(1.0, 0.0, 0.5))
    assert (np.linalg.eigvalsh(longer - expected) > 0.0).all()


def test_a_match_makes_good_for_scans_before_it_that_had_none() -> None:
    blind = [tracked(se2(0.05 * k, 0.0, 0.0), reason="no") for k in range(1, 4)]
    assert step_of(START, *blind, END) == pytest.approx(step_of(START, END))


def test_a_lost_step_is_known_by_what_was_predicted_and_worse_without_odometry() -> None:
    def lost(*, odometry: bool, scans: int) -> Array:
        blind = [
            tracked(se2(0.02 * k, 0.0, 0.0), reason="no", odometry=odometry)
            for k in range(1, scans)
        ]
        end = tracked(END.T_odom_base, reason=LOST, odometry=odometry)
        values: Array = np.linalg.eigvalsh(step_of(START, *blind, end))
        return values

    matched = np.linalg.eigvalsh(step_of(START, END))
    assert (lost(odometry=True, scans=4) > matched).all()
    assert (lost(odometry=True, scans=8) > lost(odometry=True, scans=4)).all()
    assert (lost(odometry=False, scans=4) > lost(odometry=True, scans=4)).all()


def test_where_the_match_observed_nothing_the_prediction_holds() -> None:
    covariance = step_of(START, tracked(END.T_odom_base, weak_sigma_m=3.0, sigma_m=0.3))
    weak, across = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    assert math.sqrt(weak @ covariance[:2, :2] @ weak) == pytest.approx(0.3, rel=0.1)
    assert math.sqrt(across @ covariance[:2, :2] @ across) < 0.02
    seen = step_of(START, tracked(END.T_odom_base, weak_sigma_m=0.9 * UNOBSERVED_SIGMA_M))
    assert math.sqrt(weak @ seen[:2, :2] @ weak) < 0.02
