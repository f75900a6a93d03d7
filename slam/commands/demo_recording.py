"""The recording that the demo maps: a piece of the paper's corridor with a low obstacle in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datasets.simulation.bag_writer import write_bag
from datasets.simulation.place import DriveSpec, load_place
from datasets.simulation.robot import ROBOTS
from datasets.simulation.simulated_drive import SimulatedDrive

SEED = 7
PLACE = "ring-corridor"
WAY_M = ((6.0, 0.0), (16.0, -0.25), (20.0, -0.1))
"""Past cabinets, doors and, at x = 16.2 m, an obstacle that the lidar doesn't see."""


def write_demo_recording(folder: Path) -> Path:
    """Write ``demo.mcap`` into a folder, which is made if missing; always the same bytes.

    Raises InputError if it can't be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    spec = DriveSpec(np.array(WAY_M), stand_s=1.0)
    drive = SimulatedDrive(load_place(PLACE), spec, ROBOTS["paper"], SEED)
    return write_bag(drive, folder / "demo.mcap", force=True).path
