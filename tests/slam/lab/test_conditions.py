"""Each hard condition differs from the tables' drives in what it says."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.simulation.place import load_place
from datasets.simulation.robot import SLIPPERY
from datasets.simulation.simulated_drive import SimulatedDrive
from slam.lab.drives.conditions import CONDITIONS, Condition, setting_of
from slam.lab.drives.drives import hard_jobs
from slam.lab.drives.systems import LIDAR


def named(name: str) -> Condition:
    return next(each for each in CONDITIONS if each.name == name)


@pytest.mark.parametrize("condition", CONDITIONS, ids=lambda each: each.name)
def test_every_condition_can_be_driven(condition: Condition) -> None:
    place, spec, robot = setting_of(condition)
    drive = SimulatedDrive(place, spec, robot, 1, laps=condition.laps)
    assert drive.drive.duration_s > 60.0 * condition.laps
    assert LIDAR.but(*condition.settings).config().sensors == "lidar"


def test_slip_changes_the_wheels_alone() -> None:
    place, _, robot = setting_of(named("slip"))
    _, _, usual = setting_of(named("glass"))
    assert robot.wheels == SLIPPERY != usual.wheels
    assert robot.lidars is usual.lidars
    assert len(place.solids) == len(load_place("ring-corridor").solids)


def test_glass_doors_let_the_lidar_through_and_nothing_else_changes() -> None:
    place, _, _ = setting_of(named("glass"))
    before = load_place("ring-corridor")
    changed = {
        b.name for a, b in zip(before.solids, place.solids, strict=True) if a.material != b.material
    }
    assert len(changed) > 30
    assert all("leaf" in name for name in changed)
    assert {s.material.lidar for s in place.solids if s.name in changed} == {"clear"}


def test_the_bare_ring_has_the_walls_and_the_low_obstacles_of_the_ring() -> None:
    bare, _, _ = setting_of(named("bare corridor"))
    ring = load_place("ring-corridor")
    assert bare.structures == ring.structures
    of_ring = {solid.name: solid for solid in ring.solids}
    low = [solid for solid in bare.solids if solid.name.startswith("obstacle")]
    assert len(low) == 4
    for solid in low:
        np.testing.assert_array_equal(solid.vertices, of_ring[solid.name].vertices)


def test_nobody_walks_where_nobody_is() -> None:
    assert setting_of(named("people"))[0].movers
    assert not setting_of(named("nobody"))[0].movers


def test_without_odometry_no_system_has_any() -> None:
    systems = [LIDAR.but(*named("no odometry").settings)]
    assert [system.config().odometry for system in systems] == [False]
    assert systems[0].name == LIDAR.name


def test_the_longest_drives_come_first() -> None:
    jobs = hard_jobs(CONDITIONS, (1, 2))
    assert jobs[0].condition is not None
    assert jobs[0].condition.name == "five more laps"
    assert len(jobs) == 2 * len(CONDITIONS)
