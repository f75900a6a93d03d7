"""The search over large windows finds what the exhaustive one finds, from any yaw."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datasets.messages import Array
from frontend.local_map import COARSE_LEVELS, FACING_BINS, LEVELS, LocalMap, facing_of
from frontend.place_search_kernels import agreement, facing, pooled
from frontend.prepared import PreparedScan
from fusion.scan import LIDAR_LAYER


def scan_of(points: Array, normals: Array) -> PreparedScan:
    count = len(points)
    bearings = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(bearings)
    return PreparedScan(
        0,
        0,
        "lidar",
        np.zeros(2),
        np.ascontiguousarray(points[order]),
        np.ascontiguousarray(normals[order]),
        bearings[order],
        np.full(count, LIDAR_LAYER, dtype=np.uint8),
        np.ones(count),
    )


def room(seed: int) -> tuple[Array, Array]:
    """Points and normals of a few walls within 7 m, one of them askew."""
    rng = np.random.default_rng(seed)
    points, normals = [], []
    for angle in (0.0, 0.0, 0.5 * math.pi, 0.5 * math.pi, rng.uniform(0.0, math.pi)):
        along = np.array([math.cos(angle), math.sin(angle)])
        across = np.array([-along[1], along[0]])
        reach = np.linspace(-rng.uniform(1, 5), rng.uniform(1, 5), 120)
        wall = reach[:, None] * along + rng.uniform(-5, 5) * across
        points.append(wall)
        facing_us = -np.sign(wall @ across)
        normals.append(facing_us[:, None] * across)
    return np.concatenate(points), np.concatenate(normals)


def map_of(seed: int) -> tuple[LocalMap, Array, Array]:
    points, normals = room(seed)
    drawn = LocalMap.around([(scan_of(points, normals), np.eye(3))])
    return drawn, points, normals


@pytest.mark.parametrize("seed", range(8))
def test_it_finds_what_the_search_of_each_yaw_finds(seed: int) -> None:
    drawn, points, _ = map_of(seed)
    rng = np.random.default_rng(100 + seed)
    some = np.ascontiguousarray(points[rng.integers(0, len(points), 100)])
    guess = (*rng.uniform(-1.5, 1.5, 2).tolist(), float(rng.uniform(-0.6, 0.6)))
    window_m, steps, step_rad = 3.0, 70, 0.01
    known = drawn.search(some, guess, window_m, 0.7, step_rad, (0.0, 0.0), 0.2, 10**9)
    yaws = guess[2] + np.arange(-steps, steps + 1) * step_rad
    found = drawn.search_places(some, guess[:2], yaws, window_m, 0.2, 10**9)
    assert known[0]
    assert found[0]
    assert found[4] == pytest.approx(known[4], abs=1e-12)
    away = math.hypot(found[1], found[2])
    assert away < 0.1 or found[4] > 0.99
    second = drawn.search_places(
        some, guess[:2], yaws, window_m, 0.2, 10**9, (*found[1:4], 0.6, 0.3)
    )
    assert not second[0] or second[4] <= found[4]
    apart_m = math.hypot(second[1] - found[1], second[2] - found[2])
    assert not second[0] or apart_m >= 0.6 or abs(second[3] - found[3]) >= 0.3


def test_a_budget_ends_the_search_and_a_high_floor_finds_nothing() -> None:
    drawn, points, _ = map_of(3)
    yaws = np.arange(-50, 51) * 0.01
    *_, boxes = drawn.search_places(points, (0.5, 0.5), yaws, 6.0, 0.2, 50)
    assert boxes < 50 + len(yaws) * 16
    far = points + np.array([40.0, 0.0])
    assert not drawn.search_places(far, (0.0, 0.0), yaws, 2.0, 0.2, 10**9)[0]


def test_the_coarse_levels_are_what_they_are_defined_as() -> None:
    drawn, points, _ = map_of(5)
    drawn.search_places(points, (0.0, 0.0), np.zeros(1), 1.0, 0.5, 10)
    pyramid = drawn._coarse
    assert pyramid is not None
    rows, cols = pyramid.shapes[0]
    finest = pyramid.field[: rows * cols].reshape(rows, cols)
    for level in range(LEVELS, LEVELS + COARSE_LEVELS):
        span, start = 1 << level, pyramid.starts[level]
        shape = tuple(pyramid.shapes[level])
        coarse = pyramid.field[start : start + shape[0] * shape[1]].reshape(shape)
        for r, c in np.ndindex(shape):
            low_r, low_c = (r - 1) * span, (c - 1) * span
            window = finest[max(0, low_r) : low_r + 2 * span, max(0, low_c) : low_c + 2 * span]
            most = int(window.max(initial=0))
            assert coarse[r, c] >= most  # a bound; looser only by the blob's shape
            assert (coarse[r, c] > 0) == (most > 0) or coarse[r, c] < 255


def test_pooling_an_unpadded_level_pads_it() -> None:
    finer = np.zeros((4, 4), dtype=np.uint8)
    finer[0, 3] = 9
    out = np.empty((3, 3), dtype=np.uint8)
    pooled(finer, 4, 4, False, out)
    assert out.tolist() == [[0, 0, 0], [0, 0, 0], [0, 0, 0]]
    finer[2, 2] = 7
    pooled(finer, 4, 4, False, out)
    # cell (1, 1) of the level, and those whose second half begins there
    assert out[2, 2] == 7
    assert out[1, 1] == 7
    assert out[0, 0] == 0


@pytest.mark.parametrize("turn_bins", [0, 7, 60, 119])
def test_how_surfaces_face_tells_the_yaw(turn_bins: int) -> None:
    _, _, normals = map_of(2)
    turn = turn_bins * 2.0 * math.pi / FACING_BINS
    R = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    # the map shows them turned: a scan fits if it is turned as much
    of_map, of_scan = facing_of(np.ascontiguousarray(normals @ R.T)), facing_of(normals)
    fits = np.empty(FACING_BINS)
    agreement(of_map, of_scan, fits)
    assert fits.argmax() in {(turn_bins + k) % FACING_BINS for k in (-1, 0, 1)}
    assert fits.max() == pytest.approx(1.0, abs=0.26)  # directions on the border of a bin
    assert of_map.sum() == pytest.approx(1.0)


def test_points_without_a_normal_face_nowhere() -> None:
    out = np.empty(12)
    facing(np.zeros((5, 2)), out)
    assert (out == 0.0).all()
