"""The picture for people shows walls, way, ends and scale where they are."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from datasets.trajectory import Trajectory
from slam.mapping import pictures
from slam.mapping.layers import LayeredMap
from slam.mapping.occupancy import MapConfig, OccupancyGrid
from slam.mapping.pictures import write_picture, write_sources

RESOLUTION_M = 0.05


def grid() -> OccupancyGrid:
    hits, passes = np.zeros((200, 300), np.float32), np.zeros((200, 300), np.float32)
    passes[50:150, 50:250] = 1
    hits[150, 50:100] = 5
    return OccupancyGrid((-5.0, -2.5), RESOLUTION_M, hits, passes)


def picture_of(path: Path, way: list[tuple[float, float]]) -> npt.NDArray[np.int64]:
    rows = np.array([(x, y, 0.0) for x, y in way]).reshape(-1, 3)
    write_picture(path, grid(), MapConfig(), Trajectory(np.arange(len(way)), rows))
    image = cv2.imread(str(path))
    assert image is not None
    return image.astype(np.int64)


def centre(image: npt.NDArray[np.int64], colour: tuple[int, int, int]) -> tuple[float, float]:
    """(x m, y m) in the map of the middle of all pixels of a colour."""
    rows, columns = np.nonzero((image == colour).all(axis=2))
    scale = 4  # 300 cells are drawn 1200 pixels wide
    return (
        -5.0 + (columns.mean() + 0.5) / scale * RESOLUTION_M,
        -2.5 + (200 - (rows.mean() + 0.5) / scale) * RESOLUTION_M,
    )


def test_start_end_and_walls_are_where_they_belong(tmp_path: Path) -> None:
    image = picture_of(tmp_path / "map.png", [(-1.0, 0.5), (2.0, 4.0), (5.0, 1.0)])
    assert image.shape[1] == 1200
    assert centre(image, pictures.START) == pytest.approx((-1.0, 0.5), abs=0.02)
    assert centre(image, pictures.END) == pytest.approx((5.0, 1.0), abs=0.02)
    # A wall along the top left: cells 50-99 of row 150.
    assert centre(image, (0, 0, 0)) == pytest.approx((-5.0 + 75 * 0.05, -2.5 + 150.5 * 0.05))
    on_the_way = image[(200 - 130) * 4 - 1, 140 * 4 - 1]  # (2.0, 4.0), where the line turns
    assert on_the_way[0] > on_the_way[2] + 80, "blue"
    assert (image[10, 10] == 224).all(), "unknown"
    assert (image[240, 240] == 255).all(), "free"


def test_the_bar_is_as_long_as_it_says(tmp_path: Path) -> None:
    """15 m wide: the bar says 2 m, 160 pixels."""
    image = picture_of(tmp_path / "map.png", [(0.0, 0.0), (1.0, 0.0)])
    strip = image[800:]
    ink = (strip == pictures.INK).all(axis=2)
    rows = ink.sum(axis=1)
    bar = np.nonzero(ink[int(rows.argmax())])[0]
    bar = bar[: int(np.argmax(np.diff(bar, append=10**6) > 1)) + 1]
    assert np.ptp(bar) == pytest.approx(160, abs=4)


@pytest.mark.parametrize(
    ("length_m", "bar_m"), [(4.99, 2.0), (5.0, 5.0), (0.3, 0.2), (99.0, 50.0), (100.0, 100.0)]
)
def test_bars_have_round_lengths(length_m: float, bar_m: float) -> None:
    assert pictures._round_down(length_m) == pytest.approx(bar_m)


def test_a_robot_that_never_moved_has_a_picture(tmp_path: Path) -> None:
    image = picture_of(tmp_path / "map.png", [(0.0, 0.0)])
    assert centre(image, pictures.START) == pytest.approx((0.0, 0.0), abs=0.02)


def test_equal_input_gives_equal_bytes(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        picture_of(tmp_path / name, [(0.0, 0.0), (3.0, 2.0)])
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_place_that_cannot_be_written_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"."):
        picture_of(tmp_path / "missing" / "map.png", [(0.0, 0.0)])


def one_row(row: int, first: int, last: int) -> OccupancyGrid:
    """Occupied in some cells of one row, free in a block around the middle."""
    hits, passes = np.zeros((200, 300), np.float32), np.zeros((200, 300), np.float32)
    passes[50:150, 50:250] = 1
    hits[row, first:last] = 5
    return OccupancyGrid((-5.0, -2.5), RESOLUTION_M, hits, passes)


def sources(path: Path, layers: dict[str, OccupancyGrid]) -> npt.NDArray[np.int64]:
    stopped = Trajectory(np.array([0]), np.array([[0.0, 0.0, 0.0]]))
    write_sources(path, LayeredMap(layers), MapConfig(), stopped)
    image = cv2.imread(str(path))
    assert image is not None
    return image.astype(np.int64)


def test_sources_have_colours_and_the_legend_shows_them(tmp_path: Path) -> None:
    """Cells 60-99 by the camera, 80-119 by the lidar a row higher: a cell apart they agree."""
    layers = {"camera": one_row(120, 60, 100), "lidar": one_row(121, 80, 120)}
    image = sources(tmp_path / "map_sources.png", layers)
    camera, lidar, *_ = pictures.BY_LAYER
    drawn, legend = image[:800], image[800:]
    for colour, row, first, last in (
        (camera, 120, 60, 79),
        (lidar, 121, 101, 120),
    ):
        rows, columns = np.nonzero((drawn == colour).all(axis=2))
        assert set(rows // 4) == {199 - row}
        assert (columns.min() // 4, columns.max() // 4) == (first, last - 1)
    rows, columns = np.nonzero((drawn == pictures.SEVERAL).all(axis=2))
    assert set(rows // 4) == {199 - 120, 199 - 121}
    assert (columns.min() // 4, columns.max() // 4) == (79, 100)
    for colour in (camera, lidar, pictures.SEVERAL, pictures.WAY):
        assert (legend == colour).all(axis=2).sum() > 100
    assert not (legend == pictures.BY_LAYER[2]).all(axis=2).any()


def test_a_legend_of_many_layers_breaks_into_lines(tmp_path: Path) -> None:
    few = sources(tmp_path / "few.png", {"a": one_row(60, 60, 70), "b": one_row(70, 60, 70)})
    names = [f"lidar at {k}.00 m, r\u00e9serve" for k in range(6)]
    many = sources(
        tmp_path / "many.png", {n: one_row(60 + 9 * k, 60, 70) for k, n in enumerate(names)}
    )
    assert many.shape[1] == few.shape[1]
    assert many.shape[0] > few.shape[0] + 25, "a line more"
    assert (many[:, -8:] == (255, 255, 255)).all(axis=2)[810:].all(), "nothing is cut off"


def test_a_layer_has_the_same_colour_whatever_others_there_are(tmp_path: Path) -> None:
    camera, lidar, *_ = pictures.BY_LAYER
    for name, colour, other in (("lidar", lidar, camera), ("camera", camera, lidar)):
        image = sources(tmp_path / f"{name}.png", {name: one_row(120, 60, 100)})
        assert (image[:800] == colour).all(axis=2).any()
        assert not (image == other).all(axis=2).any()
        assert not (image == pictures.SEVERAL).all(axis=2).any()


def test_a_map_of_a_trajectory_that_ran_away_has_a_picture_that_can_be_shown(
    tmp_path: Path,
) -> None:
    hits, passes = np.zeros((30, 1_100_000), np.float32), np.zeros((30, 1_100_000), np.float32)
    passes[:, :550_000] = 1
    far = OccupancyGrid((0.0, 0.0), RESOLUTION_M, hits, passes)
    way = Trajectory(np.arange(2), np.array([[1.0, 1.0, 0.0], [50_000.0, 1.0, 0.0]]))
    write_picture(tmp_path / "map.png", far, MapConfig(), way)
    image = cv2.imread(str(tmp_path / "map.png"))
    assert image is not None
    assert image.shape[1] == pictures.MOST_PX


def test_doubtful_places_get_a_ring_where_they_are(tmp_path: Path) -> None:
    import cv2

    hits = np.zeros((200, 300), np.float32)
    grid = OccupancyGrid((-5.0, -5.0), 0.05, hits, np.ones_like(hits))
    trajectory = Trajectory(np.array([0, 1]), np.zeros((2, 3)))
    pictures.write_picture(tmp_path / "plain.png", grid, MapConfig(), trajectory)
    pictures.write_picture(tmp_path / "ring.png", grid, MapConfig(), trajectory, [(4.0, -1.0)])
    plain, ringed = (cv2.imread(str(tmp_path / f"{n}.png")) for n in ("plain", "ring"))
    assert plain is not None
    assert ringed is not None
    rows, columns = np.nonzero((plain != ringed).any(axis=2))
    scale = plain.shape[1] / 300
    assert columns.mean() / scale == pytest.approx((4.0 + 5.0) / 0.05, abs=1.0)
    assert rows.mean() / scale == pytest.approx(200 - (-1.0 + 5.0) / 0.05, abs=1.0)
