"""Wall thickness on synthetic walls: single, doubled, bent, cluttered, and seen unequally."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.errors import InputError
from datasets.messages import Array
from datasets.se2 import se2, transform
from datasets.trajectory import Stamps, Trajectory
from slam.evaluation.wall_fit import WallLine, fit_walls
from slam.evaluation.wall_thickness import WallThickness, points_of_run, wall_thickness
from slam.mapping.scan_store import BEAM, CLEAR, ScanStore

S = 1_000_000_000
CELL_M = 0.05
CORRIDOR = [((0.0, 0.0), (9.0, 0.0)), ((0.0, 3.0), (9.0, 3.0)), ((9.0, 0.0), (9.0, 3.0))]


class Scene:
    """Collects the hits of glimpses of two seconds on straight segments."""

    def __init__(self, sigma_m: float) -> None:
        self.random = np.random.default_rng(3)
        self.sigma_m = sigma_m
        self.points: list[Array] = []
        self.stamps: list[Stamps] = []

    def see(
        self,
        segments: list[tuple[tuple[float, float], tuple[float, float]]],
        start_s: int,
        *,
        glimpses: int = 5,
        T_map_world: Array | None = None,
    ) -> None:
        for glimpse in range(glimpses):
            for start, end in segments:
                a, b = np.array(start), np.array(end)
                places = self.random.random(int(150 * np.hypot(*(b - a))))[:, None]
                points = a + places * (b - a)
                points = points + self.random.normal(0.0, self.sigma_m, points.shape)
                if T_map_world is not None:
                    points = transform(T_map_world, points)
                self.points.append(points)
                stamp_ns = (start_s + 2 * glimpse) * S
                self.stamps.append(np.full(len(points), stamp_ns, dtype=np.int64))

    def measure(self, T: Array | None = None) -> WallThickness:
        points = np.concatenate(self.points)
        return wall_thickness(
            points if T is None else transform(T, points), np.concatenate(self.stamps)
        )


def cells(thickness: WallThickness) -> float:
    return thickness.percentile_95_m / CELL_M


@pytest.mark.parametrize("turn", [0.0, 0.3, 1.2, np.pi / 2, 2.8])
def test_walls_are_found_where_they_are(turn: float) -> None:
    scene = Scene(0.01)
    scene.see(CORRIDOR, 0)
    T = se2(-3.0, 7.0, turn)
    walls = fit_walls(transform(T, np.concatenate(scene.points)))
    assert len(walls) == 3
    assert sorted(round(wall.length_m, 1) for wall in walls) == pytest.approx([2, 9, 9], abs=0.2)
    for wall in walls:
        best = np.inf
        for start, end in CORRIDOR:
            a, b = transform(T, np.array([start, end]))
            _, across = WallLine(a, b).along_across(np.stack([wall.start_map, wall.end_map]))
            best = min(best, float(np.abs(across).max()))
        assert best < 0.015


@pytest.mark.parametrize(("sigma_m", "turn"), [(0.01, 0.0), (0.01, 0.7), (0.02, 2.0)])
def test_a_single_wall_is_as_thick_as_the_noise(sigma_m: float, turn: float) -> None:
    scene = Scene(sigma_m)
    scene.see(CORRIDOR, 0)
    scene.see(CORRIDOR, 40)
    thickness = scene.measure(se2(1.0, 2.0, turn))
    assert thickness.median_m == pytest.approx(2 * 1.96 * sigma_m, rel=0.15)
    assert cells(thickness) < 2.0


@pytest.mark.parametrize("apart_m", [0.1, 0.2, 0.35])
def test_a_doubled_wall_is_thick(apart_m: float) -> None:
    scene = Scene(0.01)
    scene.see(CORRIDOR, 0)
    scene.see(CORRIDOR, 40, T_map_world=se2(0.0, apart_m, 0.0))
    thickness = scene.measure(se2(0.0, 0.0, 0.4))
    assert thickness.percentile_95_m == pytest.approx(apart_m + 0.04, abs=0.02)
    along_x = [k for k, wall in enumerate(thickness.walls) if wall.length_m > 5]
    doubled = thickness.thickness_m[np.isin(thickness.wall_of, along_x)]
    assert (doubled > apart_m).mean() > 0.9


def test_a_map_that_turned_between_the_passes_is_thick() -> None:
    scene = Scene(0.01)
    scene.see(CORRIDOR, 0)
    scene.see(CORRIDOR, 40, T_map_world=se2(0.0, 0.0, 0.03))
    assert cells(scene.measure()) > 4.0


def test_a_long_halt_does_not_hide_the_other_pass() -> None:
    scene = Scene(0.01)
    scene.see(CORRIDOR, 0, glimpses=19)
    scene.see(CORRIDOR, 100, glimpses=1, T_map_world=se2(0.0, 0.2, 0.0))
    assert cells(scene.measure()) > 4.0


def test_things_at_the_wall_do_not_make_it_thick() -> None:
    shelf = [((x, y), (x + 0.8, y)) for x in (2.0, 5.0) for y in (0.08, 0.16, 0.24, 0.32)]
    posts = [((x, 3.0), (x, 2.7)) for x in (1.0, 3.3, 6.1, 7.9)]
    scene = Scene(0.01)
    for start_s in (0, 40):
        scene.see([*CORRIDOR, *shelf, *posts], start_s)
    thickness = scene.measure()
    assert cells(thickness) < 2.0
    assert thickness.left_out >= 2


def test_clutter_is_not_measured_and_a_passer_by_neither() -> None:
    scene = Scene(0.01)
    scene.see(CORRIDOR, 0)
    random = np.random.default_rng(1)
    clutter = np.array([2.0, 5.5]) + random.normal(0, 0.5, (3000, 2))
    walked = np.column_stack([np.linspace(0, 8, 400), np.full(400, 1.3)])
    for points in (clutter, walked):
        scene.points.append(points)
        scene.stamps.append(np.full(len(points), S, dtype=np.int64))
    thickness = scene.measure()
    x, y = thickness.places_map.T
    assert (np.minimum(np.minimum(abs(y), abs(y - 3.0)), abs(x - 9.0)) < 0.02).all()
    assert cells(thickness) < 2.0


def test_the_same_points_give_the_same_numbers_in_any_order() -> None:
    scene = Scene(0.02)
    scene.see(CORRIDOR, 0)
    points, stamps = np.concatenate(scene.points), np.concatenate(scene.stamps)
    first = wall_thickness(points, stamps)
    again = wall_thickness(points.copy(), stamps.copy())
    np.testing.assert_array_equal(first.thickness_m, again.thickness_m)
    order = np.random.default_rng(0).permutation(len(points))
    shuffled = wall_thickness(points[order], stamps[order])
    assert shuffled.percentile_95_m == pytest.approx(first.percentile_95_m, abs=1e-6)


def test_words_carry_unit_and_protocol() -> None:
    scene = Scene(0.01)
    scene.see(CORRIDOR, 0)
    words = str(scene.measure())
    assert "cells of 5 cm" in words
    assert "n = " in words
    assert "central 95%" in words


@pytest.mark.parametrize("count", [0, 1, 500])
def test_where_there_is_no_wall_it_is_said(count: int) -> None:
    random = np.random.default_rng(0)
    with pytest.raises(InputError, match=f"no bare straight wall of a metre among {count} points"):
        wall_thickness(random.uniform(0, 20, (count, 2)), np.zeros(count, dtype=np.int64))


def test_the_points_of_a_run_lie_on_the_map_with_their_stamps() -> None:
    stamps = np.array([5, 5, 9], dtype=np.int64)
    points_base = np.array([[1, 0], [7, 7], [0, 2], [3, 0]], dtype=np.float32)
    scans = ScanStore(
        stamps_ns=stamps,
        sensor_index=np.array([0, 1, 0]),
        offsets=np.array([0, 3, 3, 4]),
        points_base=points_base,
        roles=np.array([BEAM, CLEAR, BEAM, BEAM], dtype=np.uint8),
        sensors=("front", "back"),
        layers=("lidar", "lidar"),
        origins_base=np.zeros((2, 2)),
        clear_from_m=np.zeros(2),
    )
    poses = np.array([[1.0, 1.0, np.pi / 2], [0.0, 4.0, np.pi]])
    points_map, of_points = points_of_run(scans, Trajectory(np.array([5, 9]), poses))
    np.testing.assert_allclose(points_map, [[1, 2], [-1, 1], [-3, 4]], atol=1e-12)
    assert of_points.tolist() == [5, 5, 9]


def test_bad_arrays_are_refused() -> None:
    stamps = np.zeros(3, dtype=np.int64)
    for points in (np.zeros((3, 3)), np.full((3, 2), np.nan)):
        with pytest.raises(ValueError, match="points"):
            wall_thickness(points, stamps)
    with pytest.raises(ValueError, match="stamps"):
        wall_thickness(np.zeros((4, 2)), stamps)
