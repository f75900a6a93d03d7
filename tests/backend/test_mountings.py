"""Lidars that stand, or tick, otherwise than they are said to: found, corrected, left alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.mountings import (
    LARGE_M,
    MIN_NODES,
    MountingOffset,
    combined,
    corrected,
    mounting_offsets,
    remounted,
)
from datasets.messages import Array
from datasets.se2 import inverse, se2, transform, xyyaw
from frontend.nodes import Node
from frontend.prepared import PreparedScan

S = 1_000_000_000


def base_at(t_s: float) -> Array:
    """A drive that turns both ways and changes its speed."""
    x = 0.4 * t_s + 0.3 * math.sin(0.9 * t_s)
    return se2(x, 1.5 * math.sin(0.3 * t_s), 0.8 * math.sin(0.4 * t_s))


def scan(sensor: str, t_s: float, points_base: Array) -> PreparedScan:
    rays = points_base - np.array([0.1, 0.0])
    bearings = np.arctan2(rays[:, 1], rays[:, 0])
    order = np.argsort(bearings)
    normals = np.tile([0.0, 1.0], (len(points_base), 1))
    stamp = round(t_s * S)
    origin = np.array([0.1, 0.0])
    layer, weights = np.zeros(len(order), dtype=np.uint8), np.ones(len(order))
    return PreparedScan(
        stamp, stamp, sensor, origin, points_base[order], normals, bearings[order], layer, weights
    )


def drive(
    T_true_said: Array, clock_s: float = 0.0, noise: float = 0.0, count: int = 120
) -> tuple[list[Node], Array]:
    """Nodes of two lidars in turn, as a perfect map places them.

    The second stands by T_true_said from where it is said to, and its stamps are late by -clock_s.
    """
    random = np.random.default_rng(3)
    nodes, poses = [], []
    for k in range(count):
        t_s = 0.3 * k + random.uniform(0.0, 0.1)
        second = k % 2 == 1
        T_map_base = base_at(t_s + clock_s) @ T_true_said if second else base_at(t_s)
        T_map_base = T_map_base @ se2(*random.normal(0.0, noise, 2), random.normal(0.0, noise))
        points = random.uniform(1.0, 4.0, (12, 2))
        name = "second" if second else "first"
        nodes.append(Node(k, scan(name, t_s, points), T_map_base, 0.3 * k, np.eye(3), False))
        poses.append(T_map_base)
    return nodes, np.array(poses)


@settings(deadline=None, max_examples=20)
@given(
    x=st.floats(-0.1, 0.1),
    y=st.floats(-0.1, 0.1),
    yaw=st.floats(-0.05, 0.05),
    clock_s=st.sampled_from([-0.12, 0.0, 0.08]),
)
def test_an_offset_and_a_clock_are_found_and_told_apart(
    x: float, y: float, yaw: float, clock_s: float
) -> None:
    nodes, poses = drive(se2(x, y, yaw), clock_s, noise=0.003)
    (found,) = mounting_offsets(nodes, poses)
    assert found.sensor == "second"
    assert found.clock_s == pytest.approx(clock_s, abs=0.012)
    off_x, off_y, off_yaw = xyyaw(inverse(se2(x, y, yaw)) @ found.T_true_said)
    assert math.hypot(off_x, off_y) < 0.012
    assert abs(off_yaw) < 0.006


def test_lidars_that_stand_as_said_are_left_alone() -> None:
    (found,) = mounting_offsets(*drive(np.eye(3), noise=0.01))
    assert not found.significant
    assert found.clock_s == 0.0
    assert np.array_equal(found.T_true_said, np.eye(3))


def test_what_is_too_large_to_be_a_mounting_is_left_alone() -> None:
    (found,) = mounting_offsets(*drive(se2(1.5 * LARGE_M, 0.0, 0.0), noise=0.003))
    assert np.array_equal(found.T_true_said, np.eye(3))


def test_few_nodes_and_single_lidars_tell_nothing() -> None:
    assert mounting_offsets(*drive(se2(0.05, 0.0, 0.0), count=2 * MIN_NODES - 4)) == []
    nodes, poses = drive(se2(0.05, 0.0, 0.0))
    assert mounting_offsets(nodes[::2], poses[::2]) == []


def test_corrected_nodes_show_the_same_map_from_the_true_bases() -> None:
    T_true_said = se2(0.04, -0.03, 0.02)
    nodes, poses = drive(T_true_said, clock_s=-0.1)
    (found,) = mounting_offsets(nodes, poses)
    moved, T_map_bases = corrected(nodes, poses, [found])
    for before, after, T_before, T_after in zip(nodes, moved, poses, T_map_bases, strict=True):
        there = transform(T_before, before.scan.points_base)
        again = transform(T_after, after.scan.points_base)
        assert sorted(again[:, 0]) == pytest.approx(sorted(there[:, 0]))
        assert (np.diff(after.scan.bearings_rad) >= 0.0).all()
        off = xyyaw(inverse(base_at(after.scan.moment_ns / S)) @ T_after)
        assert math.hypot(*off[:2]) < 0.012
        assert abs(off[2]) < 0.006
    (left,) = mounting_offsets(moved, T_map_bases)
    assert not left.significant


def test_a_lidar_moved_to_its_place_leaves_what_the_camera_saw() -> None:
    random = np.random.default_rng(6)
    points = random.uniform(-4.0, 4.0, (30, 2))
    main, low = scan("front", 0.0, points[:20]), scan("front", 0.0, points[20:])
    both = replace(
        main,
        points_base=np.concatenate([main.points_base, low.points_base]),
        normals_base=np.concatenate([main.normals_base, low.normals_base]),
        bearings_rad=np.concatenate([main.bearings_rad, low.bearings_rad]),
        layer=np.repeat(np.array([0, 1], dtype=np.uint8), [20, 10]),
        weights=np.concatenate([main.weights, np.arange(10) / 10.0]),
    )
    offset = MountingOffset("front", se2(0.05, -0.02, 0.03), 0.01, 0.01, 0.01, 0.01, 50)
    moved, alone = remounted(both, offset), remounted(main, offset)
    assert np.array_equal(moved.points_base[:20], alone.points_base)
    assert np.array_equal(moved.normals_base[:20], alone.normals_base)
    assert np.array_equal(moved.layer, both.layer)
    where = np.argsort(both.weights[20:])
    back = np.argsort(moved.weights[20:])
    assert np.array_equal(moved.points_base[20:][back], both.points_base[20:][where])


def test_two_corrections_are_one() -> None:
    nodes, poses = drive(se2(0.04, 0.0, 0.01), clock_s=0.05)
    (first,) = mounting_offsets(nodes, poses)
    points = nodes[1].scan
    twice = remounted(remounted(points, first), first)
    once = remounted(points, combined(first, first))
    assert twice.points_base == pytest.approx(once.points_base)
    assert twice.moment_ns == once.moment_ns
