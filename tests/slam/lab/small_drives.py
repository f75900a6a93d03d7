"""Short drives for the tests of the tables: all that is needed of each place, in a few seconds."""

from __future__ import annotations

from functools import cache

import numpy as np

from datasets.simulation.place import DriveSpec, Place, load_place
from slam.lab.drives.drives import beams_drive, ring_drive, room_drive
from slam.lab.drives.rows import Rows

ROOM_WAY = ((0.0, 0.0), (2.6, -0.1), (4.5, -1.2), (4.6, -3.4), (3.4, -4.8), (0.8, -4.9))
"""Of the tour: past A, B and C, not to D."""


@cache
def room() -> tuple[Place, DriveSpec]:
    """The place and a part of its tour."""
    spec = DriveSpec(np.array(ROOM_WAY), stand_s=1.0, robot="low-lidar")
    return load_place("room"), spec


@cache
def corner() -> tuple[Place, DriveSpec]:
    """The place and some metres of its tour."""
    return room()[0], DriveSpec(np.array(ROOM_WAY[:3]), stand_s=1.0, robot="low-lidar")


@cache
def stretch() -> tuple[Place, DriveSpec]:
    """A stretch of the first corridor, with an obstacle that the lidar passes over."""
    place = load_place("ring-corridor")
    return place, place.drives["stretch"]


@cache
def rows_of_one_seed() -> Rows:
    """What all tables are made of, from one seed."""
    rows = Rows()
    rows.extend(ring_drive(1, *stretch(), (4, 5)))
    rows.extend(room_drive(1, *room(), (1, 2)))
    still = DriveSpec(np.zeros((1, 2)), stand_s=4.0)
    rows.extend(beams_drive(1, load_place("beam-room"), still))
    return rows
