"""The final passes: perturbed nodes come back, and what is nearly right is not made worse."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from backend.graph_arrays import ConstraintArrays
from backend.refine import NodeScans, RefineConfig, joined, refine
from datasets.messages import Array
from datasets.se2 import inverse, se2, xyyaw
from tests.backend.laps import TWICE_ROUND, Laps, errors, laps
from tests.frontend.rooms import CORRIDOR, RING, ROOM, box, off_by, walls

DEG = math.radians(1.0)
NO_CLOSURES = ConstraintArrays.of([])


@pytest.fixture(scope="module")
def twice_round() -> Laps:
    return laps((RING, TWICE_ROUND))


def perturbed(T: Array, xy_m: float, yaw_rad: float, seed: int = 0) -> Array:
    random = np.random.default_rng(seed)
    noise = random.normal(0.0, [xy_m, xy_m, yaw_rad], (len(T), 3))
    return np.array([pose @ se2(*row) for pose, row in zip(T, noise, strict=True)])


@pytest.mark.parametrize("seed", [0, 1])
def test_perturbed_nodes_come_back(twice_round: Laps, seed: int) -> None:
    start = perturbed(twice_round.T_world_nodes, 0.04, 1.0 * DEG, seed)
    assert errors(twice_round.T_world_nodes, start)[:, 0].max() > 0.15
    result = refine(twice_round.nodes, start, NO_CLOSURES, RefineConfig(passes=5))
    off = errors(twice_round.T_world_nodes, result.T_map_nodes)
    assert off[:, 0].max() < 0.03
    assert off[:, 1].max() < 0.6 * DEG
    assert result.moved_m[0] > 3.0 * result.moved_m[-1]
    assert len(result.moved_m) <= 5
    assert len(result.pairs) == len(result.rms_m) <= result.tried
    assert len(result.pairs) > 5 * len(twice_round.nodes)
    assert result.rms_m.max() < 0.05


def test_a_shifted_lap_comes_back_onto_the_other(twice_round: Laps) -> None:
    """Not noise, but what a settled graph may leave: the second lap 8 cm aside."""
    start = twice_round.T_world_nodes.copy()
    share = np.clip((np.arange(len(start)) - 100) / 50.0, 0.0, 1.0)
    start[:, :2, 2] += share[:, None] * np.array([0.06, -0.05])
    result = refine(twice_round.nodes, start, NO_CLOSURES, RefineConfig(passes=6, settled_m=0.0005))
    off = errors(twice_round.T_world_nodes, result.T_map_nodes)
    assert off[:, 0].max() < 0.03


def test_true_poses_stay(twice_round: Laps) -> None:
    result = refine(twice_round.nodes, twice_round.T_world_nodes, NO_CLOSURES, RefineConfig())
    off = errors(twice_round.T_world_nodes, result.T_map_nodes)
    assert off[:, 0].max() < 0.02
    assert result.moved_m[0] < 0.01


def test_turning_the_map_turns_the_result(twice_round: Laps) -> None:
    nodes = twice_round.nodes[:60]
    start = perturbed(twice_round.T_world_nodes[:60], 0.02, 0.5 * DEG)
    T_new_old = se2(30.0, -7.0, 2.0)
    old = refine(nodes, start, NO_CLOSURES, RefineConfig(passes=2)).T_map_nodes
    new = refine(nodes, T_new_old @ start, NO_CLOSURES, RefineConfig(passes=2)).T_map_nodes
    assert new == pytest.approx(T_new_old @ old, abs=1e-5)


def test_in_a_bare_corridor_the_steps_hold_the_way_along() -> None:
    drive = laps(
        (CORRIDOR, ((0.0, 0.1), (12.0, 0.1))), max_range_m=5.0, scale=1.0, drift_rad_per_m=0.0
    )
    start = perturbed(drive.T_world_nodes, 0.02, 0.3 * DEG)
    result = refine(drive.nodes, start, NO_CLOSURES, RefineConfig())
    places, true = result.T_map_nodes[:, :2, 2], drive.T_world_nodes[:, :2, 2]
    line = np.polynomial.Polynomial.fit(places[:, 0], places[:, 1], 1)
    assert np.abs(line(places[:, 0]) - places[:, 1]).max() < 0.01, "straight"
    length = np.linalg.norm(places[-1] - places[0])
    assert length == pytest.approx(np.linalg.norm(true[-1] - true[0]), abs=0.15)


def test_pairs_that_do_not_fit_are_left_out(twice_round: Laps) -> None:
    """A node far off from where it was: its pairs are refused, its steps bring it back."""
    start = twice_round.T_world_nodes.copy()
    start[50] = start[50] @ se2(0.0, 0.7, 0.5)
    result = refine(twice_round.nodes, start, NO_CLOSURES, RefineConfig(passes=3))
    off = errors(twice_round.T_world_nodes, result.T_map_nodes)
    assert off[:, 0].max() < 0.03


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_nodes_are_left_as_they_are(twice_round: Laps, count: int) -> None:
    T = twice_round.T_world_nodes[:count]
    result = refine(twice_round.nodes[:count], T, NO_CLOSURES, RefineConfig())
    assert (result.T_map_nodes == T).all()
    assert (len(result.pairs), result.tried, result.moved_m) == (0, 0, ())


def test_no_passes_change_nothing(twice_round: Laps) -> None:
    T = twice_round.T_world_nodes
    assert refine(
        twice_round.nodes, T, NO_CLOSURES, RefineConfig(passes=0)
    ).T_map_nodes == pytest.approx(T)


def test_nodes_without_points_are_borne() -> None:
    drive = laps((ROOM, ((1.2, 1.0), (5.0, 1.0))))
    empty = replace(
        drive.nodes[4].scan,
        points_base=np.empty((0, 2)),
        normals_base=np.empty((0, 2)),
        bearings_rad=np.empty(0),
        layer=np.empty(0, dtype=np.uint8),
        weights=np.empty(0),
    )
    nodes = [replace(node, scan=empty) if node.index == 4 else node for node in drive.nodes]
    result = refine(nodes, drive.T_world_nodes, NO_CLOSURES, RefineConfig())
    assert errors(drive.T_world_nodes, result.T_map_nodes)[:, 0].max() < 0.03


def test_pairs_are_of_what_the_lidars_saw() -> None:
    """Low things change no byte of them."""
    line = ((1.2, 1.0), (5.0, 1.0))
    low = walls(box(3.0, 0.2, 0.4, 0.4), box(6.0, 0.5, 0.3, 1.0))
    bare, both = laps((ROOM, line)), laps((ROOM, line), low=low)
    assert sum(int(node.scan.has_low) for node in both.nodes) > 5
    poses = np.array([xyyaw(T) for T in bare.T_world_nodes])
    early, late = np.arange(5), np.arange(2, 7)
    expected, _ = NodeScans(bare.nodes).match(early, late, poses, 4)
    found, _ = NodeScans(both.nodes).match(early, late, poses, 4)
    assert np.array_equal(expected.xyyaw, found.xyyaw)
    assert np.array_equal(expected.information, found.information)


def test_matches_are_constraints_between_the_nodes_given(twice_round: Laps) -> None:
    scans = NodeScans(twice_round.nodes)
    early, late = np.array([0, 3, 10]), np.array([2, 4, 12])
    rows = np.column_stack(
        [
            twice_round.T_world_nodes[:, 0, 2],
            twice_round.T_world_nodes[:, 1, 2],
            np.arctan2(twice_round.T_world_nodes[:, 1, 0], twice_round.T_world_nodes[:, 0, 0]),
        ]
    )
    pairs, stats = scans.match(early, late, rows, 5)
    assert stats.shape == (3, 4)
    for k in range(3):
        true = inverse(twice_round.T_world_nodes[early[k]]) @ twice_round.T_world_nodes[late[k]]
        assert max(off_by(true, se2(*pairs.xyyaw[k]))) < 0.03
    both = joined(pairs, pairs.pick(np.array([1])))
    assert both.from_nodes.tolist() == [0, 3, 10, 3]
    assert (both.information[3] == pairs.information[1]).all()
