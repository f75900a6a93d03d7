"""The shipped places: bodies, drives, and what the paper lays down about them."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from datasets.messages import Array
from datasets.simulation.drive import DriveLimits, plan_drive
from datasets.simulation.place import SHIPPED, Place, load_place
from tests.datasets.simulation.place_meshes import (
    corners,
    nearest_hit_m,
    open_edges,
    plan_clearance_m,
    seen_by_lidar,
    volume_m3,
)

place = cache(load_place)

TABLES_1_2 = {
    "A": (1.045, 0.746),
    "B": (5.755, -2.133),
    "C": (2.048, -5.954),
    "D": (-5.914, -3.256),
}
TABLE_3_M = (0.720, 0.781, 0.838, 0.776, 1.135, 1.013, 2.041, 1.303, 1.234, 0.862)
LIDAR_Z_M = 0.895


def path_of(here: Place, drive: str) -> Array:
    spec = here.drives[drive]
    return np.append(spec.way_points, spec.way_points[:1], 0) if spec.closed else spec.way_points


def size(here: Place, name: str) -> tuple[Array, Array]:
    solid = next(solid for solid in here.solids if solid.name == name)
    return solid.vertices.min(0), solid.vertices.max(0)


@pytest.mark.parametrize("name", SHIPPED)
def test_every_body_is_closed_and_looks_outwards(name: str) -> None:
    here = place(name)
    for solid in [*here.solids, *(mover.solid for mover in here.movers)]:
        assert open_edges(solid) == [], solid.name
        assert volume_m3(solid) > 1e-5, solid.name
        assert solid.vertices.dtype == np.float32
        assert solid.triangles.dtype == np.uint32


@pytest.mark.parametrize("name", SHIPPED)
def test_names_are_unique_and_the_floor_is_one_of_them(name: str) -> None:
    here = place(name)
    names = [thing.name for thing in (*here.solids, *here.movers)]
    assert len(set(names)) == len(names)
    assert here.name == name
    assert here.floor
    assert size(here, "floor")[1][2] == 0.0


@pytest.mark.parametrize("name", SHIPPED)
def test_drives_start_at_the_origin_looking_along_x(name: str) -> None:
    assert place(name).drives
    for drive in place(name).drives.values():
        assert drive.way_points[0].tolist() == [0.0, 0.0]
        assert drive.start_yaw_rad == 0.0


@pytest.mark.parametrize("name", SHIPPED)
def test_drives_keep_their_distance(name: str) -> None:
    here = place(name)
    for drive in here.drives:
        gap_m, nearest = plan_clearance_m(here.solids, path_of(here, drive))
        assert gap_m >= 0.25, f"{drive} passes {nearest} at {gap_m:.3f} m"


@pytest.mark.parametrize("name", ["room", "office"])
def test_drives_keep_their_distance_as_they_are_driven(name: str) -> None:
    """Rounded corners leave the lines between way points."""
    here = place(name)
    spec = here.drives["tour"]
    drive = plan_drive(
        spec.way_points,
        DriveLimits(),
        start_yaw_rad=spec.start_yaw_rad,
        closed=spec.closed,
        waits_s={0: spec.stand_s},
    )
    times_s = np.arange(0.0, drive.duration_s, 0.25)
    gap_m, nearest = plan_clearance_m(here.solids, drive.pose(times_s)[:, :2])
    assert gap_m >= 0.25, nearest
    # Nobody is in the way when the robot comes by.
    for mover in here.movers:
        met = np.array([mover.T_map_mover(float(time_s))[:2, 3] for time_s in times_s])
        assert np.linalg.norm(met - drive.pose(times_s)[:, :2], axis=1).min() > 0.5


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_places_can_be_read_as_files_too(name: str, tmp_path: Path) -> None:
    shipped = Path(__file__).parents[3] / "datasets" / "simulation" / "places" / f"{name}.yaml"
    copy = tmp_path / shipped.name
    copy.write_bytes(shipped.read_bytes())
    again = load_place(copy)
    assert [solid.name for solid in again.solids] == [solid.name for solid in place(name).solids]


def test_the_room_is_the_papers() -> None:
    here = place("room")
    low, high = size(here, "walls")
    np.testing.assert_allclose(high[:2] - low[:2] - 0.4, 12.5, atol=1e-5)
    for name, corner in TABLES_1_2.items():
        low, high = size(here, name)
        nearest = np.clip(0.0, low[:2], high[:2])
        np.testing.assert_allclose(nearest, corner, atol=1e-6)
        np.testing.assert_allclose(here.points[name], (*corner, 0.0))
        assert high[2] == pytest.approx(0.3)
        assert max(high[:2] - low[:2]) == pytest.approx(0.45)
    boxes = [solid.name for solid in here.solids if solid.name.startswith("box")]
    for name in boxes:
        low, high = size(here, name)
        np.testing.assert_allclose(high - low, 0.9, atol=1e-5)
    assert len(boxes) == 3
    assert math.hypot(*TABLES_1_2["A"]) == pytest.approx(1.28, abs=0.005)


def test_the_rooms_tour_looks_at_each_obstacle() -> None:
    """Within the camera's 86 degrees and 2.5 m of some leg of the tour."""
    here = place("room")
    path = path_of(here, "tour")
    for name, corner in TABLES_1_2.items():
        seen = False
        for start, end in pairwise(path):
            along = (end - start) / np.linalg.norm(end - start)
            for point in np.linspace(start, end, 20):
                to = np.array(corner) - point
                ahead, aside = to @ along, along[0] * to[1] - along[1] * to[0]
                seen |= bool(0.4 < ahead < 2.5 and abs(math.atan2(aside, ahead)) < 0.6)
        assert seen, name


@pytest.mark.parametrize("index", range(10))
def test_the_beams_of_the_beam_room_have_the_tables_lengths(index: int) -> None:
    here = place("beam-room")
    yaw = math.radians(36 * index - 180)
    beam = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    everything = np.concatenate([corners(solid) for solid in here.solids])
    low_m = nearest_hit_m(everything, np.array([0.0, 0.0, 0.25]), beam)
    assert low_m == pytest.approx(TABLE_3_M[index], abs=0.0005)
    high_m = nearest_hit_m(seen_by_lidar(here), np.array([0.0, 0.0, LIDAR_Z_M]), beam)
    over_m = 2.06 if index == 5 else TABLE_3_M[index]
    assert high_m == pytest.approx(over_m, abs=0.0005)


def test_the_beams_of_the_beam_room_do_not_graze_an_edge() -> None:
    """Half a degree to either side they meet the same surface."""
    triangles = np.concatenate([corners(solid) for solid in place("beam-room").solids])
    origin = np.array([0.0, 0.0, 0.25])
    for index, length_m in enumerate(TABLE_3_M):
        for aside_deg in (-0.5, 0.5):
            yaw = math.radians(36 * index - 180 + aside_deg)
            hit_m = nearest_hit_m(triangles, origin, np.array([math.cos(yaw), math.sin(yaw), 0.0]))
            assert hit_m == pytest.approx(length_m, rel=0.02)


def test_the_corridors_have_their_true_lengths() -> None:
    """Measured between the walls, at the height of the lidar, past everything that stands there."""
    here = place("ring-corridor")
    triangles = seen_by_lidar(here)
    lengths = [here.structures[f"corridor-{k}"].length_m for k in (1, 2, 3, 4)]
    assert lengths == pytest.approx([43.0, 51.0, 43.0, 51.0])
    for structure in here.structures.values():
        start, end = np.array(structure.start_m), np.array(structure.end_m)
        middle = np.append((start + end) / 2, LIDAR_Z_M)
        along = np.append(end - start, 0.0) / structure.length_m
        both_m = [nearest_hit_m(triangles, middle, sign * along) for sign in (1.0, -1.0)]
        assert both_m == pytest.approx([structure.length_m / 2] * 2, abs=1e-4), structure.name


def test_the_corridors_count_clockwise_and_are_as_wide_as_told() -> None:
    here = place("ring-corridor")
    middles = [
        np.mean(
            [here.structures[f"corridor-{k}"].start_m, here.structures[f"corridor-{k}"].end_m], 0
        )
        for k in (1, 2, 3, 4)
    ]
    area2 = sum(
        a[0] * b[1] - a[1] * b[0] for a, b in zip(middles, middles[1:] + middles[:1], strict=True)
    )
    assert area2 < 0.0
    x, y = path_of(here, "circle").T
    assert np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) < 0.0
    walls = np.concatenate([corners(s) for s in here.solids if s.name in ("outer wall", "core")])
    # In the bare stretch of each corridor, from wall to wall.
    for point, across in (
        ((14.0, 0.0), (0.0, 1.0)),
        ((36.6, -18.0), (1.0, 0.0)),
        ((16.0, -48.6), (0.0, 1.0)),
        ((-4.0, -26.0), (1.0, 0.0)),
    ):
        origin = np.array([*point, LIDAR_Z_M])
        both_m = [nearest_hit_m(walls, origin, s * np.array([*across, 0.0])) for s in (1, -1)]
        assert both_m == pytest.approx([1.2, 1.2], abs=1e-4)


@pytest.mark.parametrize(
    ("corridor", "axis", "near", "far"),
    [(1, 0, 9.3, 20.4), (2, 1, -26.9, -13.0), (3, 0, 12.0, 23.9), (4, 1, -36.5, -22.4)],
)
def test_each_corridor_has_one_low_obstacle_in_a_bare_stretch(
    corridor: int, axis: int, near: float, far: float
) -> None:
    here = place("ring-corridor")
    low, high = size(here, f"obstacle {corridor}")
    assert high[2] == pytest.approx(0.328)
    corner = np.array(here.points[f"obstacle-{corridor}"][:2])
    assert (
        np.isclose(corner, low[:2], atol=1e-5).sum() + np.isclose(corner, high[:2], atol=1e-5).sum()
        == 2
    )
    assert near < low[axis] < high[axis] < far
    assert 10.0 < far - near < 15.0
    # Nothing else in the stretch but flat walls: at the lidar's height both sides are bare.
    triangles = seen_by_lidar(here)
    across = np.array([0.0, 1.0, 0.0] if axis == 0 else [1.0, 0.0, 0.0])
    middle = {1: 0.0, 2: 36.6, 3: -48.6, 4: -4.0}[corridor]
    for along in np.linspace(near, far, 40):
        origin = np.array([along, middle, LIDAR_Z_M] if axis == 0 else [middle, along, LIDAR_Z_M])
        for sign in (1.0, -1.0):
            assert nearest_hit_m(triangles, origin, sign * across) == pytest.approx(1.2, abs=1e-4)


def test_a_lidar_sees_the_frame_of_a_window_and_not_its_glass() -> None:
    here = place("ring-corridor")
    origin, beam = np.array([2.2, 0.0, LIDAR_Z_M]), np.array([0.0, 1.0, 0.0])
    assert nearest_hit_m(seen_by_lidar(here), origin, beam) == math.inf
    everything = np.concatenate([corners(solid) for solid in here.solids])
    assert nearest_hit_m(everything, origin, beam) == pytest.approx(1.295, abs=1e-3)
    at_bar = np.array([2.8, 0.0, LIDAR_Z_M])
    assert nearest_hit_m(seen_by_lidar(here), at_bar, beam) == pytest.approx(1.27, abs=1e-3)
    panes = [solid for solid in here.solids if "/pane" in solid.name]
    assert len(panes) == 12
    assert all(solid.material.depth == "invisible" for solid in panes)


def test_nobody_in_the_office_walks_into_the_robot_or_the_furniture() -> None:
    here = place("office")
    path = path_of(here, "tour")
    bodies = [mover for mover in here.movers if mover.name.endswith("/body")]
    assert len(bodies) == 3
    steps = [np.linspace(a, b, 200) for a, b in pairwise(path)]
    points = np.concatenate(steps)
    for body in bodies:
        for x, y in body.xyyaw[:, :2]:
            assert np.linalg.norm(points - (x, y), axis=1).min() > 0.5, body.name
        assert plan_clearance_m(here.solids, body.xyyaw[:, :2])[0] >= 0.2


def test_the_office_has_what_a_lidar_misses() -> None:
    """At 0.895 m it passes over the desks; a camera at 0.25 m meets their legs and low things."""
    here = place("office")
    low, high = size(here, "meeting table")
    assert 0.25 < high[2] < LIDAR_Z_M
    # Under the middle of the long edge there is nothing: the top overhangs.
    table = next(corners(s) for s in here.solids if s.name == "meeting table")
    under = np.array([(low[0] + high[0]) / 2, low[1] - 0.5, 0.25])
    at_top = np.array([under[0], under[1], 0.725])
    assert nearest_hit_m(table, under, np.array([0.0, 1.0, 0.0])) == math.inf
    assert nearest_hit_m(table, at_top, np.array([0.0, 1.0, 0.0])) == pytest.approx(0.5, abs=1e-4)
    at_leg = np.array([low[0] + 0.275, low[1] - 0.5, 0.25])
    assert nearest_hit_m(table, at_leg, np.array([0.0, 1.0, 0.0])) == pytest.approx(0.75, abs=1e-4)
