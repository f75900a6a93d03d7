"""Layers: a low box under a lidar's rays, how cells are combined, which sensor belongs where."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datasets.messages import Array
from datasets.recording import Calibration, CameraCalibration, LidarCalibration
from datasets.trajectory import Trajectory
from slam.mapping import occupancy
from slam.mapping.layers import LayeredMap, bayes_combined, draw_map, layer_names
from slam.mapping.occupancy import FREE, OCCUPIED, UNKNOWN, MapConfig, OccupancyGrid, draw_grid
from slam.mapping.scan_store import BEAM, CAMERA, CLEAR, LIDAR, SURFACE, VAGUE, ScanStore

CONFIG = MapConfig()
LEVEL = Trajectory(np.array([0]), np.zeros((1, 3)))


def place(drawn: LayeredMap | OccupancyGrid, x_m: float, y_m: float) -> tuple[int, int]:
    """The (row, column) of a place."""
    corner_x, corner_y = drawn.corner_map_m
    return (
        math.floor((y_m - corner_y) / drawn.resolution_m),
        math.floor((x_m - corner_x) / drawn.resolution_m),
    )


def box_and_wall(layers: dict[str, str]) -> tuple[ScanStore, Trajectory]:
    """A lidar sees a wall at 3.01 m over a low box at 1.01 m, 50 times; a camera sees the box, and
    the wall above it."""
    fan = np.linspace(-0.2, 0.2, 81)
    wall = np.column_stack([np.full(81, 3.01), 3.01 * np.tan(fan)])
    front = np.column_stack([np.full(41, 1.01), np.linspace(-0.1, 0.1, 41)])
    rays = np.column_stack([np.full(41, 0.9), np.linspace(-0.09, 0.09, 41)])
    seen = np.vstack([front, wall, rays])
    roles = np.repeat([SURFACE, CLEAR], [41 + 81, 41]).astype(np.uint8)
    stamps = [k * 10**8 for k in range(100)]
    scans = ScanStore.from_scans(
        stamps,
        ["high", "depth"] * 50,
        [wall, seen] * 50,
        {"high": (0.0, 0.0), "depth": (0.01, 0.01)},
        roles=[np.full(81, BEAM, np.uint8), roles] * 50,
        layers=layers,
        clear_from_m={"depth": 0.5},
    )
    return scans, Trajectory(np.array(stamps), np.zeros((100, 3)))


def test_a_low_box_stays_under_the_rays_of_a_high_lidar() -> None:
    drawn = draw_map(*box_and_wall({"high": LIDAR, "depth": CAMERA}), CONFIG)
    assert list(drawn.layers) == [CAMERA, LIDAR]
    camera, lidar = (grid.classes(CONFIG) for grid in drawn.layers.values())
    combined = drawn.classes(CONFIG)
    box, wall = place(drawn, 1.01, 0.0), place(drawn, 3.01, 0.0)
    assert (camera[box], lidar[box], combined[box]) == (OCCUPIED, FREE, OCCUPIED)
    assert (camera[wall], lidar[wall], combined[wall]) == (OCCUPIED, OCCUPIED, OCCUPIED)
    behind = place(drawn, 2.0, 0.0)
    assert (camera[behind], lidar[behind], combined[behind]) == (UNKNOWN, FREE, FREE)
    near = place(drawn, 0.3, 0.0)
    assert (camera[near], lidar[near]) == (UNKNOWN, FREE), "there it doesn't see low things"
    assert camera[place(drawn, 0.7, 0.0)] == FREE


def test_in_a_single_grid_the_lidar_erases_the_box() -> None:
    drawn = draw_map(*box_and_wall({"high": LIDAR, "depth": LIDAR}), CONFIG)
    assert list(drawn.layers) == [LIDAR]
    assert drawn.classes(CONFIG)[place(drawn, 1.01, 0.0)] == OCCUPIED, "one hit, one pass: 3 to 1"
    scans, trajectory = box_and_wall({"high": LIDAR, "depth": LIDAR})
    rarely = np.arange(len(scans)) % 20 == 1  # of 50 views, 5
    kept = ~(scans.sensor_index == scans.sensors.index("depth")) | rarely
    rows = np.repeat(kept, np.diff(scans.offsets))
    counts = np.diff(scans.offsets)[kept]
    few = ScanStore(
        scans.stamps_ns[kept],
        scans.sensor_index[kept],
        np.concatenate([[0], np.cumsum(counts)]),
        scans.points_base[rows],
        scans.roles[rows],
        scans.sensors,
        scans.layers,
        scans.origins_base,
        scans.clear_from_m,
    )
    drawn = draw_map(few, trajectory, CONFIG)
    assert drawn.classes(CONFIG)[place(drawn, 1.01, 0.0)] != OCCUPIED


def test_one_layer_is_the_plain_grid() -> None:
    scans, trajectory = box_and_wall({"high": LIDAR, "depth": LIDAR})
    drawn, plain = draw_map(scans, trajectory, CONFIG), draw_grid(scans, trajectory, CONFIG)
    assert scans.of_layer(LIDAR) is scans
    np.testing.assert_array_equal(drawn.layers[LIDAR].hits, plain.hits)
    np.testing.assert_array_equal(drawn.layers[LIDAR].passes, plain.passes)
    np.testing.assert_array_equal(drawn.classes(CONFIG), plain.classes(CONFIG))


def test_layers_lie_on_common_cells_which_they_share(monkeypatch: pytest.MonkeyPatch) -> None:
    scans, trajectory = box_and_wall({"high": LIDAR, "depth": CAMERA})
    one = draw_grid(scans.of_layer(CAMERA), trajectory, CONFIG)
    both = draw_map(scans, trajectory, CONFIG)
    assert {grid.shape for grid in both.layers.values()} == {both.shape}
    cells = both.shape[0] * both.shape[1]
    monkeypatch.setattr(occupancy, "MAX_CELLS", 2 * cells - 1)
    assert draw_map(scans, trajectory, CONFIG).resolution_m == 0.1
    assert one.resolution_m == both.resolution_m == 0.05


def test_a_vague_surface_counts_where_no_surer_one_explains_it() -> None:
    """A camera that looks up the y axis, base turned: a wall that it sees 0.15 m too near, one
    that is 0.5 m off, one beside the ray; and what another scan of its own layer saw surely."""
    turned = Trajectory(np.array([0, 1]), np.array([[1.0, 0.0, math.pi / 2]] * 2))
    sure = np.array([[3.01, 0.01], [3.01, 1.01], [2.51, 2.01]])
    vague = np.array([[2.86, 0.01], [2.5, 1.0], [2.51, 1.51], [2.39, 1.91]])
    scans = ScanStore.from_scans(
        [0, 1],
        ["high", "depth"],
        [sure, np.vstack([vague, [[2.51, -1.99]]])],
        {"high": (0.0, 0.0), "depth": (0.01, 0.01)},
        roles=[np.zeros(3, np.uint8), np.array([VAGUE] * 4 + [SURFACE], np.uint8)],
        layers={"depth": CAMERA},
    )
    drawn = draw_map(scans, turned, CONFIG)
    camera = drawn.layers[CAMERA].classes(CONFIG) == OCCUPIED
    shown = [bool(camera[place(drawn, 1.0 - y_m, x_m)]) for x_m, y_m in vague]
    assert shown == [False, True, True, False]
    assert camera[place(drawn, 1.0 + 1.99, 2.51)]


SHARES = {"occupied": (3.0, 0.0), "free": (0.0, 9.0), "torn": (1.0, 3.0), "unseen": (0.0, 0.0)}


def cells(*names: str) -> OccupancyGrid:
    hits, passes = np.array([SHARES[name] for name in names], np.float32).T[:, None]
    return OccupancyGrid((0.0, 0.0), 0.05, hits, passes)


@pytest.mark.parametrize("turned", [False, True])
def test_combined_cells_by_every_pair(turned: bool) -> None:
    pairs = {
        ("occupied", "occupied"): OCCUPIED,
        ("occupied", "free"): OCCUPIED,
        ("occupied", "torn"): OCCUPIED,
        ("occupied", "unseen"): OCCUPIED,
        ("free", "free"): FREE,
        ("free", "unseen"): FREE,
        ("free", "torn"): UNKNOWN,
        ("torn", "torn"): UNKNOWN,
        ("torn", "unseen"): UNKNOWN,
        ("unseen", "unseen"): UNKNOWN,
    }
    first, second = (cells(*(pair[k] for pair in pairs)) for k in ((1, 0) if turned else (0, 1)))
    drawn = LayeredMap({"a": first, "b": second})
    np.testing.assert_array_equal(drawn.classes(CONFIG)[0], list(pairs.values()))
    third = LayeredMap({"a": first, "b": second, "c": cells(*["unseen"] * len(pairs))})
    np.testing.assert_array_equal(third.classes(CONFIG), drawn.classes(CONFIG))


def test_layers_on_other_cells_are_refused() -> None:
    with pytest.raises(ValueError, match="2 rasters"):
        LayeredMap({"a": cells("free"), "b": cells("free", "free")})
    with pytest.raises(ValueError, match="0 rasters"):
        LayeredMap({})


def test_bayes_adds_log_odds() -> None:
    """0.5 says nothing; 0.75 twice is 0.9; certain and certainly not cancel; unseen stays so."""

    def grid(*rows: tuple[float, float]) -> OccupancyGrid:
        hits, passes = np.array(rows, np.float32).T[:, None]
        return OccupancyGrid((0.0, 0.0), 0.05, hits, passes)

    one = grid((1, 3), (1, 1), (5, 0), (0, 0), (0, 0), (5, 0))
    other = grid((1, 1), (1, 1), (0, 5), (0, 0), (1, 1), (5, 0))
    fused = bayes_combined(LayeredMap({"a": one, "b": other}), CONFIG)
    expected = [0.75, 0.9, 0.5, np.nan, 0.75, 0.98**2 / (0.98**2 + 0.02**2)]
    np.testing.assert_allclose(fused.probability[0], expected, rtol=1e-5)
    np.testing.assert_array_equal(
        fused.classes(CONFIG)[0], [OCCUPIED, OCCUPIED, UNKNOWN, UNKNOWN, OCCUPIED, OCCUPIED]
    )


def test_by_bayes_rule_a_lidar_above_erases_a_box() -> None:
    drawn = draw_map(*box_and_wall({"high": LIDAR, "depth": CAMERA}), CONFIG)
    fused = bayes_combined(drawn, CONFIG)
    assert fused.classes(CONFIG)[place(drawn, 1.01, 0.0)] == UNKNOWN
    assert fused.classes(CONFIG)[place(drawn, 3.01, 0.0)] == OCCUPIED
    assert fused.shape == drawn.shape


def standing_at(z_m: float) -> LidarCalibration:
    T: Array = np.eye(4)
    T[2, 3] = z_m
    return LidarCalibration(T)


@pytest.mark.parametrize(
    ("heights_m", "layers"),
    [
        ([0.2], ["lidar"]),
        ([0.2, 0.2], ["lidar", "lidar"]),
        ([0.25, 0.2, 0.29], ["lidar", "lidar", "lidar"]),
        ([2.0, 0.1], ["lidar 2.00 m", "lidar 0.10 m"]),
        ([0.9, 0.12, 0.94, 0.1], ["lidar 0.92 m", "lidar 0.11 m", "lidar 0.92 m", "lidar 0.11 m"]),
        ([], []),
    ],
)
def test_lidars_of_one_height_share_a_layer(heights_m: list[float], layers: list[str]) -> None:
    calibration = Calibration(
        {f"/scan{k}": standing_at(z_m) for k, z_m in enumerate(heights_m)},
        {"/depth": CameraCalibration(None, None)},
    )
    names = layer_names(calibration)
    assert names == {"/depth": "camera"} | {f"/scan{k}": name for k, name in enumerate(layers)}


def test_layers_without_scans_are_not_drawn() -> None:
    scans = ScanStore.from_scans(
        [0],
        ["high"],
        [np.array([[1.0, 0.0]])],
        {"high": (0.0, 0.0), "depth": (0.0, 0.0)},
        layers={"depth": CAMERA},
    )
    assert list(draw_map(scans, LEVEL, CONFIG).layers) == [LIDAR]
