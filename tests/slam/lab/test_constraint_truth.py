"""Constraints whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.messages import Array
from datasets.se2 import between, compose
from datasets.trajectory import Trajectory
from slam.lab.drives.constraint_truth import constraint_errors

STAMPS_NS = np.arange(50, dtype=np.int64) * 100_000_000
ROWS = np.column_stack([0.1 * np.arange(50), np.sin(0.1 * np.arange(50)), 0.12 * np.arange(50)])
TRUTH = Trajectory(STAMPS_NS, ROWS)


def measured(first: Array, second: Array, error: Array) -> Array:
    """True relative poses with an error in the frame of the second pose."""
    return compose(between(ROWS[first], ROWS[second]), error)


def test_errors_are_those_that_were_put_in() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 50, 200), rng.integers(0, 50, 200)
    error = rng.normal(0.0, 0.05, (200, 3))
    found = constraint_errors(
        STAMPS_NS[first], STAMPS_NS[second], measured(first, second, error), TRUTH
    )
    np.testing.assert_allclose(found.translation_m, np.hypot(error[:, 0], error[:, 1]), atol=1e-9)
    np.testing.assert_allclose(found.rotation_deg, np.degrees(np.abs(error[:, 2])), atol=1e-9)
    assert found.count == 200


def test_false_closures_are_those_beyond_either_bound() -> None:
    first, second = np.array([3, 4, 5, 6]), np.array([40, 41, 42, 43])
    error = np.array([[0.4, 0.0, 0.0], [0.4, 0.4, 0.0], [0.0, 0.0, 0.08], [0.0, 0.0, -0.1]])
    poses = measured(first, second, error)
    found = constraint_errors(STAMPS_NS[first], STAMPS_NS[second], poses, TRUTH)
    assert found.false.tolist() == [False, True, False, True]
    strict = constraint_errors(
        STAMPS_NS[first], STAMPS_NS[second], poses, TRUTH, false_m=0.1, false_deg=1.0
    )
    assert strict.false.all()
    assert "beyond 0.1 m or 1 deg): 4; n = 4" in str(strict)


def test_stamps_between_poses_are_interpolated_and_beyond_are_left_out() -> None:
    late = STAMPS_NS[-1] + 1
    between_ns = (STAMPS_NS[10] + STAMPS_NS[11]) // 2
    middle = (ROWS[10] + ROWS[11]) / 2
    poses = np.vstack([between(middle[None], ROWS[20:21]), np.zeros((1, 3))])
    found = constraint_errors(
        np.array([between_ns, STAMPS_NS[0]]), np.array([STAMPS_NS[20], late]), poses, TRUTH
    )
    assert found.translation_m[0] == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(found.translation_m[1])
    assert not found.false[1]
    assert (found.count, found.left_out) == (1, 1)
    nothing = constraint_errors(STAMPS_NS[:0], STAMPS_NS[:0], np.empty((0, 3)), TRUTH)
    assert "no constraint" in str(nothing)
    with pytest.raises(ValueError, match="relative poses"):
        constraint_errors(STAMPS_NS[:2], STAMPS_NS[:2], np.empty((3, 3)), TRUTH)
