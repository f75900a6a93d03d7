"""A short drive towards a low crate that the lidar looks over: lidar, depth camera, wheels."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datasets.simulation.bag_writer import write_bag
from datasets.simulation.place import DriveSpec, load_place
from datasets.simulation.robot import ROBOTS
from datasets.simulation.simulated_drive import SimulatedDrive

DRAWN = """\
floor: marble
walls:
  - name: room
    ring: [[-2, -2], [5, -2], [5, 2.5], [1, 2.5], [1, 2], [-2, 2], [-2, -2]]
    height_m: 2.5
boxes:
  - {name: crate, at_m: [3.2, 0.2], size_m: [0.4, 0.6, 0.3]}
structures:
  hall: {from_m: [-2.0, -1.0], to_m: [5.0, -1.0]}
"""
FACE_M = 3.0
"""x of the crate's face towards the robot, which starts at the origin and looks along x."""


def write_place(folder: Path) -> Path:
    path = folder / "crate.yaml"
    path.write_text(DRAWN, encoding="utf-8")
    return path


def write_crate_drive(folder: Path, robot: str = "paper", *, seed: int = 3) -> Path:
    """Some 4 s, 1 m; the bag is called after the robot."""
    spec = DriveSpec(np.array([[0.0, 0.0], [1.0, 0.0]]), stand_s=0.6)
    drive = SimulatedDrive(load_place(write_place(folder)), spec, ROBOTS[robot], seed)
    return write_bag(drive, folder / f"{robot}.mcap").path
