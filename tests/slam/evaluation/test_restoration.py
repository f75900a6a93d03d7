"""Corridors of points whose length is known."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.messages import Array
from datasets.simulation.place import Structure
from datasets.trajectory import Trajectory
from slam.evaluation.restoration import (
    Ghosted,
    NotRestored,
    Restored,
    ends_in_map,
    restoration,
)

LENGTH_M = 43.0
CORRIDOR = Structure("corridor", LENGTH_M, (0.0, 0.0), (LENGTH_M, 0.0))


def line(a: tuple[float, float], b: tuple[float, float], step_m: float = 0.01) -> Array:
    count = int(np.hypot(b[0] - a[0], b[1] - a[1]) / step_m) + 1
    return np.linspace(np.array(a), np.array(b), count)


def corridor(length_m: float = LENGTH_M, noise_m: float = 0.02, seed: int = 1) -> Array:
    """Two end walls, side walls, a box that hides a third of the far end, a plant before the near
    one, and a dense heap of points on one spot of it."""
    rng = np.random.default_rng(seed)
    far = line((length_m, -1.2), (length_m, 0.4))
    box = np.vstack(
        [
            line((length_m - 0.7, 0.4), (length_m - 0.7, 1.2)),
            line((length_m - 0.7, 0.4), (length_m, 0.4)),
        ]
    )
    plant = np.repeat(line((0.5, -0.5), (0.5, -0.3)), 20, axis=0)
    heap = np.repeat(line((0.0, 0.3), (0.0, 0.35)), 200, axis=0)
    sides = np.vstack([line((0, y), (length_m, y), 0.05) for y in (-1.2, 1.2)])
    near = line((0.0, -1.2), (0.0, 1.2))
    points = np.vstack([near, far, box, plant, heap, sides])
    noisy: Array = points + rng.normal(0.0, noise_m, points.shape)
    return noisy


@pytest.mark.parametrize("length_m", [43.0, 42.5, 43.9])
@pytest.mark.parametrize("noise_m", [0.005, 0.03])
def test_the_length_in_the_map_is_found(length_m: float, noise_m: float) -> None:
    result = restoration(CORRIDOR, corridor(length_m, noise_m))
    assert isinstance(result, Restored)
    assert result.gamma_percent == pytest.approx(length_m / 43.0 * 100, abs=0.05)
    assert result.std_m < 0.01
    assert result.residual_m[0] == pytest.approx(min(noise_m, 0.025), rel=0.35)


def test_the_stated_deviation_is_the_one_that_occurs() -> None:
    found = [restoration(CORRIDOR, corridor(seed=seed)) for seed in range(30)]
    lengths = [each.measured_m for each in found if isinstance(each, Restored)]
    stated = [each.std_m for each in found if isinstance(each, Restored)]
    assert len(lengths) == 30
    assert np.mean(lengths) == pytest.approx(43.0, abs=0.003)
    assert np.std(lengths) < 2 * np.mean(stated)


def turned(points: Array, yaw: float, shift: tuple[float, float]) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    moved: Array = points @ np.array([[c, s], [-s, c]]) + shift
    return moved


def test_direction_and_place_of_the_map_do_not_matter() -> None:
    yaw, shift = 2.1, (-7.3, 4.4)
    ends = turned(np.array([CORRIDOR.start_m, CORRIDOR.end_m]), yaw, shift)
    points = turned(corridor(42.8), yaw, shift)
    result = restoration(CORRIDOR, points, ends_map=(ends[0], ends[1]))
    assert isinstance(result, Restored)
    assert result.gamma_percent == pytest.approx(42.8 / 0.43, abs=0.05)
    back = restoration(CORRIDOR, points, ends_map=(ends[1], ends[0]))
    assert isinstance(back, Restored)
    assert back.measured_m == pytest.approx(result.measured_m, abs=1e-6)


def test_walls_that_lean_are_measured_on_the_axis() -> None:
    points = corridor()
    leaning = points + np.column_stack([np.tan(np.radians(3.0)) * points[:, 1], 0 * points[:, 0]])
    result = restoration(CORRIDOR, leaning)
    assert isinstance(result, Restored)
    assert result.measured_m == pytest.approx(43.0, abs=0.01)


def test_a_displaced_map_is_measured_where_it_lies() -> None:
    displaced = turned(corridor(), 0.0, (0.9, 0.2))
    result = restoration(CORRIDOR, displaced)
    assert isinstance(result, Restored)
    assert result.measured_m == pytest.approx(43.0, abs=0.02)


@pytest.mark.parametrize("apart_m", [0.11, 0.2, 0.45])
def test_a_wall_that_is_there_twice_is_ghosted(apart_m: float) -> None:
    rng = np.random.default_rng(3)
    twin = line((LENGTH_M - apart_m, -1.1), (LENGTH_M - apart_m, 0.35))
    points = np.vstack([corridor(noise_m=0.015), twin + rng.normal(0.0, 0.015, twin.shape)])
    result = restoration(CORRIDOR, points)
    assert isinstance(result, Ghosted)
    assert result.ends == ("end",)
    assert result.measured_m == pytest.approx((43.0 - apart_m, 43.0), abs=0.02)
    assert result.gamma_percent[1] == pytest.approx(100.0, abs=0.05)


def test_a_thin_wall_that_was_seen_from_both_sides_is_no_ghost_if_that_is_known() -> None:
    rng = np.random.default_rng(3)
    inside = corridor(noise_m=0.01)
    other_side = line((LENGTH_M + 0.1, -1.1), (LENGTH_M + 0.1, 1.1))
    other_side += rng.normal(0.0, 0.01, other_side.shape)
    points = np.vstack([inside, other_side])
    origins = np.tile([20.0, 0.0], (len(points), 1))
    origins[len(inside) :] = [50.0, 0.0]
    assert isinstance(restoration(CORRIDOR, points), Ghosted)
    result = restoration(CORRIDOR, points, origins_map=origins)
    assert isinstance(result, Restored)
    assert result.measured_m == pytest.approx(43.0, abs=0.01)
    with pytest.raises(ValueError, match="origins"):
        restoration(CORRIDOR, points, origins_map=origins[:-1])


def test_a_cabinet_that_is_wider_than_the_rest_of_the_wall_is_not_the_wall() -> None:
    points = corridor(noise_m=0.01)
    hidden = (points[:, 0] > 42.5) & (np.abs(points[:, 1] - 0.05) < 0.35)
    cabinet = line((42.6, -0.3), (42.6, 0.4))
    result = restoration(CORRIDOR, np.vstack([points[~hidden], cabinet]))
    assert isinstance(result, Restored)
    assert result.measured_m == pytest.approx(43.0, abs=0.01)


def test_thick_noise_is_no_ghost() -> None:
    assert isinstance(restoration(CORRIDOR, corridor(noise_m=0.04)), Restored)


def test_a_missing_wall_is_said_to_be_missing() -> None:
    points = corridor()
    open_end = points[points[:, 0] < 41.0]
    result = restoration(CORRIDOR, open_end)
    assert isinstance(result, NotRestored)
    assert "at its end" in result.reason
    assert "nothing within 1.5 m" in result.reason
    few = np.vstack([open_end, line((43.0, 0.0), (43.0, 0.3))])
    result = restoration(CORRIDOR, few)
    assert isinstance(result, NotRestored)
    assert "of its width" in result.reason


def test_cells_serve_as_well_as_points() -> None:
    points = corridor(noise_m=0.01)
    cells, counts = np.unique(np.floor(points / 0.05), axis=0, return_counts=True)
    weights = np.minimum(counts / 5.0, 1.0)
    result = restoration(CORRIDOR, cells * 0.05 + 0.025, weights)
    assert isinstance(result, Restored)
    assert result.gamma_percent == pytest.approx(100.0, abs=0.12)  # a cell is 0.116 % of 43 m


def test_ends_go_where_the_estimate_puts_them() -> None:
    """The estimate is right at the start and 1.1 m and 3 deg off at the end."""
    stamps_ns = np.array([0, 1, 2], dtype=np.int64)
    truth = Trajectory(stamps_ns, np.array([[1.0, 0, 0], [20.0, 0, 0], [42.0, 0, 0.2]]))
    off = np.radians(3.0)
    estimate = Trajectory(stamps_ns, np.array([[1.0, 0, 0], [20.0, 0, 0], [43.1, 0, 0.2 + off]]))
    start, end = ends_in_map(CORRIDOR, estimate, truth)
    np.testing.assert_allclose(start, [0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(end, [43.1 + np.cos(off), np.sin(off)], atol=1e-12)


def test_what_is_no_points_is_refused() -> None:
    points = corridor()
    with pytest.raises(ValueError, match="finite"):
        restoration(CORRIDOR, points * np.nan)
    with pytest.raises(ValueError, match="weights"):
        restoration(CORRIDOR, points, -np.ones(len(points)))
    with pytest.raises(ValueError, match="width"):
        restoration(CORRIDOR, points, width_m=0.2)
