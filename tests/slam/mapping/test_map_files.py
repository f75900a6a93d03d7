"""The map files, read as map_server reads them, by a loader that is not ours."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from datasets.trajectory import Trajectory
from slam.mapping.layers import LayeredMap
from slam.mapping.map_files import write_map
from slam.mapping.map_set import write_map_set
from slam.mapping.occupancy import MapConfig, OccupancyGrid


class ServedMap:
    """nav2_map_server's map_io.cpp, trinary mode: image and YAML to a nav_msgs/OccupancyGrid."""

    def __init__(self, yaml_path: Path, free_thresh: float | None = None) -> None:
        meta = yaml.safe_load(yaml_path.read_text())
        assert meta["mode"] == "trinary"
        shade = np.asarray(Image.open(yaml_path.parent / meta["image"]), dtype=np.float64) / 255
        occupancy = shade if meta["negate"] else 1.0 - shade
        free = meta["free_thresh"] if free_thresh is None else free_thresh
        data = np.full(shade.shape, -1)
        data[occupancy < free] = 0
        data[occupancy > meta["occupied_thresh"]] = 100
        self.data = data[::-1]  # row 0 of the message is the lowest y
        self.resolution = meta["resolution"]
        self.x, self.y, self.yaw = meta["origin"]

    def at(self, x_m: float, y_m: float) -> int:
        """costmap_2d's worldToMap: the origin is the corner of the first cell."""
        row = math.floor((y_m - self.y) / self.resolution)
        column = math.floor((x_m - self.x) / self.resolution)
        return int(self.data[row, column])


def asymmetric_room() -> OccupancyGrid:
    """7 m x 3 m, free inside, walled; one pillar near the upper left, one spot unknown."""
    hits, passes = np.zeros((60, 140), np.float32), np.zeros((60, 140), np.float32)
    passes[5:55, 5:135] = 4
    for wall in (np.s_[5, 5:135], np.s_[54, 5:135], np.s_[5:55, 5], np.s_[5:55, 134]):
        hits[wall], passes[wall] = 9, 1
    hits[40:44, 20:30], passes[40:44, 20:30] = 5, 0
    passes[10:20, 100:110] = 0
    return OccupancyGrid((-1.25, 0.4), 0.05, hits, passes)


def test_map_server_sees_every_place_where_it_is(tmp_path: Path) -> None:
    write_map(tmp_path, asymmetric_room(), MapConfig())
    served = ServedMap(tmp_path / "map.yaml")
    assert served.data.shape == (60, 140)
    assert (served.x, served.y, served.yaw) == (-1.25, 0.4, 0.0)
    assert served.at(-0.01, 2.51) == 100, "the pillar, at cells 20-29, 40-43"
    assert served.at(4.01, 1.16) == -1, "the unknown spot"
    for mirrored in ((4.51, 2.51), (-0.01, 1.1), (4.51, 1.1), (1.0, 0.9)):
        assert served.at(*mirrored) == 0
    assert served.at(-1.0 + 0.01, 1.5) == 100, "left wall"
    assert served.at(-1.2, 0.45) == -1, "outside"


@pytest.mark.parametrize("seed", range(5))
def test_all_classes_survive_for_any_grid(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 40, 2))
    hits, passes = (rng.integers(0, 5, shape).astype(np.float32) for _ in range(2))
    grid = OccupancyGrid((0.0, 0.0), 0.1, hits, passes)
    write_map(tmp_path, grid, MapConfig(hit_weight=1.0), name="layer")
    served = ServedMap(tmp_path / "layer.yaml")
    votes = np.maximum(hits + passes, 1)
    expected = np.full(shape, -1)
    expected[(hits / votes < 0.196) & (hits + passes > 0)] = 0
    expected[(hits / votes >= 0.65) & (hits + passes > 0)] = 100
    np.testing.assert_array_equal(served.data, expected)


def test_only_three_grey_values_that_opencv_reads_too(tmp_path: Path) -> None:
    write_map(tmp_path, asymmetric_room(), MapConfig())
    image = cv2.imread(str(tmp_path / "map.pgm"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.dtype == np.uint8
    assert set(np.unique(image)) == {0, 205, 254}


def test_other_thresholds_change_cells_but_not_how_grey_is_decoded(tmp_path: Path) -> None:
    grid = asymmetric_room()
    grid.passes[10:20, 60:70], grid.hits[10:20, 60:70] = 3, 1  # probability one half
    write_map(tmp_path, grid, MapConfig())
    assert ServedMap(tmp_path / "map.yaml").at(2.0, 1.2) == -1
    write_map(tmp_path, grid, MapConfig(occupied_threshold=0.4, free_threshold=0.3))
    served = ServedMap(tmp_path / "map.yaml")
    assert served.at(2.0, 1.2) == 100
    assert served.at(4.01, 1.16) == -1


def test_the_loader_shows_the_old_trap(tmp_path: Path) -> None:
    """With free_thresh 0.25, as old tutorials have it, unknown would load as free."""
    write_map(tmp_path, asymmetric_room(), MapConfig())
    assert ServedMap(tmp_path / "map.yaml", free_thresh=0.25).at(-1.2, 0.45) == 0


STANDING = Trajectory(np.array([0]), np.array([[1.0, 1.2, 0.0]]))


def camera_layer() -> OccupancyGrid:
    """On the cells of the room: a low box, floor around it, and nothing else seen."""
    hits, passes = np.zeros((60, 140), np.float32), np.zeros((60, 140), np.float32)
    passes[8:20, 60:80] = 9
    hits[10:14, 70:76], passes[10:14, 70:76] = 5, 0
    return OccupancyGrid((-1.25, 0.4), 0.05, hits, passes)


def test_each_layer_has_its_map_and_the_combined_one_holds_both(tmp_path: Path) -> None:
    drawn = LayeredMap({"camera": camera_layer(), "lidar 0.92 m": asymmetric_room()})
    write_map_set(tmp_path, drawn, MapConfig(), STANDING)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "map.pgm", "map.png", "map.yaml", "map_camera.pgm", "map_camera.yaml",
        "map_lidar-0.92-m.pgm", "map_lidar-0.92-m.yaml", "map_sources.png",
    ]  # fmt: skip
    combined, camera, lidar = (
        ServedMap(tmp_path / f"{name}.yaml") for name in ("map", "map_camera", "map_lidar-0.92-m")
    )
    box, pillar, mirrored = (2.36, 1.01), (-0.01, 2.51), (2.36, 2.3)
    assert [served.at(*box) for served in (camera, lidar, combined)] == [100, 0, 100]
    assert [served.at(*pillar) for served in (camera, lidar, combined)] == [-1, 100, 100]
    assert [served.at(*mirrored) for served in (camera, lidar, combined)] == [-1, 0, 0]
    assert [served.at(4.01, 1.16) for served in (camera, lidar, combined)] == [-1, -1, -1]
    assert combined.data.shape == camera.data.shape == lidar.data.shape


def test_a_single_layer_is_the_map(tmp_path: Path) -> None:
    write_map_set(tmp_path, LayeredMap({"camera": camera_layer()}), MapConfig(), STANDING)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.pgm", "map.png", "map.yaml"]


def test_layers_of_any_name_get_files_of_their_own(tmp_path: Path) -> None:
    names = ["../up", "a b", "a/b", "A b", "\u00e9\u00e9", "..."]
    write_map_set(
        tmp_path, LayeredMap(dict.fromkeys(sorted(names), camera_layer())), MapConfig(), STANDING
    )
    maps = sorted(path.name for path in tmp_path.glob("map_*.yaml"))
    assert len(maps) == len(names)
    assert {path.parent for path in tmp_path.rglob("*.pgm")} == {tmp_path}
    for name in maps:
        assert name.isascii()
        assert ServedMap(tmp_path / name).at(2.36, 1.01) == 100
