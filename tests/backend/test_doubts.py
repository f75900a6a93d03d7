"""A map that is right has no contradictions; one with a pass at a wrong place has, and there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backend.constraint import Constraint
from backend.doubts import contradictions
from backend.graph_arrays import ConstraintArrays, joined
from backend.loose_steps import loose_steps
from backend.parts import parts_of
from backend.refine import steps_between
from datasets.se2 import inverse, se2
from tests.backend.laps import TWICE_ROUND, Laps, laps
from tests.frontend.rooms import OTHER_ROOM, RING, ROOM


@pytest.fixture(scope="module")
def twice_round() -> Laps:
    return laps((RING, TWICE_ROUND))


def test_a_right_map_has_none(twice_round: Laps) -> None:
    found = contradictions(twice_round.nodes, twice_round.T_world_nodes)
    assert found.places == ()
    assert found.share < 0.02
    assert found.compared > 1000


@pytest.mark.parametrize("shift", [(1.3, 0.0, 0.0), (0.0, 1.3, 0.0), (-0.8, 0.8, 0.15)])
def test_a_lap_that_lies_wrong_is_found(
    twice_round: Laps, shift: tuple[float, float, float]
) -> None:
    poses = np.array(twice_round.T_world_nodes)
    half = len(poses) // 2
    poses[half:] = se2(*shift) @ poses[half:]
    found = contradictions(twice_round.nodes, poses)
    assert found.places
    assert found.share > 0.1
    worst = found.places[0]
    assert worst.share > 0.3
    assert worst.passes == "other"
    assert np.hypot(*(poses[:, :2, 2] - [worst.x_m, worst.y_m]).T).min() < 1e-9


def test_too_short_a_drive_says_nothing() -> None:
    drive = laps((ROOM, ((1.2, 1.0), (1.5, 1.0))))
    found = contradictions(drive.nodes, drive.T_world_nodes)
    assert found.places == ()
    assert contradictions([], np.zeros((0, 3, 3))).compared == 0


def test_parts_are_what_tracking_and_closures_join() -> None:
    corners = ((1.2, 1.0), (5.0, 1.0), (5.0, 2.0))
    others = ((1.2, 1.0), (4.0, 1.5), (4.0, 4.0))
    drive = laps((ROOM, corners), (OTHER_ROOM, others), lost=True)
    lost_at = next(s.index for s in drive.submaps if s.nodes[0].lost)
    alone = parts_of(drive.submaps, [])
    assert len(set(alone[:lost_at])) == len(set(alone[lost_at:])) == 1
    assert sorted(set(alone.tolist())) == [0, 1]
    nodes_of = [sum(len(s.nodes) for s in drive.submaps if alone[s.index] == k) for k in (0, 1)]
    assert nodes_of[0] >= nodes_of[1]
    joined = parts_of(drive.submaps, [(0, len(drive.submaps) - 1)])
    assert (joined == 0).all()


def test_a_step_that_nothing_shows_is_loose_unless_the_graph_holds_it(twice_round: Laps) -> None:
    nodes = list(twice_round.nodes)
    unseen = np.diag([1.0, 1e-4, 1e-5])
    nodes[40] = replace(nodes[40], step_covariance=unseen)
    steps = steps_between(nodes)
    poses = np.array([node.T_odom_base for node in nodes])
    found = loose_steps(nodes, poses, steps)
    assert [step.node for step in found] == [40]
    assert 0.5 < found[0].sigma_m < 1.1
    T = inverse(poses[35]) @ poses[45]
    closure = Constraint(35, 45, T, np.diag([1e4, 1e4, 1e5]), "loop")
    assert loose_steps(nodes, poses, joined(steps, ConstraintArrays.of([closure]))) == ()
    assert loose_steps(twice_round.nodes, poses, steps) == ()
