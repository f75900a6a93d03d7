"""What is measured of the maps of a comparison, on maps whose answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datasets.errors import InputError
from datasets.messages import Array
from datasets.options import ReadOptions
from datasets.recording import Calibration, CameraCalibration, LidarCalibration
from datasets.se2 import se2, transform
from datasets.trajectory import Trajectory
from slam.comparison.measures import MapOfPart, lacked_by, map_figures
from slam.comparison.parts import PAPER_PART, UNION_PART, parts_of
from slam.config import Config
from slam.mapping.layers import LayeredMap
from slam.mapping.occupancy import FREE, OCCUPIED, UNKNOWN, MapConfig, OccupancyGrid, occupied_cells

CONFIG = MapConfig()
SIDE_M = 0.05


def drawn(classes: np.ndarray[tuple[int, int], np.dtype[np.int64]]) -> OccupancyGrid:
    """A grid at (-1, -2) whose cells are of these classes."""
    hits = np.where(classes == OCCUPIED, 5.0, 0.0).astype(np.float32)
    passes = np.where(classes == FREE, 5.0, 0.0).astype(np.float32)
    return OccupancyGrid((-1.0, -2.0), SIDE_M, hits, passes)


def way(T_map_other: Array | None = None) -> Trajectory:
    """Along x, through the middle of the grid; seen from another map if it is said where."""
    rows = np.column_stack([np.linspace(-1.0, 3.0, 41), np.full(41, 0.0), np.zeros(41)])
    if T_map_other is not None:
        yaw = math.atan2(T_map_other[1, 0], T_map_other[0, 0])
        rows = np.column_stack([transform(T_map_other, rows[:, :2]), rows[:, 2] + yaw])
    return Trajectory(np.arange(41, dtype=np.int64) * 10**8, rows)


def hall() -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """Free, with a wall along its upper side; unknown at the left end."""
    classes = np.full((80, 80), FREE)
    classes[:, :5] = UNKNOWN
    classes[70, 5:] = OCCUPIED
    return classes


def test_boxes_that_the_other_map_lacks_are_counted_with_their_area() -> None:
    full = hall()
    full[20:24, 30:36] = OCCUPIED  # 24 cells
    full[40, 50], full[41, 51] = OCCUPIED, OCCUPIED  # two that touch at a corner
    full[50, 20] = OCCUPIED  # one alone is not counted
    full[10:12, 1:3] = OCCUPIED  # 4 cells where the other map knows nothing
    own, other = MapOfPart(drawn(full), way()), MapOfPart(drawn(hall()), way())
    found = lacked_by(own, other, CONFIG)
    assert found["groups"] == 3
    assert found["area_m2"] == pytest.approx(30 * SIDE_M**2)
    assert found["free_groups"] == 2
    assert lacked_by(other, own, CONFIG) == {"groups": 0, "area_m2": 0.0, "free_groups": 0}


def test_what_lies_beside_a_thing_of_the_other_map_is_that_thing() -> None:
    thick = hall()
    thick[67:70, 5:] = OCCUPIED  # to 15 cm before the wall
    own, other = MapOfPart(drawn(thick), way()), MapOfPart(drawn(hall()), way())
    assert lacked_by(own, other, CONFIG)["groups"] == 0
    thick[66, 5:] = OCCUPIED
    own = MapOfPart(drawn(thick), way())
    assert lacked_by(own, other, CONFIG) == {
        "groups": 1,
        "area_m2": pytest.approx(75 * SIDE_M**2),
        "free_groups": 1,
    }


def test_a_map_that_lies_elsewhere_is_moved_along_its_trajectory() -> None:
    """Half a metre off: without the trajectories the whole wall would be something new."""
    T_map_other = se2(0.5, -0.5, 0.0)
    moved = OccupancyGrid((-0.5, -2.5), SIDE_M, drawn(hall()).hits, drawn(hall()).passes)
    own, other = MapOfPart(drawn(hall()), way()), MapOfPart(moved, way(T_map_other))
    assert lacked_by(own, other, CONFIG)["groups"] == 0
    wrongly = MapOfPart(moved, way())
    assert lacked_by(own, wrongly, CONFIG)["groups"] == 1


def test_an_empty_map_lacks_all_and_has_nothing_to_add() -> None:
    nothing = MapOfPart(drawn(np.full((80, 80), UNKNOWN)), way())
    full = MapOfPart(drawn(hall()), way())
    assert lacked_by(full, nothing, CONFIG)["groups"] == 1
    assert lacked_by(nothing, full, CONFIG)["groups"] == 0


def test_the_size_of_a_map_is_that_of_what_is_known() -> None:
    figures = map_figures(drawn(hall()), CONFIG)
    assert figures["width_m"] == pytest.approx(75 * SIDE_M)
    assert figures["height_m"] == pytest.approx(80 * SIDE_M)
    assert figures["occupied_cells"] == 75
    assert figures["free_m2"] == pytest.approx((79 * 75) * SIDE_M**2)
    empty = map_figures(drawn(np.full((8, 8), UNKNOWN)), CONFIG)
    assert (empty["width_m"], empty["height_m"]) == (0.0, 0.0)


def test_cells_are_given_by_their_centres() -> None:
    classes = np.full((4, 6), FREE)
    classes[1, 4] = OCCUPIED
    np.testing.assert_allclose(
        occupied_cells(drawn(classes), drawn(classes).classes(CONFIG)), [[-0.775, -1.925]]
    )
    layered = LayeredMap({"lidar": drawn(np.full((4, 6), FREE)), "camera": drawn(classes)})
    np.testing.assert_allclose(occupied_cells(layered, layered.classes(CONFIG)), [[-0.775, -1.925]])


def calibration(lidars: dict[str, float], cameras: tuple[str, ...] = ()) -> Calibration:
    """Lidars by name at heights, m."""

    def at(z_m: float) -> LidarCalibration:
        T = np.eye(4)
        T[2, 3] = z_m
        return LidarCalibration(T)

    return Calibration(
        {name: at(z_m) for name, z_m in lidars.items()},
        {name: CameraCalibration(np.eye(4), None) for name in cameras},
    )


def test_a_lidar_and_a_camera_are_compared_alone_and_together() -> None:
    parts = parts_of(calibration({"scan": 0.9}, ("depth",)), ReadOptions(), Config(), "bag")
    assert [part.name for part in parts] == ["lidar", "camera", "fused"]
    assert [part.config.sensors for part in parts] == ["lidar", "camera", "fused"]
    assert {part.config.fusion for part in parts} == {"better"}
    assert all(part.reading == ReadOptions() for part in parts)


def test_of_lidars_at_different_heights_the_highest_is_taken_alone() -> None:
    sensors = calibration({"low": 0.2, "high left": 0.9, "high right": 0.85})
    parts = parts_of(sensors, ReadOptions(), Config(), "bag", (PAPER_PART, UNION_PART))
    assert [part.name for part in parts] == ["lidar", "fused", "paper", "union"]
    assert parts[0].reading.lidars == ("high left", "high right")
    assert [part.config.fusion for part in parts[1:]] == ["better", "paper", "union"]
    assert all(part.reading.lidars == () for part in parts[1:])


def test_what_a_person_set_holds_for_all_parts() -> None:
    config = Config(loops=False, map=MapConfig(resolution_m=0.1))
    for part in parts_of(calibration({"a": 1.0}, ("b",)), ReadOptions(), config, "bag"):
        assert part.config.loops is False
        assert part.config.map.resolution_m == 0.1


@pytest.mark.parametrize(
    "sensors",
    [
        calibration({"scan": 0.9}),
        calibration({"front": 0.5, "rear": 0.5}),
        calibration({}, ("depth",)),
        calibration({}),
    ],
)
def test_one_kind_of_sensor_has_nothing_to_be_compared_with(sensors: Calibration) -> None:
    with pytest.raises(InputError, match="nothing to compare") as error:
        parts_of(sensors, ReadOptions(), Config(), "bag")
    assert "slam run" in error.value.remedy
