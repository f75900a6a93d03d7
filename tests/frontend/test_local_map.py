"""A local map's window: nothing inside is lost, nothing outside is touched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import se2
from frontend.local_map import CELL_M, NO_CLOUD, NO_POINTS, Alignment, LocalMap
from frontend.prepared import PreparedScan
from tests.frontend.rooms import ROOM, prepared

ANYWHERE = prepared(ROOM, se2(4.5, 3.0, 0.5))
ALONG = np.column_stack([np.linspace(-0.1, 0.1, 5), np.zeros(5)])


def dashes(places: Array) -> PreparedScan:
    """Short walls at some places, (N, 2)."""
    points = np.concatenate([place + ALONG for place in places])
    normals = np.tile([0.0, 1.0], (len(points), 1))
    bearings = np.zeros(len(points))
    return replace(
        ANYWHERE,
        points_base=points,
        normals_base=normals,
        bearings_rad=bearings,
        layer=np.zeros(len(points), dtype=np.uint8),
        weights=np.ones(len(points)),
    )


def aligned(local_map: LocalMap, scan: PreparedScan, start: Array, iterations: int) -> Alignment:
    cloud = (scan.points_base, scan.normals_base, scan.weights)
    return local_map.align(
        cloud,
        NO_CLOUD,
        NO_POINTS,
        np.ones(3),
        start,
        start,
        np.eye(3),
        (0.2, 0.04),
        0.03,
        iterations,
    )


@settings(deadline=None, max_examples=40)
@given(
    x=st.floats(-1e4, 1e4),
    y=st.floats(-1e4, 1e4),
    width=st.floats(0.4, 9.0),
    height=st.floats(0.4, 9.0),
)
def test_what_lies_in_the_window_is_found_up_to_its_corners(
    x: float, y: float, width: float, height: float
) -> None:
    low, high = np.array([x, y]), np.array([x + width, y + height])
    places = np.array([(x + 0.1 + 1e-6, y), (x + width - 0.1 - 1e-6, y + height)])
    local_map = LocalMap(low, high)
    scan = dashes(places)
    local_map.insert(scan, np.eye(3))
    # on the border of two cells rounding may look into the next
    each = [local_map.score(point[None], np.eye(3)) for point in scan.points_base]
    assert min(each) > 0.3
    start = np.array([0.0, 0.01, 0.0])
    assert aligned(local_map, scan, start, 1).matched == 10


def test_around_holds_every_scan_at_its_pose() -> None:
    poses = [se2(4.5, 3.0, 0.5), se2(8.0, 1.0, -2.0), se2(1.0, 5.0, 3.0)]
    scans = [(prepared(ROOM, T), T) for T in poses]
    local_map = LocalMap.around(scans)
    for scan, T in scans:
        assert local_map.score(scan.points_base, T) > 0.95
        assert local_map.score(scan.points_base, T @ se2(0.0, 0.0, 1.0)) < 0.6


def test_far_outside_is_left_out_without_harm() -> None:
    local_map = LocalMap(np.zeros(2), np.ones(2))
    scan = dashes(np.array([[500.0, 0.5], [0.5, -500.0], [0.5, 0.5]]))
    local_map.insert(scan, np.eye(3))
    assert local_map.score(scan.points_base, np.eye(3)) == pytest.approx(1.0 / 3.0, abs=0.05)
    assert local_map.score(np.array([[1e9, -1e9]]), np.eye(3)) == 0.0


def test_more_points_than_there_was_room_for_are_all_kept() -> None:
    """Lists grow by copying; what was there before must still be found."""
    poses = [se2(4.5 + 0.7 * k, 3.0 - 0.3 * k, 1.1 * k) for k in range(5)]
    scans = [(prepared(ROOM, T, beams=1500), T) for T in poses]
    together = LocalMap.around(scans)
    for scan, T in scans:
        start = np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])])
        found = aligned(together, scan, start, 5)
        assert found.matched == scan.surface_count
        assert found.weight > 0.95 * found.matched
        assert found.pose == pytest.approx(start, abs=0.002)


def test_an_empty_map_has_nothing_to_find() -> None:
    blind = prepared(ROOM, se2(99.0, 99.0, 0.0))
    for empty in (LocalMap.around([]), LocalMap.around([(blind, np.eye(3))])):
        assert empty.score(np.zeros((3, 2)), np.eye(3)) == 0.0
        assert empty.memory_bytes > 0
        found = empty.search(
            np.zeros((3, 2)), (0.0, 0.0, 0.0), 0.3, 0.1, 0.05, (0.0, 0.0), 0.0, 10**6
        )
        assert not found[0]


def test_search_returns_whole_cells_and_steps_from_the_guess() -> None:
    T = se2(4.5, 3.0, 0.5)
    scan = prepared(ROOM, T)
    local_map = LocalMap.around([(scan, T)])
    guess = (4.41, 3.12, 0.46)
    found, x, y, yaw, score, _ = local_map.search(
        scan.points_base, guess, 0.3, 0.1, 0.02, (0.0, 0.0), 0.0, 10**7
    )
    assert found
    assert score > 0.8
    steps = np.array([(x - guess[0]) / CELL_M, (y - guess[1]) / CELL_M, (yaw - guess[2]) / 0.02])
    assert steps == pytest.approx(np.round(steps), abs=1e-6)
    assert np.round(steps).tolist() == [2.0, -2.0, 2.0]
