"""Drawing the grid: single beams by hand, a plain twin of the kernel, walls and people."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from datasets.messages import Array
from datasets.se2 import se2, transform
from datasets.trajectory import Trajectory
from slam.mapping import occupancy, occupancy_kernels
from slam.mapping.occupancy import FREE, OCCUPIED, UNKNOWN, MapConfig, OccupancyGrid, draw_grid
from slam.mapping.scan_store import BEAM, CLEAR, SURFACE, ScanStore

CONFIG = MapConfig()


def store(points: list[Array], origin: tuple[float, float] = (0.0, 0.0)) -> ScanStore:
    stamps = [k * 10**8 for k in range(len(points))]
    return ScanStore.from_scans(stamps, ["front"] * len(points), points, {"front": origin})


def poses(rows: list[tuple[float, float, float]]) -> Trajectory:
    return Trajectory(np.arange(len(rows)) * 10**8, np.array(rows, dtype=np.float64))


def cell(grid: OccupancyGrid, x_m: float, y_m: float) -> tuple[int, int]:
    corner_x, corner_y = grid.corner_map_m
    return (
        math.floor((y_m - corner_y) / grid.resolution_m),
        math.floor((x_m - corner_x) / grid.resolution_m),
    )


def cast(origin: Array, bearings: Array, walls: Array) -> Array:
    """Ranges from an origin along bearings to the nearest of walls (W, 4); inf for none."""
    ray = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)[:, None]
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    cross = ray[..., 0] * along[:, 1] - ray[..., 1] * along[:, 0]
    to = start - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (to[:, 0] * along[:, 1] - to[:, 1] * along[:, 0]) / cross
        share = (to[:, 0] * ray[..., 1] - to[:, 1] * ray[..., 0]) / cross
        hit = (t > 0) & (share >= 0) & (share <= 1)
    ranges: Array = np.where(hit, t, np.inf).min(axis=1)
    return ranges


def test_one_beam_frees_its_way_and_hits_its_end() -> None:
    grid = draw_grid(
        store([np.array([[1.025, 0.025]])], (0.025, 0.025)), poses([(0, 0, 0)]), CONFIG
    )
    row, column = cell(grid, 1.025, 0.025)
    assert grid.hits.sum() == grid.hits[row, column] == 1
    start = cell(grid, 0.025, 0.025)[1]
    expected = np.zeros_like(grid.passes)
    expected[row, start:column] = 1  # up to 5 cm before the hit, the middle of the last cell
    np.testing.assert_array_equal(grid.passes, expected)
    classes = grid.classes(CONFIG)
    assert classes[row, column] == OCCUPIED
    assert (classes[row, start:column] == FREE).all()
    assert (classes == UNKNOWN).sum() == classes.size - 21
    assert np.isnan(grid.probability(3.0)[0, 0])


def test_pose_and_sensor_place_are_applied() -> None:
    """Base at (2, 1) facing north, a lidar 0.3 m to its left, a hit 1 m ahead of the base."""
    grid = draw_grid(
        store([np.array([[1.0, 0.0]])], (0.0, 0.3)), poses([(2.01, 1.01, math.pi / 2)]), CONFIG
    )
    assert grid.hits[cell(grid, 2.01, 2.01)] == 1
    assert grid.passes[cell(grid, 1.71, 1.01)] == 1, "the ray starts at the lidar"
    assert grid.passes[cell(grid, 2.01, 1.01)] == 0, "not at the base"


def test_each_lidar_has_its_own_origin() -> None:
    scans = ScanStore.from_scans(
        [5, 5],
        ["low", "high"],
        [np.array([[1.01, 0.01]]), np.array([[0.01, 1.01]])],
        {"low": (0.51, 0.01), "high": (0.01, 0.51)},
    )
    grid = draw_grid(scans, Trajectory(np.array([5]), np.zeros((1, 3))), CONFIG)
    assert grid.passes[cell(grid, 0.51, 0.01)] == grid.passes[cell(grid, 0.01, 0.51)] == 1
    assert grid.passes[cell(grid, 0.01, 0.01)] == 0
    assert grid.passes[cell(grid, 0.26, 0.26)] == 0


def overlap(start: Array, ray: Array, length: float, shape: tuple[int, int]) -> Array:
    """How long a ray runs in each cell, by clipping it against every cell's sides."""
    enter = np.zeros(shape)
    leave = np.full(shape, length)
    rows, columns = np.indices(shape)
    for at, direction, low in zip(start, ray, (columns, rows), strict=True):
        if abs(direction) < 1e-12:
            inside = (low <= at) & (at < low + 1)
            leave = np.where(inside, leave, -np.inf)
            continue
        a, b = (low - at) / direction, (low + 1 - at) / direction
        enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
    return leave - enter


@settings(max_examples=150, deadline=None)
@given(
    st.floats(0.0, 11.99),
    st.floats(0.0, 8.99),
    st.one_of(st.floats(-math.pi, math.pi), st.sampled_from([k * math.pi / 4 for k in range(8)])),
    st.floats(0.0, 40.0),
)
def test_walk_visits_exactly_the_cells_a_ray_crosses(
    x: float, y: float, angle: float, length: float
) -> None:
    passes = np.zeros((9, 12), np.float32)
    marks, hits = np.zeros_like(passes, np.int32), np.zeros_like(passes)
    ux, uy = math.cos(angle), math.sin(angle)
    occupancy_kernels.walk(marks, hits, passes, 1, 3.0, math.inf, x, y, ux, uy, length)
    crossed = overlap(np.array([x, y]), np.array([ux, uy]), length, passes.shape)
    assert passes.max() == 1
    assert (passes[crossed > 1e-9] == 1).all()
    assert (passes[crossed < -1e-9] == 0).all()


def twin(
    scans: ScanStore, rows: Array, grid: OccupancyGrid, max_range_m: float, memory: float
) -> tuple[Array, Array]:
    """The votes of ``occupancy_kernels.count``, in plain NumPy, scan by scan."""
    hits, passes = np.zeros(grid.shape), np.zeros(grid.shape)
    for i, row in enumerate(rows):
        mine = slice(scans.offsets[i], scans.offsets[i + 1])
        points, roles = scans.points_base[mine].astype(float), scans.roles[mine]
        T_map_base = se2(*row)
        origin = scans.origins_base[scans.sensor_index[i]]
        skipped = scans.clear_from_m[scans.sensor_index[i]] / grid.resolution_m
        start = (transform(T_map_base, origin[None])[0] - grid.corner_map_m) / grid.resolution_m
        hit, passed = np.zeros(hits.shape, bool), np.zeros(hits.shape, bool)
        for j, point in enumerate(points):
            away = point - origin
            range_m = float(np.hypot(*away))
            ray = away / range_m
            length = min(range_m, max_range_m) / grid.resolution_m
            if range_m <= max_range_m and roles[j] != CLEAR:
                hit[cell(grid, *transform(T_map_base, point[None])[0])] = True
            if roles[j] == SURFACE:
                continue
            if range_m <= max_range_m and roles[j] == BEAM:
                squares = []
                for k in (j - 1, j + 1):
                    if 0 <= k < len(points) and np.hypot(*(points[k] - point)) < 1.0:
                        surface = (points[k] - point) / np.hypot(*(points[k] - point))
                        squares.append(abs(ray[0] * surface[1] - ray[1] * surface[0]))
                length -= 1.0 / max(max(squares, default=1.0), 0.1)
            if length > skipped:
                ray_map = T_map_base[:2, :2] @ ray
                begin = start + skipped * ray_map
                passed |= overlap(begin, ray_map, length - skipped, hits.shape) > 0
        # What is remembered: as many votes as there is room for, the newest kind first.
        hits = np.where(hit, np.minimum(hits + 1, memory / 3), hits)
        passes = np.where(hit, np.minimum(passes, memory - 3 * hits), passes)
        passed &= ~hit
        passes = np.where(passed, np.minimum(passes + 1, memory), passes)
        hits = np.where(passed, np.minimum(hits, (memory - passes) / 3), hits)
    return hits, passes


@pytest.mark.parametrize("memory", [math.inf, 4.0])
def test_counts_agree_with_a_plain_twin(memory: float) -> None:
    rng = np.random.default_rng(7)
    points, roles, rows = [], [], []
    for _ in range(30):
        bearings = np.sort(rng.uniform(-math.pi, math.pi, 25))
        ranges = rng.uniform(0.2, 2.0, 25)
        points.append(np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)]))
        roles.append(rng.choice([BEAM, SURFACE, CLEAR], 25).astype(np.uint8))
        rows.append(tuple(rng.uniform([-1, -1, -3], [1, 1, 3])))
    trajectory = poses(rows)
    scans = ScanStore.from_scans(
        trajectory.stamps_ns.tolist(),
        ["front", "depth"] * 15,
        points,
        {"front": (0.1, -0.05), "depth": (0.2, 0.0)},
        roles=roles,
        clear_from_m={"depth": 0.4},
    )
    config = MapConfig(max_range_m=1.7)
    grid = draw_grid(scans, trajectory, config, memory=memory)
    hits, passes = twin(scans, trajectory.xyyaw, grid, 1.7, memory)
    np.testing.assert_allclose(grid.hits, hits, atol=1e-5)
    np.testing.assert_allclose(grid.passes, passes, atol=1e-5)
    assert (3 * hits + passes).max() > 4.0 or memory == 4.0, "some cells have more to remember"
    assert hits.sum() < 500, "some beams are too long"
    again = draw_grid(scans, trajectory, config, memory=memory)
    np.testing.assert_array_equal(grid.hits, again.hits)
    np.testing.assert_array_equal(grid.passes, again.passes)


def test_a_memory_holds_so_many_votes_and_no_more() -> None:
    """Fifty hits in one cell, then beams through it: 11 of 30 votes undo them, 25 free the cell."""
    near, far = [np.array([[1.025, 0.0]])] * 50, [np.array([[2.025, 0.0]])]
    for passed, expected in ((10, OCCUPIED), (11, UNKNOWN), (24, UNKNOWN), (25, FREE)):
        points = near + far * passed
        rows = [(0.0, 0.012, 0.0)] * len(points)
        grid = draw_grid(store(points), poses(rows), CONFIG, memory=CONFIG.camera_memory)
        assert grid.classes(CONFIG)[cell(grid, 1.025, 0.012)] == expected
        ever = draw_grid(store(points), poses(rows), CONFIG)
        assert ever.classes(CONFIG)[cell(ever, 1.025, 0.012)] == OCCUPIED


def corridor_scans(
    rng: np.random.Generator, walls: Array, person: bool
) -> tuple[ScanStore, Trajectory]:
    """100 noisy scans (0.5 deg, range 1.5 cm, pose 1 cm and 0.2 deg) down a corridor."""
    bearings = np.linspace(-math.pi / 2, math.pi / 2, 361)
    points, rows = [], []
    for k in range(100):
        place = np.array([0.5 + 0.1 * k, 1.0])
        seen = walls
        if person and k < 20:  # stands where the robot passes later, first at one place
            seen = np.vstack([walls, [6.0, 0.8 + 0.01 * k, 6.0, 1.1 + 0.01 * k]])
        ranges = cast(place, bearings, seen) + rng.normal(0.0, 0.015, bearings.size)
        keep = np.isfinite(ranges)
        points.append(np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])[keep])
        noise = rng.normal(0.0, [0.01, 0.01, 0.0035])
        rows.append((place[0] + noise[0], place[1] + noise[1], noise[2]))
    return store(points), poses(rows)


def test_a_wall_seen_at_grazing_angles_survives() -> None:
    walls = np.array([[0.0, 0.012, 14.0, 0.012], [0.0, 2.03, 14.0, 2.03], [14.0, 0.0, 14.0, 2.1]])
    grid = draw_grid(*corridor_scans(np.random.default_rng(3), walls, False), CONFIG)
    occupied = grid.classes(CONFIG) == OCCUPIED
    for y_m in (0.012, 2.03):
        row, first = cell(grid, 1.0, y_m)
        last = cell(grid, 13.5, y_m)[1]
        covered = occupied[row - 1 : row + 2, first:last].any(axis=0)
        assert covered.mean() > 0.97
    middle = occupied[cell(grid, 1.0, 0.2)[0] : cell(grid, 1.0, 1.8)[0], :][
        :, cell(grid, 1.0, 1.0)[1] : cell(grid, 13.5, 1.0)[1]
    ]
    assert not middle.any()


def test_a_person_who_left_is_erased() -> None:
    walls = np.array([[0.0, 0.012, 14.0, 0.012], [0.0, 2.03, 14.0, 2.03], [14.0, 0.0, 14.0, 2.1]])
    scans, trajectory = corridor_scans(np.random.default_rng(4), walls, True)
    grid = draw_grid(scans, trajectory, CONFIG)
    stood = (
        slice(cell(grid, 6.0, 0.75)[0], cell(grid, 6.0, 1.35)[0]),
        slice(cell(grid, 5.85, 1.0)[1], cell(grid, 6.15, 1.0)[1]),
    )
    assert grid.hits[stood].sum() > 50, "the person was seen"
    assert (grid.classes(CONFIG)[stood] != OCCUPIED).all()
    assert (grid.classes(CONFIG)[stood] == FREE).mean() > 0.7


def test_a_thin_thing_outweighs_the_beams_that_pass_it_in_the_same_cell() -> None:
    fan = np.linspace(-0.02, 0.02, 9)
    points = np.column_stack([5.0 * np.cos(fan), 5.0 * np.sin(fan)])
    points[4] = (1.01, 0.0)
    grid = draw_grid(store([points]), poses([(0.01, 0.01, 0.0)]), CONFIG)
    assert grid.classes(CONFIG)[cell(grid, 1.02, 0.01)] == OCCUPIED


def test_a_stray_far_return_clears_but_does_not_stretch_the_map() -> None:
    near = np.array([[2.0, 0.0], [0.0, 2.0], [80.0, 80.0]])
    grid = draw_grid(store([near]), poses([(0, 0, 0)]), MapConfig(max_range_m=10.0))
    assert max(grid.hits.shape) < 70
    assert grid.hits.sum() == 2
    assert grid.passes[cell(grid, 1.5, 1.5)] == 1


def test_a_runaway_trajectory_gets_coarser_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(occupancy, "MAX_CELLS", 10_000)
    points = [np.array([[1.0, 0.0]])] * 2
    grid = draw_grid(store(points), poses([(0, 0, 0), (100.0, 30.0, 0.0)]), CONFIG)
    assert grid.hits.size <= 10_000
    assert grid.resolution_m == pytest.approx(0.8)
    assert grid.hits.sum() == 2


def test_scans_without_a_return_and_no_scans_at_all() -> None:
    empty = np.empty((0, 2))
    grid = draw_grid(store([empty, empty]), poses([(0, 0, 0), (1, 0, 0)]), CONFIG)
    assert grid.hits.sum() == grid.passes.sum() == 0
    with pytest.raises(ValueError, match="no scans"):
        draw_grid(store([]), poses([(0, 0, 0)]), CONFIG)


def test_config_refuses_thresholds_out_of_order_and_unknown_names() -> None:
    with pytest.raises(ValidationError):
        MapConfig(free_threshold=0.7)
    with pytest.raises(ValidationError):
        MapConfig(resolution=0.05)  # type: ignore[call-arg]


def test_thresholds_decide_the_classes() -> None:
    """3 passes and 1 hit of weight 3: probability one half."""
    one = np.ones((1, 1), np.float32)
    grid = OccupancyGrid((0.0, 0.0), 0.05, one, 3 * one)
    assert grid.classes(CONFIG)[0, 0] == UNKNOWN
    assert grid.classes(MapConfig(occupied_threshold=0.5))[0, 0] == OCCUPIED
    assert grid.classes(MapConfig(free_threshold=0.51))[0, 0] == FREE
