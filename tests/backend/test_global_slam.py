"""The graph of submaps while running, and what the end makes of it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from backend.finish import finish
from backend.global_slam import GlobalSlam
from backend.loop_attempt import ACCEPTED
from backend.loop_search import LoopConfig
from backend.refine import RefineConfig
from datasets.se2 import inverse
from tests.backend.laps import TWICE_ROUND, Laps, errors, laps, searched
from tests.frontend.rooms import OTHER_ROOM, RING, ROOM, Line, off_by

DEG = math.radians(1.0)


@pytest.fixture(scope="module")
def twice_round() -> Laps:
    return laps((RING, TWICE_ROUND))


def without_loops(drive: Laps) -> GlobalSlam:
    slam = GlobalSlam(LoopConfig(), drive.nodes, drive.submaps)
    for submap in drive.submaps:
        slam.add_submap(submap)
    return slam


def test_without_closures_the_map_is_the_odom_frame(twice_round: Laps) -> None:
    slam = without_loops(twice_round)
    T_odom = np.array([submap.anchor.T_odom_base for submap in twice_round.submaps])
    assert slam.T_map_anchors() == pytest.approx(T_odom, abs=1e-6)
    assert slam.T_map_odom() == pytest.approx(np.eye(3), abs=1e-6)
    assert not slam.closures


def test_nothing_yet_is_no_error() -> None:
    slam = GlobalSlam(LoopConfig(), [], [])
    assert slam.step() == []
    assert (slam.T_map_odom() == np.eye(3)).all()
    assert len(slam.T_map_anchors()) == 0


def test_the_chain_holds_what_local_slam_measured(twice_round: Laps) -> None:
    slam = without_loops(twice_round)
    assert len(slam.constraints) == len(twice_round.submaps) - 1
    for before, after, constraint in zip(
        twice_round.submaps[:-1], twice_round.submaps[1:], slam.constraints, strict=True
    ):
        assert (constraint.from_node, constraint.to_node) == (before.index, after.index)
        assert constraint.kind == "odometry"
        T = inverse(before.anchor.T_odom_base) @ after.anchor.T_odom_base
        assert constraint.T_from_to == pytest.approx(T)
        sigma = np.sqrt(np.diag(np.linalg.inv(constraint.information)))
        way_m = after.anchor.way_m - before.anchor.way_m
        assert (sigma[:2] > 0.002 * way_m).all()
        assert (sigma[:2] < 0.1 * way_m).all()
        assert sigma[2] < 0.1


def test_closures_bring_the_second_lap_onto_the_first(twice_round: Laps) -> None:
    raw = errors(twice_round.T_world_anchors(), without_loops(twice_round).T_map_anchors())
    assert raw[:, 0].max() > 0.4
    slam = searched(twice_round)
    closed = errors(twice_round.T_world_anchors(), slam.T_map_anchors())
    assert closed[:, 0].max() < 0.1
    assert closed[:, 1].max() < 1.0 * DEG
    accepted = [a for a in slam.search.attempts if a.result == ACCEPTED]
    assert [attempt for attempt, _ in slam.closures] == accepted
    T_world = twice_round.T_world_anchors()
    for _, constraint in slam.closures:
        assert constraint.kind == "loop"
        assert constraint.from_node < constraint.to_node - 1
        true = inverse(T_world[constraint.from_node]) @ T_world[constraint.to_node]
        assert max(off_by(true, constraint.T_from_to)) < 0.05
        assert np.linalg.eigvalsh(constraint.information)[0] > 0.0


def test_closures_are_as_good_as_their_information_says(twice_round: Laps) -> None:
    """Normalised squared errors near 3, for three degrees of freedom: neither boast nor doubt."""
    slam = searched(twice_round)
    T_world = twice_round.T_world_anchors()
    chi2 = []
    for _, constraint in slam.closures:
        true = inverse(T_world[constraint.from_node]) @ T_world[constraint.to_node]
        T = inverse(true) @ constraint.T_from_to
        error = np.array([T[0, 2], T[1, 2], math.atan2(T[1, 0], T[0, 0])])
        chi2.append(error @ constraint.information @ error)
    assert np.median(chi2) < 8.0
    assert np.mean(chi2) > 0.05


def test_the_newest_pose_goes_along_with_the_map(twice_round: Laps) -> None:
    slam = searched(twice_round)
    T_last_odom = twice_round.submaps[-1].anchor.T_odom_base
    assert slam.T_map_odom() @ T_last_odom == pytest.approx(slam.T_map_anchors()[-1])


def test_a_lost_thread_is_a_loose_link() -> None:
    corners = ((1.2, 1.0), (5.0, 1.0), (5.0, 2.0))
    others = ((1.2, 1.0), (4.0, 1.5), (4.0, 4.0))
    drive = laps((ROOM, corners), (OTHER_ROOM, others), lost=True)
    slam = without_loops(drive)
    sizes = [np.linalg.inv(c.information)[0, 0] for c in slam.constraints]
    lost = [
        any(node.lost for node in drive.nodes[a.anchor.index + 1 : b.anchor.index + 1])
        for a, b in zip(drive.submaps[:-1], drive.submaps[1:], strict=True)
    ]
    assert sum(lost) == 1
    assert all((size > 1.0) == is_lost for size, is_lost in zip(sizes, lost, strict=True))


def test_the_end_brings_every_node_within_centimetres(twice_round: Laps) -> None:
    slam = searched(twice_round)
    result = finish(slam, twice_round.nodes, twice_round.submaps, RefineConfig())
    off = errors(twice_round.T_world_nodes, result.T_map_nodes)
    assert off[:, 0].max() < 0.03
    assert off[:, 0].mean() < 0.015
    assert off[:, 1].max() < 0.6 * DEG
    assert len(result.kept) == len(slam.closures)
    assert all(result.kept)
    assert not slam.search.waiting


def test_a_lost_thread_is_taken_up_where_the_loops_say() -> None:
    """Carried on 1.2 m while lost, with odometry that says nothing of it; later laps close."""
    before: Line = ((1.0, 1.0), (11.0, 1.0), (11.0, 5.0))
    after: Line = (
        *((11.0, 6.2), (11.0, 8.0), (1.0, 8.0), (1.0, 1.0), (11.0, 1.0), (11.0, 8.0), (1.0, 8.0)),
    )
    drive = laps((RING, before), (RING, after), lost=True, drift_rad_per_m=0.0005)
    raw = errors(drive.T_world_nodes, drive.T_odom_nodes())
    assert raw[:, 0].max() > 1.0
    result = finish(searched(drive), drive.nodes, drive.submaps, RefineConfig())
    off = errors(drive.T_world_nodes, result.T_map_nodes)
    assert off[:, 0].max() < 0.03


@pytest.mark.parametrize("turn_rad", [2.5, -1.3])
def test_a_lost_thread_is_taken_up_whichever_way_the_base_had_turned(turn_rad: float) -> None:
    """Lost on the spot, in a room seen before; what comes after is turned in the odom frame."""
    before: Line = ((1.2, 1.0), (7.0, 1.0), (7.0, 4.5), (1.2, 4.5), (1.2, 1.5))
    after: Line = ((1.4, 1.6), (6.0, 1.2), (6.5, 4.2), (1.4, 4.2))
    drive = laps((ROOM, before), (ROOM, after), lost=True, lost_turn_rad=turn_rad)
    assert errors(drive.T_world_nodes, drive.T_odom_nodes())[:, 1].max() > 1.0
    result = finish(searched(drive), drive.nodes, drive.submaps, RefineConfig())
    off = errors(drive.T_world_nodes, result.T_map_nodes)
    assert off[:, 0].max() < 0.03
    assert off[:, 1].max() < DEG


def test_the_same_nodes_give_the_same_map(twice_round: Laps) -> None:
    first, second = (
        finish(searched(twice_round), twice_round.nodes, twice_round.submaps, RefineConfig())
        for _ in range(2)
    )
    assert first.T_map_nodes.tobytes() == second.T_map_nodes.tobytes()


def test_a_single_submap_has_an_end_too() -> None:
    drive = laps((ROOM, ((1.2, 1.0), (2.2, 1.0))))
    slam = searched(drive)
    result = finish(slam, drive.nodes, drive.submaps, RefineConfig())
    assert len(result.T_map_nodes) == len(drive.nodes)
    assert errors(drive.T_world_nodes, result.T_map_nodes)[:, 0].max() < 0.02
