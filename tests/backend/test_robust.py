"""Robust optimisation: false closures injected into known and recorded graphs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from backend.graph_arrays import ConstraintArrays, joined
from backend.pose_graph_files import read_pose_graph
from backend.robust import robust_optimise
from datasets.messages import Array
from datasets.se2 import between, compose, pose_matrices

SIGMAS = np.array([0.03, 0.02, 0.005])
INFORMATION = np.diag(SIGMAS**-2.0)


def laps(seed: int, count: int = 320) -> tuple[Array, ConstraintArrays, ConstraintArrays]:
    """Two laps and more on a 20 x 20 m square: truth, noisy odometry, noisy closures."""
    rng = np.random.default_rng(seed)
    per_lap = 120
    truth = [np.zeros(3)]
    for i in range(count - 1):
        turn = np.pi / 2 if i % (per_lap // 4) == per_lap // 4 - 1 else 0.0
        truth.append(compose(truth[-1][None], np.array([[80.0 / per_lap, 0.0, turn]]))[0])
    nodes = np.array(truth)

    def measured(a: Array, b: Array) -> ConstraintArrays:
        noise = rng.normal(0.0, 1.0, (len(a), 3)) * SIGMAS
        z = compose(between(nodes[a], nodes[b]), noise)
        return ConstraintArrays(a, b, z, np.tile(INFORMATION, (len(a), 1, 1)))

    chain = np.arange(count - 1)
    later = np.arange(per_lap, count, 4)
    return nodes, measured(chain, chain + 1), measured(later - per_lap, later)


def injected(count: int, like: ConstraintArrays, number: int, seed: int) -> ConstraintArrays:
    """False closures between random nodes, at offsets and with information as true ones have."""
    rng = np.random.default_rng(seed)
    a = rng.integers(0, count - 40, number)
    b = a + rng.integers(30, count - a)
    b = np.minimum(b, count - 1)
    chosen = rng.integers(0, len(like), number)
    signs = rng.choice([-1.0, 1.0], (number, 3))
    z = like.xyyaw[chosen] * signs + rng.normal(0.0, 1.0, (number, 3)) * (0.5, 0.5, 0.2)
    return ConstraintArrays(a, b, z, like.information[chosen])


def dead_reckoned(odometry: ConstraintArrays) -> Array:
    poses = [np.zeros(3)]
    for z in odometry.xyyaw:
        poses.append(compose(poses[-1][None], z[None])[0])
    return pose_matrices(np.array(poses))


def split(graph: ConstraintArrays) -> tuple[ConstraintArrays, ConstraintArrays]:
    steps = np.abs(graph.from_nodes - graph.to_nodes) == 1
    return graph.pick(steps), graph.pick(~steps)


def test_true_closures_stay_and_false_ones_go() -> None:
    truth, odometry, loops = laps(0)
    false = injected(len(truth), loops, 20, 1)
    result = robust_optimise(dead_reckoned(odometry), odometry, joined(loops, false))
    kept = np.array([v.kept for v in result.verdicts])
    assert kept[: len(loops)].all()
    assert not kept[len(loops) :].any()
    assert np.abs(result.T_map_nodes[:, :2, 2] - truth[:, :2]).max() < 0.5
    assert all(v.reason for v in result.verdicts)
    assert min(v.chi2 for v in result.verdicts[len(loops) :]) > 16.0


def test_a_repeated_place_seen_ten_times_is_rejected() -> None:
    """Ten false closures that agree with each other: a corridor taken for one 3 m further on."""
    truth, odometry, loops = laps(1)
    a = np.arange(10, 20)
    b = a + 120
    z = compose(between(truth[a], truth[b]), np.tile([3.0, 0.0, 0.0], (10, 1)))
    false = ConstraintArrays(a, b, z, np.tile(INFORMATION, (10, 1, 1)))
    result = robust_optimise(dead_reckoned(odometry), odometry, joined(loops, false))
    kept = np.array([v.kept for v in result.verdicts])
    assert kept[: len(loops)].all()
    assert not kept[len(loops) :].any()


def test_residuals_of_calibrated_graphs_are_near_one() -> None:
    ratios = []
    for seed in range(5):
        _, odometry, loops = laps(seed)
        result = robust_optimise(dead_reckoned(odometry), odometry, loops)
        ratios.append((result.known_ratio, result.loops_ratio, result.scale))
    known, closed, scale = np.mean(ratios, axis=0)
    assert known == pytest.approx(1.0, abs=0.2)
    assert closed == pytest.approx(1.0, abs=0.2)
    assert scale < 1.5


def test_over_confident_information_is_found_out_and_no_closure_lost() -> None:
    truth, odometry, loops = laps(2)
    false = injected(len(truth), loops, 20, 3)
    both = joined(loops, false)
    result = robust_optimise(
        dead_reckoned(odometry),
        odometry.weighted(np.full(len(odometry), 100.0)),
        both.weighted(np.full(len(both), 100.0)),
    )
    kept = np.array([v.kept for v in result.verdicts])
    assert result.scale == pytest.approx(100.0, rel=0.5)
    assert result.loops_ratio == pytest.approx(100.0, rel=0.4)
    assert kept[: len(loops)].mean() >= 0.95
    assert not kept[len(loops) :].any()


def test_without_closures_it_is_the_odometry() -> None:
    _, odometry, loops = laps(3)
    start = dead_reckoned(odometry)
    result = robust_optimise(start, odometry, loops.pick(np.zeros(len(loops), dtype=bool)))
    np.testing.assert_allclose(result.T_map_nodes, start, atol=1e-6)
    assert result.verdicts == ()
    assert np.isnan(result.known_ratio)


def test_the_same_graph_gives_the_same_bits() -> None:
    truth, odometry, loops = laps(4)
    both = joined(loops, injected(len(truth), loops, 15, 5))
    first = robust_optimise(dead_reckoned(odometry), odometry, both)
    again = robust_optimise(dead_reckoned(odometry), odometry, both)
    assert first.T_map_nodes.tobytes() == again.T_map_nodes.tobytes()
    assert first.verdicts == again.verdicts


@pytest.mark.parametrize(
    ("name", "number", "false_kept"),
    [
        ("input_M3500b_g2o.g2o", 100, 2),
        ("input_INTEL_g2o.g2o", 100, 2),
        ("CSAIL_P_toro.graph", 100, 0),
        ("FRH_P_toro.graph", 100, 0),
        ("input_MITb_g2o.g2o", 10, 0),
    ],
)
def test_recorded_graphs_keep_their_closures(
    shared_data: Path, name: str, number: int, false_kept: int
) -> None:
    graph = read_pose_graph(shared_data / "posegraphs" / name)
    odometry, loops = split(graph.constraints)
    false = injected(len(graph.node_ids), loops, number, 7)
    start = pose_matrices(graph.nodes_xyyaw)
    result = robust_optimise(start, odometry, joined(loops, false))
    kept = np.array([v.kept for v in result.verdicts])
    assert kept[: len(loops)].mean() >= 0.95
    assert kept[len(loops) :].sum() <= false_kept
