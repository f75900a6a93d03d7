"""The benchmark's measures on simulated recordings: known answers, and the way they are taken."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.se2 import se2, transform
from datasets.simulation.place import load_place
from datasets.simulation.robot import ROBOTS
from datasets.simulation.simulated_drive import SimulatedDrive
from datasets.trajectory import Trajectory
from slam.lab.bench.calibration import FirstSeconds
from slam.lab.bench.fusion import in_frame_of
from slam.lab.bench.images import FLOOR, LARGE, shot, slab, stands
from slam.lab.bench.jobs import alone, side_by_side
from slam.lab.bench.tours import Tour, end_of_first_lap, map_laps, map_tour, until
from slam.mapping.occupancy import FREE, OCCUPIED, Classes, MapConfig, occupied_cells
from slam.mapping.scan_store import ScanStore


def test_jobs_come_back_in_their_order() -> None:
    assert side_by_side(abs, [-3, 2, -1]) == [3, 2, 1]
    with pytest.raises(ValueError, match="no number"):
        alone(float, "no number")


def test_a_lap_ends_where_its_share_of_the_way_is_driven() -> None:
    x = np.concatenate([np.zeros(5), np.linspace(0.0, 6.0, 61)])
    stamps = np.arange(x.size)
    truth = Trajectory(stamps, np.column_stack([x, 0 * x, 0 * x]))
    assert end_of_first_lap(truth, 1) == stamps[-1]
    assert x[end_of_first_lap(truth, 6)] == pytest.approx(1.0, abs=0.11)


def test_the_scans_until_a_stamp() -> None:
    points = [np.full((k, 2), float(k)) for k in (3, 0, 2, 1)]
    scans = ScanStore.from_scans([10, 20, 30, 30], ["s"] * 4, points, {"s": (0.0, 0.0)})
    assert len(until(scans, 9)) == 0
    assert until(scans, 20).points_base.shape == (3, 2)
    assert len(until(scans, 29)) == 2
    np.testing.assert_array_equal(until(scans, 30).points_base, scans.points_base)


def test_cells_stand_in_their_middles() -> None:
    class Drawn:
        corner_map_m = (1.0, -2.0)
        resolution_m = 0.5
        shape = (2, 3)

        def classes(self, config: MapConfig) -> Classes:
            out = np.full(self.shape, FREE, np.uint8)
            out[1, 2] = OCCUPIED
            return out

    np.testing.assert_allclose(
        occupied_cells(Drawn(), Drawn().classes(MapConfig())), [[2.25, -1.25]]
    )


def test_maps_are_laid_on_each_other_by_their_trajectories() -> None:
    stamps = np.arange(0, 100, 5)
    way = np.column_stack([np.cos(stamps / 20.0), stamps / 50.0])
    rows = np.column_stack([way, np.zeros(len(way))])
    T = se2(3.0, -1.0, 0.7)
    moved = np.column_stack([transform(T, way), np.full(len(way), 0.7)])
    one, other = Trajectory(stamps, moved), Trajectory(stamps[2:-2], rows[2:-2])
    points = np.array([[0.5, 2.0], [-3.0, 1.0]])
    np.testing.assert_allclose(in_frame_of(one, other, points), transform(T, points), atol=1e-9)


def test_the_first_seconds_of_a_drive() -> None:
    place = load_place("beam-room")
    drive = SimulatedDrive(place, place.drives["stand"], ROBOTS["two-lidars"], 1)
    stamps = [message.stamp_ns for message in FirstSeconds(drive, 2.0)]
    assert 1.9e9 < stamps[-1] - drive.start_ns <= 2e9


def test_a_slab_stands_where_it_should() -> None:
    wall = slab("wall", (2.0, -9.0, -1.0), (3.0, 9.0, 3.0))
    model = LARGE.model_copy(update={"wave_px": 0.0})
    depth_m = shot(model, stands(0.25), 1, FLOOR, wall)
    assert np.median(depth_m[300:400, 500:800]) == pytest.approx(2.0, abs=0.01)
    down_m = depth_m[700, 500:800]  # 341 px below the middle at f 686: the floor at 0.25 m
    assert np.median(down_m[down_m > 0.0]) == pytest.approx(0.25 * 686.0 / 340.5, abs=0.01)


def test_a_low_thing_is_in_the_fused_map_only() -> None:
    shown = map_tour(Tour("beam-room", "stand", 1))
    assert shown["fused"].objects.hits == shown["fused"].objects.total > 0
    assert shown["fused"].lost == ()
    assert shown["lidar alone"].objects.hits == 0
    assert shown["fused"].ate_m < 0.01


def test_one_lap_is_all_of_one_lap() -> None:
    first, every = map_laps(Tour("beam-room", "stand", 2))
    assert first == every
    assert first.recall.total > 0
