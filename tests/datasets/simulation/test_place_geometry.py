"""Prisms: meshes, overlaps, distances in the plan."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datasets.simulation.place import MATERIALS, Solid
from datasets.simulation.place_geometry import (
    Prism,
    column,
    contains,
    cuboid,
    mesh,
    penetration_m,
    segment_distances,
)
from tests.datasets.simulation.place_meshes import open_edges, volume_m3

lengths = st.floats(0.05, 5.0)
places = st.floats(-10.0, 10.0)
yaws = st.floats(-math.pi, math.pi)


def solid(*prisms: Prism) -> Solid:
    return Solid("s", *mesh(prisms), MATERIALS["wood"])


@given(lengths, lengths, lengths, places, places, yaws)
def test_a_box_is_closed_and_has_its_volume(
    x: float, y: float, z: float, at_x: float, at_y: float, yaw: float
) -> None:
    body = solid(cuboid((0.0, 0.0), (x, y, z), 0.3).placed(at_x, at_y, yaw))
    assert open_edges(body) == []
    assert volume_m3(body) == pytest.approx(x * y * z, rel=1e-3, abs=1e-4)


def test_placing_turns_counter_clockwise_then_moves() -> None:
    moved = cuboid((1.0, 0.0), (0.2, 0.4, 1.0)).placed(5.0, 6.0, math.pi / 2)
    np.testing.assert_allclose(moved.footprint.mean(0), [5.0, 7.0], atol=1e-12)
    np.testing.assert_allclose(np.ptp(moved.footprint, axis=0), [0.4, 0.2], atol=1e-12)


def test_a_column_has_the_volume_of_its_cylinder() -> None:
    body = solid(column((1.0, 2.0), 0.3, 2.0, 0.5))
    assert volume_m3(body) == pytest.approx(math.pi * 0.09 * 2.0, rel=1e-5)
    assert body.vertices[:, 2].min() == 0.5


def test_prisms_that_touch_keep_edges_of_their_own() -> None:
    body = solid(cuboid((0.0, 0.0), (1.0, 1.0, 1.0)), cuboid((1.0, 0.0), (1.0, 1.0, 1.0)))
    assert open_edges(body) == []
    assert volume_m3(body) == pytest.approx(2.0)


@given(places, places, yaws, st.floats(-1.0, 1.0))
def test_penetration_along_one_axis_is_known(x: float, y: float, yaw: float, gap: float) -> None:
    one = cuboid((0.0, 0.0), (2.0, 2.0, 2.0)).placed(x, y, yaw)
    other = cuboid((2.0 + gap, 0.0), (2.0, 2.0, 2.0)).placed(x, y, yaw)
    assert penetration_m(one, other) == pytest.approx(-gap, abs=1e-9)
    assert penetration_m(other, one) == pytest.approx(-gap, abs=1e-9)


def test_one_above_the_other_does_not_penetrate() -> None:
    assert penetration_m(cuboid((0, 0), (1, 1, 1)), cuboid((0, 0), (1, 1, 1), 1.2)) < 0.0
    # Corner to corner, turned by 45 degrees: boxes around them overlap, they don't.
    turned = cuboid((0, 0), (1, 1, 1)).placed(1.2, 1.2, math.pi / 4)
    assert penetration_m(cuboid((0, 0), (2, 2, 1)), turned) > 0.0
    turned = cuboid((0, 0), (1, 1, 1)).placed(1.4, 1.4, math.pi / 4)
    assert penetration_m(cuboid((0, 0), (2, 2, 1)), turned) < 0.0


def test_contains_in_a_polygon_that_is_not_convex() -> None:
    u_shape = np.array(
        [[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]], dtype=float
    )
    assert contains(u_shape, np.array([0.5, 2.0]))
    assert contains(u_shape, np.array([1.5, 0.5]))
    assert not contains(u_shape, np.array([1.5, 2.0]))
    assert not contains(u_shape, np.array([4.0, 0.5]))
    assert not contains(u_shape[::-1], np.array([1.5, 2.0]))


coordinates = st.tuples(*[st.floats(-5, 5)] * 8)


@given(coordinates)
def test_segment_distances_are_those_of_many_points(values: tuple[float, ...]) -> None:
    a, b, c, d = np.array(values).reshape(4, 2)
    shares = np.linspace(0.0, 1.0, 101)[:, None]
    first, second = a + shares * (b - a), c + shares * (d - c)
    sampled = np.linalg.norm(first[:, None] - second[None], axis=2).min()
    exact = segment_distances(a, b, c[None], d[None])[0]
    assert exact <= sampled + 1e-9
    step = (np.linalg.norm(b - a) + np.linalg.norm(d - c)) / 200
    assert exact >= sampled - step - 1e-9
