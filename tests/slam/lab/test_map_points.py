"""Corners of boxes in maps whose places are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.simulation.place import load_place
from slam.lab.drives.footprint import FootprintCorner, footprint_corner
from slam.lab.drives.map_points import (
    CornerFound,
    CornerNotFound,
    find_corner,
)

BOX = np.array([[0.0, 0.0], [0.45, 0.0], [0.45, 0.25], [0.0, 0.25]])


def turned(points: Array, yaw: float, x: float, y: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    moved: Array = points @ np.array([[c, s], [-s, c]]) + [x, y]
    return moved


def faces(which: list[int], step_m: float = 0.005) -> Array:
    """Points of the box's faces: 0 south, 1 east, 2 north, 3 west."""
    ends = np.vstack([BOX, BOX[:1]])
    pieces = [
        np.linspace(ends[k], ends[k + 1], int(np.hypot(*(ends[k + 1] - ends[k])) / step_m))
        for k in which
    ]
    return np.concatenate(pieces)


def box_at(yaw: float, x: float, y: float) -> FootprintCorner:
    return FootprintCorner("A", turned(BOX, yaw, x, y))


def cells_of(points: Array) -> Array:
    cells: Array = np.unique(np.floor(points / 0.05), axis=0) * 0.05 + 0.025
    return cells


def check(result: object, position: Array, how: str, within_m: float) -> None:
    assert isinstance(result, CornerFound), result
    assert result.how == how
    assert np.hypot(*(result.position_map - position)) < within_m


@settings(max_examples=10, deadline=None)
@given(
    yaw=st.floats(-3.1, 3.1),
    turn=st.floats(-0.15, 0.15),
    dx=st.floats(-0.5, 0.5),
    dy=st.floats(-0.5, 0.5),
    seed=st.integers(0, 1000),
)
def test_the_corner_of_a_turned_and_displaced_box_is_found(
    yaw: float, turn: float, dx: float, dy: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    truth = box_at(yaw, 1.0, 0.7)
    points = turned(faces([0, 3]), yaw + turn, 1.0 + dx, 0.7 + dy)
    points = points + rng.normal(0.0, 0.005, points.shape)
    result = find_corner(truth, points)
    check(result, np.array([1.0 + dx, 0.7 + dy]), "two faces", 0.01)
    assert isinstance(result, CornerFound)
    assert result.error_m == pytest.approx(np.hypot(dx, dy), abs=0.01)
    assert result.residual_m == pytest.approx(0.005, rel=0.3)


@pytest.mark.parametrize("seen", [[0, 3], [0, 1, 3], [0, 1, 2, 3], [3, 0, 2]])
def test_more_faces_do_not_confuse(seen: list[int]) -> None:
    rng = np.random.default_rng(2)
    points = turned(faces(seen), 0.3, 1.1, 0.65)
    points = points + rng.normal(0.0, 0.01, points.shape)
    check(find_corner(box_at(0.35, 1.0, 0.7), points), np.array([1.1, 0.65]), "two faces", 0.01)


@pytest.mark.parametrize("seen", [[0], [0, 1], [0, 1, 2]])
def test_of_one_face_the_end_counts(seen: list[int]) -> None:
    rng = np.random.default_rng(3)
    points = turned(faces(seen), 0.2, 1.06, 0.72)
    points = points + rng.normal(0.0, 0.008, points.shape)
    check(find_corner(box_at(0.2, 1.0, 0.7), points), np.array([1.06, 0.72]), "one face", 0.02)


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.2])
def test_cells_will_do(yaw: float) -> None:
    errors = []
    for k in range(12):
        at = np.array([1.0 + 0.013 * k, 0.7 - 0.009 * k])
        result = find_corner(box_at(yaw, 1.0, 0.7), cells_of(turned(faces([0, 3]), yaw, *at)))
        assert isinstance(result, CornerFound)
        errors.append(np.hypot(*(result.position_map - at)))
    assert np.mean(errors) < 0.025  # of cells along the axes, nothing tells more
    assert max(errors) < 0.05


def test_walls_are_not_taken_for_the_box() -> None:
    """The wall passes 9 cm behind the box, as at D of the room."""
    rng = np.random.default_rng(4)
    wall = np.column_stack([np.full(800, 0.25 + 0.25 + 0.086), np.linspace(-2, 2, 800)])
    box = turned(faces([0, 3]), -np.pi / 2, 0.25, 0.0)  # from its corner faces go back and down
    points = np.vstack([wall, box]) + rng.normal(0.0, 0.008, (len(wall) + len(box), 2))
    truth = box_at(-np.pi / 2, 0.2, 0.05)
    check(find_corner(truth, points), np.array([0.25, 0.0]), "two faces", 0.015)
    assert isinstance(find_corner(truth, points[: len(wall)]), CornerNotFound)
    in_its_place = np.column_stack([np.full(800, 0.2), np.linspace(-2, 2, 800)])
    only_wall = find_corner(truth, in_its_place)
    assert isinstance(only_wall, CornerNotFound)
    assert "longer wall" in only_wall.reason


def test_points_of_the_lidar_layer_are_left_out() -> None:
    wall = np.column_stack([np.linspace(-1, 2, 600), np.full(600, 0.3)])
    result = find_corner(box_at(0.0, 0.0, 0.3), wall, walls_map=wall)
    assert isinstance(result, CornerNotFound)
    assert "nothing within 1 m" in result.reason


def test_what_is_not_there_is_not_found() -> None:
    truth = box_at(0.0, 0.0, 0.0)
    nothing = find_corner(truth, np.empty((0, 2)))
    assert isinstance(nothing, CornerNotFound)
    far = find_corner(truth, faces([0, 3]) + np.array([3.0, 0.0]))
    assert isinstance(far, CornerNotFound)
    stray = find_corner(truth, np.array([[0.1, 0.3], [-0.4, 0.2], [0.3, -0.6]]))
    assert isinstance(stray, CornerNotFound)
    assert "neither face" in stray.reason
    with pytest.raises(ValueError, match="finite"):
        find_corner(truth, np.array([[np.nan, 0.0]]))


def test_the_corners_of_the_room_are_those_of_the_tables() -> None:
    room = load_place("room")
    for name in "ABCD":
        corner = footprint_corner(room, name)
        np.testing.assert_allclose(corner.corner_m, room.points[name][:2], atol=1e-6)
        sides = np.hypot(*(np.roll(corner.outline_m, -1, axis=0) - corner.outline_m).T)
        assert sorted(sides.tolist()) == pytest.approx([0.25, 0.25, 0.45, 0.45], abs=1e-5)
        # It is the corner nearest the start.
        assert np.argmin(np.hypot(*corner.outline_m.T)) == 0
    with pytest.raises(ValueError, match="no point"):
        footprint_corner(room, "E")
