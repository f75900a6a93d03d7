"""Who looked through a point, by scans whose beams are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from backend.free_space import Viewers
from backend.free_space_kernels import compare_views
from datasets.messages import Array
from datasets.se2 import se2, transform
from frontend.nodes import Node
from frontend.prepared import PreparedScan
from fusion.scan import LIDAR_LAYER


def node(range_m: float, bearings_rad: Array, origin: tuple[float, float] = (0.0, 0.0)) -> Node:
    """A scan that ends on a circle around its sensor."""
    at = np.array(origin)
    points = at + range_m * np.column_stack([np.cos(bearings_rad), np.sin(bearings_rad)])
    count = len(points)
    scan = PreparedScan(
        0,
        0,
        "lidar",
        at,
        points,
        np.zeros((count, 2)),
        bearings_rad,
        np.full(count, LIDAR_LAYER, dtype=np.uint8),
        np.ones(count),
    )
    return Node(0, scan, np.eye(3), 0.0, np.zeros((3, 3)), False)


FORWARD = np.radians(np.arange(-60.0, 60.5, 1.0))


@pytest.mark.parametrize("T_map_base", [np.eye(3), se2(3.0, -2.0, 2.8), se2(0.0, 1.0, -3.1)])
@pytest.mark.parametrize("origin", [(0.0, 0.0), (0.4, -0.2)])
def test_what_lies_before_the_beams_end_is_seen_through(
    T_map_base: Array, origin: tuple[float, float]
) -> None:
    viewers = Viewers.of([node(5.0, FORWARD, origin)], [T_map_base])
    inside, at, behind = (
        np.array([[d * math.cos(0.3), d * math.sin(0.3)]]) for d in (3.0, 4.9, 7.0)
    )
    beside = np.array([[-3.0, 0.0]])
    points = np.concatenate([inside, at, behind, beside]) + origin
    assert viewers.seen_through(transform(T_map_base, points)).tolist() == [1, 0, 0, 0]


def test_where_nothing_came_back_nothing_is_free() -> None:
    gap = FORWARD[np.abs(FORWARD) > math.radians(4.0)]
    viewers = Viewers.of([node(5.0, gap)], [np.eye(3)])
    points = np.array([[3.0, 0.0], [3.0, 0.6]])
    assert viewers.seen_through(points).tolist() == [0, 1]


def test_each_scan_counts_and_moves_along() -> None:
    nodes = [node(5.0, FORWARD), node(2.0, FORWARD)]
    two = Viewers.of(nodes, [np.eye(3), np.eye(3)])
    assert two.seen_through(np.array([[1.0, 0.0], [3.0, 0.0]])).tolist() == [2, 1]
    T = se2(10.0, 0.0, math.pi / 2)
    assert Viewers.of(nodes, [T, T]).seen_through(np.array([[10.0, 3.0]])).tolist() == [1]


def test_points_of_one_scan_are_same_free_or_hidden_to_another() -> None:
    """A circle of 4 m compared with circles of 4, 6 and 2 m around the same place."""
    nodes = [node(r, FORWARD) for r in (4.0, 4.0, 6.0, 2.0)]
    counts = np.array([len(n.scan.points_base) for n in nodes])
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    bearings = np.concatenate([n.scan.bearings_rad for n in nodes])
    ranges = np.repeat([4.0, 4.0, 6.0, 2.0], counts)
    out = np.empty((3, 3), dtype=np.int64)
    first, second = np.zeros(3, dtype=np.int64), np.array([1, 2, 3], dtype=np.int64)
    compare_views(
        first, second, np.zeros((4, 3)), starts, bearings, ranges, 12.0, 0.04, 0.3, 0.02, out
    )
    compared = len(FORWARD) - 1  # the first beam has no neighbour before it
    assert out.tolist() == [[compared, 0, 0], [0, compared, 0], [0, 0, compared]]
