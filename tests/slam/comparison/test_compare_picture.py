"""The picture and the table of a comparison: right pixels, right cells, nothing lost."""

from __future__ import annotations

import csv
import io

import cv2
import numpy as np
import pytest

from datasets.trajectory import Trajectory
from slam.comparison.picture import (
    ALONE,
    COLOURS,
    NOTHING,
    OPEN,
    WALL,
    Panel,
    Window,
    common_window,
    comparison_picture,
    kinds_of,
    pixels_of,
)
from slam.comparison.table import measures, missing_lines, panel_words, table_csv, table_markdown
from slam.mapping.layers import LayeredMap
from slam.mapping.occupancy import MapConfig, OccupancyGrid

CONFIG = MapConfig()


def grid(
    rows: list[str], corner: tuple[float, float] = (0.0, 0.0), side: float = 0.5
) -> OccupancyGrid:
    """Rows from the top: # occupied, . free, blank unknown."""
    classes = np.array([list(row) for row in rows])[::-1]
    hits = np.where(classes == "#", 5.0, 0.0).astype(np.float32)
    passes = np.where(classes == ".", 5.0, 0.0).astype(np.float32)
    return OccupancyGrid(corner, side, hits, passes)


def test_what_the_camera_saw_alone_has_a_kind_of_its_own() -> None:
    lidar = grid(["#####", ".....", ".....", ".... "])
    camera = grid(["     ", " #   ", "   # ", "    #"])
    kinds = kinds_of(LayeredMap({"camera": camera, "lidar": lidar}), CONFIG)[::-1]
    # Beside the lidar's wall it is that wall.
    assert kinds.tolist() == [
        [WALL] * 5,
        [OPEN, WALL, OPEN, OPEN, OPEN],
        [OPEN, OPEN, OPEN, ALONE, OPEN],
        [OPEN, OPEN, OPEN, OPEN, ALONE],
    ]


def test_of_two_lidars_the_lower_one_is_coloured() -> None:
    low, high = grid(["...", "#.."]), grid(["..#", "..."])
    kinds = kinds_of(LayeredMap({"lidar 0.15 m": low, "lidar 0.90 m": high}), CONFIG)[::-1]
    assert kinds.tolist() == [[OPEN, OPEN, WALL], [ALONE, OPEN, OPEN]]


def test_a_single_grid_has_no_sources() -> None:
    assert kinds_of(grid(["# ."]), CONFIG).tolist() == [[WALL, NOTHING, OPEN]]


def test_pixels_lie_where_the_cells_lie() -> None:
    """Two pixels to a cell, in a window that is larger than the map: row 0 is the top."""
    one = grid(["#.", " #"], corner=(1.0, 2.0))
    pixels = pixels_of(one, kinds_of(one, CONFIG), Window(0.5, 1.5, 2.5, 3.5), (8, 8))
    expected = np.full((8, 8), NOTHING)
    expected[2:4, 2:4] = expected[4:6, 4:6] = WALL
    expected[2:4, 4:6] = OPEN
    np.testing.assert_array_equal(pixels, expected)


def test_walls_survive_pixels_that_are_larger_than_cells() -> None:
    rows = ["." * 12 for _ in range(12)]
    rows[4] = "." * 7 + "#" + "." * 4
    large = grid(rows, side=0.1)
    pixels = pixels_of(large, kinds_of(large, CONFIG), Window(0.0, 0.0, 1.2, 1.2), (3, 3))
    expected = np.full((3, 3), OPEN)
    expected[1, 1] = WALL
    np.testing.assert_array_equal(pixels, expected)


def test_a_map_that_ran_away_does_not_make_the_others_small() -> None:
    good = Panel("fused", "", grid(["....", "...."]), None)
    lost = Panel("camera", "", grid([".", "."], corner=(50.0, 0.0)), None, trusted=False)
    near = Panel("camera", "", grid([".", "."], corner=(2.2, 0.0)), None, trusted=False)
    window = common_window([good, lost], CONFIG)
    np.testing.assert_allclose(window, (-0.5, -0.5, 2.5, 1.5))
    np.testing.assert_allclose(common_window([good, near], CONFIG), (-0.5, -0.5, 3.2, 1.5))
    with pytest.raises(ValueError, match="no panel"):
        common_window([Panel("lidar", "why", None, None)], CONFIG)


def test_the_picture_shows_every_map_and_why_one_is_missing() -> None:
    rows = ["#" * 60, *["#" + "." * 58 + "#" for _ in range(38)], "#" * 60]
    walls = grid(rows, side=0.1)
    box = ["." * 60 for _ in range(40)]
    box[20:30] = ["." * 30 + "#" * 10 + "." * 20] * 10
    fused = LayeredMap({"camera": grid(box, side=0.1), "lidar": walls})
    way = Trajectory(np.array([0, 1]), np.array([[1.0, 1.0, 0.0], [2.0, 1.0, 0.0]]))
    panels = [
        Panel("lidar", "by itself", walls, way),
        Panel("camera", "no map: it got lost", None, None),
        Panel("fused", "both", fused, way),
    ]
    picture = comparison_picture(panels, CONFIG)
    assert picture == comparison_picture(panels, CONFIG)
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    alone = [int(COLOURS[ALONE][k : k + 2], 16) for k in (5, 3, 1)]
    rows_px, columns_px = np.nonzero((pixels == alone).all(axis=2))
    width, above = pixels.shape[1], rows_px < pixels.shape[0] - 64
    # The box stands in the last panel of three, and nowhere else but in the legend.
    assert columns_px[above].min() > 2 * width / 3
    assert above.sum() > 1000


def row(name: str, **more: object) -> dict[str, object]:
    return {"name": name, "words": f"sensors of {name}", "why": None, "status": "ok", **more}


ROWS = [
    row(
        "lidar",
        way_m=10.0,
        map={"width_m": 4.0, "height_m": 5.0, "free_m2": 12.0, "occupied_cells": 7},
        lacked={"by": "fused", "groups": 0, "area_m2": 0.0, "free_groups": 0},
        structures=[
            {
                "name": "hall",
                "found": "yes",
                "true_m": 7.0,
                "measured_m": 7.007,
                "std_m": 0.007,
                "gamma_percent": 100.1,
                "gamma_std_percent": 0.1,
            },
            {"name": "niche", "found": "ghosted", "true_m": 1.0, "ends": ["end"],
             "measured_m": [1.0, 1.2], "gamma_percent": [100.0, 120.0]},
            {"name": "room", "found": "no", "reason": "at its end, there is nothing"},
        ],
        ate_m=0.0123,
    ),
    row("camera", status="failed", why="it got lost"),
]  # fmt: skip


def test_the_table_has_a_column_for_each_map_and_says_what_failed() -> None:
    table = dict(measures(ROWS))
    assert table["state"] == ["ok", "failed"]
    assert table["map size, m"] == ["4.0 x 5.0", ""]
    assert table["groups the other map lacks"] == ["0 (fused)", ""]
    assert table["ATE rmse, m"] == ["0.0123", ""]
    assert table["gamma of hall, %"] == ["100.10 +/- 0.10", ""]
    assert table["gamma of niche, %"] == ["ghosted: 100.00 or 120.00", ""]
    assert table["gamma of room, %"] == ["not found", ""]
    assert "CPU, s" not in table  # no row has it
    missing = missing_lines(ROWS)
    assert missing[0] == "no map of camera: it got lost"
    assert any("room not measured in lidar: at its end" in line for line in missing)
    page = table_markdown("drive", ROWS, partial=True)
    lines = [line for line in page.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in lines} == {4}
    assert "PARTIAL" in page
    assert "compare.png" in page


def test_the_csv_has_a_line_for_each_map() -> None:
    lines = list(csv.DictReader(io.StringIO(table_csv(ROWS))))
    assert [line["name"] for line in lines] == ["lidar", "camera"]
    assert float(lines[0]["map.free_m2"]) == 12.0
    assert float(lines[0]["gamma_percent.hall"]) == 100.1
    assert lines[0]["gamma_percent.niche"] == "100.0 or 120.0"
    assert lines[1]["why"] == "it got lost"


def test_the_words_over_a_map_say_what_matters_most() -> None:
    assert panel_words(ROWS[0]) == "12 m2 free, 0 things that fused lacks, ATE 0.012 m"
    assert panel_words(ROWS[1]) == "no map: it got lost"
    low = {"low": {"recall": 0.956}}
    assert "low obstacles 96%" in panel_words({**ROWS[0], "obstacles": low})
    assert panel_words({**ROWS[0], "status": "partial"}).startswith("PARTIAL, ")
