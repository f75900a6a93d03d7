"""The map files, read as map_server reads them, by a loader that is not ours."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from slam.map_files import write_map
from slam.occupancy import MapConfig, OccupancyGrid


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
