"""The tf tree against matrix products, and against SciPy's rotations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from datasets.messages import Array
from datasets.tf_tree import TfTree, frame_name, planar, se3, se3_inverse, standing

metres = st.floats(-20.0, 20.0)
quaternions = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(
    lambda q: math.sqrt(sum(part * part for part in q)) > 0.1
)
links = st.builds(se3, st.tuples(metres, metres, metres), quaternions)


@given(st.tuples(metres, metres, metres), quaternions)
def test_se3_agrees_with_scipy_for_quaternions_of_any_length(
    xyz: tuple[float, ...], quaternion: tuple[float, ...]
) -> None:
    T = se3(xyz, quaternion)
    assert T[:3, :3] == pytest.approx(Rotation.from_quat(quaternion).as_matrix(), abs=1e-12)
    assert T[:3, 3] == pytest.approx(xyz)
    assert T @ se3_inverse(T) == pytest.approx(np.eye(4), abs=1e-12)


@pytest.mark.parametrize(
    ("xyz", "quaternion"),
    [
        ((0, 0, 0), (0, 0, 0, 0)),
        ((math.nan, 0, 0), (0, 0, 0, 1)),
        ((0, 0, 0), (0, 0, math.inf, 1)),
        ((0, 1e300, 0), (0, 0, 0, 1)),
    ],
)
def test_se3_refuses_what_is_no_transform(
    xyz: tuple[float, ...], quaternion: tuple[float, ...]
) -> None:
    with pytest.raises(ValueError, match="must"):
        se3(xyz, quaternion)


@settings(max_examples=50)
@given(st.lists(links, min_size=1, max_size=6), st.lists(links, min_size=0, max_size=6), st.data())
def test_chains_are_matrix_products_in_any_order_of_arrival(
    left: list[Array], right: list[Array], data: st.DataObject
) -> None:
    """Two branches on one root: T_l_r = inverse(product of left) @ product of right."""
    arrivals = [(f"l{i - 1}" if i else "root", f"l{i}", T) for i, T in enumerate(left)] + [
        (f"r{i - 1}" if i else "root", f"r{i}", T) for i, T in enumerate(right)
    ]
    tree = TfTree()
    for parent, child, T in data.draw(st.permutations(arrivals)):
        assert tree.add(parent, child, T)
    T_root_left, T_root_right = np.eye(4), np.eye(4)
    for T in left:
        T_root_left = T_root_left @ T
    for T in right:
        T_root_right = T_root_right @ T
    left_end = f"l{len(left) - 1}"
    right_end = f"r{len(right) - 1}" if right else "root"
    expected = np.linalg.inv(T_root_left) @ T_root_right
    assert tree.transform(left_end, right_end) == pytest.approx(expected, abs=1e-9)
    assert tree.transform("root", left_end) == pytest.approx(T_root_left, abs=1e-9)
    assert tree.transform(left_end, left_end) == pytest.approx(np.eye(4), abs=1e-9)


def test_a_lidar_upside_down_and_backwards_sees_points_where_they_are() -> None:
    """Rolled by 180 deg its y axis points to the right; turned by 180 deg x points back."""
    tree = TfTree()
    tree.add("base_footprint", "base_link", se3((0, 0, 0.1), (0, 0, 0, 1)))
    tree.add("base_link", "mast", se3((-0.2, 0, 0.5), (0, 0, 1, 0)))
    tree.add("mast", "laser", se3((0, 0, 0.3), (1, 0, 0, 0)))
    point_laser = np.array([2.0, 1.0, 0.0, 1.0])
    point_base = tree.transform("base_footprint", "laser") @ point_laser
    assert point_base == pytest.approx([-2.2, 1.0, 0.9, 1.0])


def test_a_jittering_joint_is_constant_and_a_turning_one_moves() -> None:
    tree = TfTree()
    for angle in (0.0, 1e-3, 2e-3):
        tree.add("base", "tilt", se3((0, 0, 0), (0, math.sin(angle / 2), 0, math.cos(angle / 2))))
    assert not tree.moves("base", "tilt")
    tree.add("base", "tilt", se3((0, 0, 0), (0, math.sin(0.05), 0, math.cos(0.05))))
    assert tree.moves("base", "tilt")
    assert tree.moves("tilt", "base")
    assert tree.transform("base", "tilt") == pytest.approx(np.eye(4))


def test_the_other_sign_of_a_quaternion_is_the_same_rotation() -> None:
    tree = TfTree()
    tree.add("odom", "base", se3((1, 2, 0), (0, 0, 0.6, 0.8)))
    tree.add("odom", "base", se3((1, 2, 0), (0, 0, -0.6, -0.8)))
    assert not tree.moves("odom", "base")


def test_second_parents_loops_and_gaps_do_no_harm() -> None:
    tree = TfTree()
    assert tree.add("a", "b", np.eye(4))
    assert not tree.add("c", "b", np.eye(4))
    assert not tree.add("b", "b", np.eye(4))
    assert tree.add("b", "a", np.eye(4))
    assert tree.upwards("b") == ["b", "a"]
    assert tree.path("b", "elsewhere") is None
    with pytest.raises(KeyError, match="elsewhere"):
        tree.transform("b", "elsewhere")


@given(metres, metres, st.floats(-3.1, 3.1))
def test_planar_keeps_the_position_and_the_heading(x: float, y: float, yaw: float) -> None:
    T = planar(se3((x, y, 7.0), (0, 0, math.sin(yaw / 2), math.cos(yaw / 2))))
    assert (T[0, 2], T[1, 2]) == (x, y)
    assert math.atan2(T[1, 0], T[0, 0]) == pytest.approx(yaw, abs=1e-9)
    np.testing.assert_allclose(planar(standing(np.array([x, y, yaw]))), T, atol=1e-12)
    np.testing.assert_array_equal(standing(np.array([x, y, yaw]))[2], [0, 0, 1, 0])


def test_frames_with_and_without_a_slash_are_one() -> None:
    assert frame_name("/base_link") == frame_name("base_link") == "base_link"
