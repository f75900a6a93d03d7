"""Known mountings of simulated cameras, with all their noise, recovered from 20 s of driving."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from datasets.calibration_file import T_BODY_OPTICAL, mounting
from datasets.simulation.place import DriveSpec, load_place
from datasets.simulation.robot import DEPTH, ROBOTS
from datasets.simulation.simulated_drive import SimulatedDrive
from fusion.calibration.estimate import CalibrationConfig, body_values, calibrate


@pytest.mark.parametrize(
    ("place", "robot", "way", "seed"),
    [
        ("office", "tilted", [[0.0, 0.0], [1.4, 0.1], [1.5, 2.1], [2.1, 3.1], [1.2, 4.2]], 1),
        ("room", "rolled", [[0.0, 0.0], [3.0, -0.2], [4.5, -1.2], [4.6, -3.4], [3.4, -4.8]], 2),
        ("ring-corridor", "offset", [[31.0, 0.15], [36.5, -0.1], [36.7, -3.0]], 3),
    ],
)
def test_it_is_within_the_bars_and_knows_how_sure_it_is(
    place: str, robot: str, way: list[list[float]], seed: int
) -> None:
    spec = DriveSpec(np.array(way), start_yaw_rad=math.atan2(way[1][1], way[1][0]))
    true = ROBOTS[robot]
    drive = SimulatedDrive(
        load_place(place), spec, true.seeing(true.cameras[DEPTH].model, 2.5), seed
    )
    truth = body_values(true.cameras[DEPTH].T_base_camera)
    wrong = np.array([0.08, -0.07, 0.1, *np.radians([4.0, -4.0, 5.0])])
    guess = truth + np.random.default_rng(seed).choice([-1.0, 1.0], 6) * wrong
    x, y, z, roll, pitch, yaw = guess.tolist()
    T_guess = mounting((x, y, z), (roll, pitch, yaw)) @ T_BODY_OPTICAL

    result = calibrate(drive, CalibrationConfig(), Counter(), T_base_camera_guess=T_guess)

    errors = result.values - truth
    assert (np.abs(errors[:3]) < 0.02).all(), errors
    assert (np.abs(np.degrees(errors[3:])) < 0.5).all(), np.degrees(errors)
    assert (np.abs(errors) < 4.0 * result.sigma).all(), errors / result.sigma
    assert (result.sigma[:3] < 0.01).all(), result.sigma
    assert (np.degrees(result.sigma[3:]) < 0.2).all(), np.degrees(result.sigma)
