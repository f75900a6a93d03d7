"""The measures on shipped places, seen by a lidar whose poses are the true ones."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from datasets.messages import Array, LaserScan
from datasets.recording import Intrinsics, LidarCalibration
from datasets.simulation.depth_camera import DepthModel
from datasets.simulation.drive import Drive, DriveLimits, plan_drive
from datasets.simulation.lidar import LidarModel, simulate_turn
from datasets.simulation.place import Place, load_place
from datasets.simulation.scene import Scene
from datasets.trajectory import Trajectory
from fusion.lidar_only import BeamLimits, LidarProjection
from slam.evaluation.obstacle_score import score_obstacles
from slam.evaluation.obstacle_truth import CameraView, ObstacleTruth, obstacle_truth
from slam.evaluation.restoration import Restored, restoration
from slam.lab.drives.beam_errors import BEAMS_DEG, beam_errors, bearings_of, ranges_at
from slam.lab.drives.footprint import footprint_corner
from slam.lab.drives.map_points import CornerFound, CornerNotFound, find_corner
from slam.lab.tables import paper_tables as paper

LIDAR_M = 0.895


def mounted(z_m: float) -> Array:
    T = np.eye(4)
    T[2, 3] = z_m
    return T


def turns(place: Place, drive: Drive, times_s: Array) -> list[LaserScan]:
    scene, rng = Scene(place), np.random.default_rng(11)
    return [
        simulate_turn(scene, drive.pose, mounted(LIDAR_M), LidarModel(), t, rng).normalised(
            start_ns=0, lidar="scan", notes=Counter()
        )
        for t in times_s.tolist()
    ]


@pytest.fixture(scope="module")
def room() -> Place:
    return load_place("room")


@pytest.fixture(scope="module")
def tour(room: Place) -> Drive:
    spec = room.drives["tour"]
    return plan_drive(
        spec.way_points,
        DriveLimits(),
        start_yaw_rad=spec.start_yaw_rad,
        closed=spec.closed,
        waits_s={0: spec.stand_s},
    )


@pytest.fixture(scope="module")
def lidar_points(room: Place, tour: Drive) -> Array:
    pieces = []
    for scan in turns(room, tour, np.arange(0.0, tour.duration_s, 2.0)):
        hit = np.isfinite(scan.ranges_m)
        poses = tour.pose(scan.stamp_ns * 1e-9 + scan.beam_offsets_s[hit])
        bearing, range_m = scan.bearings_rad[hit] + poses[:, 2], scan.ranges_m[hit]
        rays = np.column_stack([np.cos(bearing), np.sin(bearing)])
        pieces.append(poses[:, :2] + range_m[:, None] * rays)
    return np.concatenate(pieces)


@pytest.fixture(scope="module")
def truth(room: Place, tour: Drive) -> ObstacleTruth:
    times_s = np.arange(0.0, tour.duration_s, 0.4)
    stamps_ns = (times_s * 1e9).astype(np.int64)
    T = mounted(0.25)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[0, 3] = 0.15
    view = CameraView(T, Intrinsics(DepthModel(mode="640x480").K, 640, 480), stamps_ns)
    return obstacle_truth(room, Trajectory(stamps_ns, tour.pose(times_s)), [view], [LIDAR_M], 0)


def cells_of(points: Array, least: int = 1) -> Array:
    """Centres of the cells that hold at least so many points."""
    cells, counts = np.unique(np.floor(points / 0.05), axis=0, return_counts=True)
    centres: Array = cells[counts >= least] * 0.05 + 0.025
    return centres


def test_the_room_comes_out_as_long_as_it_is(room: Place, lidar_points: Array) -> None:
    for structure in room.structures.values():
        result = restoration(structure, lidar_points)
        assert isinstance(result, Restored)
        assert result.gamma_percent == pytest.approx(100.0, abs=0.05)


def test_the_lidar_shows_the_room_but_none_of_its_low_obstacles(
    room: Place, truth: ObstacleTruth, lidar_points: Array
) -> None:
    score = score_obstacles(truth, cells_of(lidar_points, 3), truth.T_map_base)
    low = {item.name: item.found for item in score.objects if item.is_low}
    assert low == dict.fromkeys("ABCD", False)
    found = {item.name for item in score.objects if item.found}
    assert found == {item.name for item in score.objects} - set("ABCD")
    assert (score.structure.precision.value or 0.0) > 0.99
    for name in "ABCD":
        corner = footprint_corner(room, name)
        # Points, and walls of cells one to four thick.
        for drawn in (lidar_points, *(cells_of(lidar_points, least) for least in (3, 5, 8))):
            assert isinstance(find_corner(corner, drawn), CornerNotFound)


def test_with_what_the_camera_saw_all_four_are_found_and_their_corners(
    room: Place, truth: ObstacleTruth, lidar_points: Array
) -> None:
    drawn = np.vstack([cells_of(lidar_points, 3), cells_of(truth.cells_map)])
    score = score_obstacles(truth, drawn, truth.T_map_base)
    assert score.low_objects_found.value == 1.0
    assert (score.low.f1 or 0.0) == 1.0
    for name in "ABCD":
        corner = find_corner(
            footprint_corner(room, name), cells_of(truth.cells_map), walls_map=lidar_points
        )
        assert isinstance(corner, CornerFound)
        assert corner.error_m < 0.05


def test_the_beams_of_the_small_surrounding_are_those_of_table_3() -> None:
    place = load_place("beam-room")
    drive = plan_drive([[0.0, 0.0]], DriveLimits(), start_yaw_rad=0.0, waits_s={0: 5.0})
    project = LidarProjection(LidarCalibration(mounted(LIDAR_M)), BeamLimits())
    scans = [project(scan) for scan in turns(place, drive, np.arange(8) / 7.0)]
    actual = np.array([row.actual_m for row in paper.BEAMS])
    beams_deg = np.array(BEAMS_DEG, dtype=np.float64)
    bearings_rad, beside_rad = bearings_of(beams_deg), math.radians(0.5)
    ranges_m = np.array([ranges_at(scan, bearings_rad, beside_rad) for scan in scans])
    errors = beam_errors(ranges_m, actual, beams_deg)
    off = errors.mean_m - actual
    assert errors.missing == 0
    assert off[5] == pytest.approx(2.06 - 1.013, abs=0.02)  # the lidar passes over the low object
    np.testing.assert_allclose(np.delete(off, 5), 0.0, atol=0.02)
