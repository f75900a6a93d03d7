"""The likelihood field between its cells: plain twins, slopes by differences, bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import se2, transform
from frontend.comparison import correlative_kernels as kernels
from frontend.comparison.correlative import likelihood_field
from frontend.kernel_types import Bytes
from frontend.local_map import CELL_M, LEVELS, LocalMap
from tests.frontend.pyramids import maxima
from tests.frontend.rooms import ROOM, prepared

SEEDS = st.integers(0, 2**32 - 1)
CATMULL_ROM = 0.5 * np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]])
"""Its matrix: weights of four values at t are [1, t, t^2, t^3] times this."""


def random_field(random: np.random.Generator, rows: int = 12, cols: int = 15) -> Bytes:
    return random.integers(0, 256, (rows, cols)).astype(np.uint8)


def between(field: Bytes, row: float, col: float) -> float:
    """The field between cells, by the definition."""
    row_0, col_0 = math.floor(row), math.floor(col)
    if not (1 <= row_0 < field.shape[0] - 2 and 1 <= col_0 < field.shape[1] - 2):
        return 0.0
    patch = field[row_0 - 1 : row_0 + 3, col_0 - 1 : col_0 + 3] / 255.0
    powers_row = (row - row_0) ** np.arange(4)
    powers_col = (col - col_0) ** np.arange(4)
    return float(powers_row @ CATMULL_ROM @ patch @ (powers_col @ CATMULL_ROM))


def drawn(points: Array, shape: tuple[int, int], reach: int) -> Bytes:
    field = np.zeros(shape, dtype=np.uint8)
    kernels.draw_field(points, 0.0, 0.0, CELL_M, 0.05, reach, field)
    return field


@settings(deadline=None)
@given(seed=SEEDS, row=st.floats(-2.0, 14.0), col=st.floats(-2.0, 17.0))
def test_the_field_between_cells_is_that_of_the_plain_twin(
    seed: int, row: float, col: float
) -> None:
    field = random_field(np.random.default_rng(seed))
    assert kernels.field_between(field, row, col)[0] == pytest.approx(between(field, row, col))


@settings(deadline=None)
@given(seed=SEEDS, row=st.floats(2.01, 7.99), col=st.floats(2.01, 10.99))
def test_its_slopes_are_the_differences_of_the_twin(seed: int, row: float, col: float) -> None:
    field, h = random_field(np.random.default_rng(seed)), 1e-6
    _, by_row, by_col = kernels.field_between(field, row, col)
    slope = (between(field, row + h, col) - between(field, row - h, col)) / (2 * h)
    assert by_row == pytest.approx(slope, abs=1e-4)
    slope = (between(field, row, col + h) - between(field, row, col - h)) / (2 * h)
    assert by_col == pytest.approx(slope, abs=1e-4)


def test_at_the_centre_of_a_cell_the_field_is_the_cell() -> None:
    field = random_field(np.random.default_rng(0))
    for row, col in ((1, 1), (4, 7), (9, 12)):
        assert kernels.field_between(field, row, col)[0] == pytest.approx(field[row, col] / 255.0)
    assert kernels.field_between(field, 0.5, 5.0) == (0.0, 0.0, 0.0)
    assert kernels.field_between(field, 5.0, 13.2) == (0.0, 0.0, 0.0)


@settings(deadline=None)
@given(seed=SEEDS, count=st.integers(0, 12))
def test_a_drawn_field_is_the_distance_to_the_nearest_point(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).uniform(0.3, 0.9, (count, 2))
    field = drawn(points, (24, 24), 3)
    centres = (np.arange(24) + 0.5) * CELL_M
    for row in range(24):
        for col in range(24):
            apart = np.array([centres[col], centres[row]]) - points
            cells = np.abs(np.floor(points / CELL_M) - [col, row]).max(axis=1, initial=0)
            near2 = (apart**2).sum(axis=1)[cells <= 3]
            value = 255.0 * math.exp(-near2.min() / (2 * 0.05**2)) if near2.size else 0.0
            assert field[row, col] == pytest.approx(value, abs=0.51)


@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, yaw=st.floats(-3.1, 3.1))
def test_the_equations_are_those_of_the_residuals_by_differences(seed: int, yaw: float) -> None:
    random = np.random.default_rng(seed)
    field = random_field(random, 60, 60)
    points, weights = random.uniform(-0.5, 0.5, (20, 2)), random.uniform(0.1, 1.0, 20)
    pose = np.array([1.5, 1.4, yaw])
    H, g = np.empty((3, 3)), np.empty(3)
    cost = kernels.field_equations(points, weights, *pose, field, 0.0, 0.0, CELL_M, H, g)

    def residuals(at: Array) -> Array:
        cells = transform(se2(*at), points) / CELL_M - 0.5
        return 1.0 - np.array([between(field, row, col) for col, row in cells])

    h, share = 1e-7, weights / weights.sum()
    J = np.column_stack(
        [(residuals(pose + h * e) - residuals(pose - h * e)) / (2 * h) for e in np.eye(3)]
    )
    assert cost == pytest.approx(share @ residuals(pose) ** 2)
    np.testing.assert_allclose(g, J.T @ (share * residuals(pose)), atol=1e-3)
    np.testing.assert_allclose(H, J.T @ (share[:, None] * J), rtol=1e-3, atol=1e-2)


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS)
def test_refining_never_makes_the_penalised_misfit_larger(seed: int) -> None:
    random = np.random.default_rng(seed)
    field = random_field(random, 60, 60)
    points, weights = random.uniform(-0.5, 0.5, (20, 2)), np.ones(20)
    start = np.array([1.5, 1.4, random.uniform(-3.0, 3.0)])
    expected = start + random.normal(0.0, 0.05, 3)
    penalty = random.uniform(0.0, 50.0, 3)
    window = (field, 0.0, 0.0, CELL_M)

    def misfit(at: Array) -> float:
        H, g = np.empty((3, 3)), np.empty(3)
        cost = kernels.field_equations(points, weights, *at, *window, H, g)
        return float(cost + penalty @ (at - expected) ** 2)

    pose = np.empty(3)
    taken = kernels.refine_on_field(points, weights, start, expected, penalty, *window, 15, pose)
    assert (misfit(pose) < misfit(start)) == (taken > 0)
    assert taken > 0 or (pose == start).all()


def test_the_volume_holds_the_mean_of_the_field_at_each_pose() -> None:
    random = np.random.default_rng(3)
    field = random_field(random, 60, 60)
    points, weights = random.uniform(-0.5, 0.5, (20, 2)), random.uniform(0.1, 1.0, 20)
    pose = np.array([1.5, 1.4, 0.7])
    axes = random.normal(0.0, 0.02, (3, 3))
    window = (field, 0.0, 0.0, CELL_M)
    scores = np.empty((3, 3, 3))
    kernels.score_volume(points, weights, pose, axes, *window, scores)
    values = np.empty(20)
    for index in np.ndindex(3, 3, 3):
        at = pose + axes @ (np.array(index) - 1.0)
        kernels.field_values(points, *at, *window, values)
        assert scores[index] == pytest.approx(np.average(values, weights=weights))
        cells = transform(se2(*at), points) / CELL_M - 0.5
        np.testing.assert_allclose(values, [between(field, row, col) for col, row in cells])


def test_each_coarse_level_of_a_map_bounds_the_finer_ones() -> None:
    """What the search stands on: the best of a coarse cell's window is no less than any in it."""
    local_map = LocalMap.around(
        [(prepared(ROOM, T), T) for T in (se2(4.5, 3.0, 0.5), se2(4.8, 3.1, 0.6))]
    )
    rows, cols = local_map._shape
    levels = [
        local_map._field[local_map._starts[k] : local_map._starts[k + 1]].reshape(
            rows >> k, cols >> k
        )
        for k in range(LEVELS)
    ]
    for level in (1, 2, 3):
        assert (levels[level] >= maxima(levels[0], level)).all()
        assert levels[level].max() == levels[0].max() == 255


def test_a_map_without_surface_has_an_empty_field() -> None:
    field, *_ = likelihood_field(LocalMap.around([]))
    assert not field.any()
