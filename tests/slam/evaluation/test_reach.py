"""Poses between the scans, with odometry that is exact, that drifts, and that is not there."""

from __future__ import annotations

import numpy as np
import pytest

from backend.graph_arrays import between as relative
from datasets.messages import Array
from datasets.se2 import compose, inverse, se2, xyyaw
from datasets.trajectory import Trajectory
from slam.evaluation.reach import reach

EPOCH_NS = 976_052_905_167_303_000


def drive(stamps_s: Array, bias_rad_per_m: float = 0.0) -> Trajectory:
    """A winding drive; a bias turns it the more the farther it went, as wheel odometry does."""
    fine_s = np.linspace(stamps_s[0] - 1.0, stamps_s[-1] + 1.0, 40_001)
    step_s = fine_s[1] - fine_s[0]
    speed = 0.4 + 0.3 * np.sin(fine_s)
    yaw = np.cumsum(np.sin(0.7 * fine_s) + bias_rad_per_m * speed) * step_s
    x, y = np.cumsum(speed * np.cos(yaw)) * step_s, np.cumsum(speed * np.sin(yaw)) * step_s
    columns = [np.interp(stamps_s, fine_s, column) for column in (x, y, yaw)]
    stamps_ns = EPOCH_NS + np.rint(stamps_s * 1e9).astype(np.int64)
    return Trajectory(stamps_ns, np.column_stack(columns))


def every(trajectory: Trajectory, step: int) -> Trajectory:
    return Trajectory(trajectory.stamps_ns[::step].copy(), trajectory.xyyaw[::step].copy())


def moved(trajectory: Trajectory, T_b_a: Array) -> Trajectory:
    matrices = [T_b_a @ T for T in trajectory.matrices()]
    return Trajectory.from_matrices(trajectory.stamps_ns.tolist(), matrices)


def worst_m(poses: Array, truth: Array) -> float:
    return float(np.hypot(*(poses - truth)[:, :2].T).max())


def test_relative_and_compose_agree_with_matrices() -> None:
    T_a_b, T_a_c = se2(1.0, -2.0, 2.9), se2(-0.5, 0.7, -3.0)
    row_b, row_c = np.array([xyyaw(T_a_b)]), np.array([xyyaw(T_a_c)])
    np.testing.assert_allclose(relative(row_b, row_c), [xyyaw(inverse(T_a_b) @ T_a_c)])
    np.testing.assert_allclose(compose(row_b, relative(row_b, row_c)), [xyyaw(T_a_c)])


def test_exact_odometry_in_another_frame_gives_the_truth() -> None:
    truth = drive(np.arange(0.0, 30.0, 0.05))
    odometry = moved(truth, se2(40.0, -7.0, 2.0))
    poses = reach(every(truth, 20), odometry, truth.stamps_ns)
    error = relative(truth.xyyaw, poses)
    np.testing.assert_allclose(error, 0.0, atol=1e-9)


def test_at_its_own_stamps_a_trajectory_is_met_whatever_the_odometry() -> None:
    trajectory = drive(np.arange(0.0, 10.0, 0.5))
    nonsense = Trajectory(
        trajectory.stamps_ns + 7, np.random.default_rng(0).normal(0, 9, trajectory.xyyaw.shape)
    )
    poses = reach(trajectory, nonsense, trajectory.stamps_ns)
    np.testing.assert_allclose(relative(trajectory.xyyaw, poses), 0.0, atol=1e-9)


def test_drift_between_scans_is_spread() -> None:
    stamps_s = np.arange(0.0, 30.0, 0.05)
    truth, odometry = drive(stamps_s), drive(stamps_s, bias_rad_per_m=0.08)
    scans = every(truth, 60)  # one in three seconds, a metre or two apart
    stamps_ns = truth.stamps_ns[: -60 + 1]
    along = reach(scans, odometry, stamps_ns)
    after = np.searchsorted(scans.stamps_ns, stamps_ns, side="right") - 1
    one_sided = compose(
        scans.xyyaw[after], relative(odometry.at(scans.stamps_ns)[after], odometry.at(stamps_ns))
    )
    at_stamps = truth.at(stamps_ns)
    assert worst_m(along, at_stamps) < 0.025
    assert worst_m(one_sided, at_stamps) > 5 * worst_m(along, at_stamps)
    assert worst_m(scans.at(stamps_ns), at_stamps) > 10 * worst_m(along, at_stamps)


@pytest.mark.parametrize("direction", [1, -1])
def test_a_steady_bias_is_taken_back_whole(direction: int) -> None:
    way_m, bias_rad_per_m = np.linspace(0.0, 2.0, 21), 0.08
    yaw = bias_rad_per_m * way_m
    arc = np.column_stack([np.sin(yaw), 1.0 - np.cos(yaw)]) / bias_rad_per_m
    stamps_ns = np.arange(21, dtype=np.int64) * 10**8
    truth = np.column_stack([way_m, 0 * way_m, 0 * way_m])[::direction]
    odometry = Trajectory(stamps_ns, np.column_stack([arc, yaw])[::direction])
    ends = Trajectory(stamps_ns[[0, -1]], truth[[0, -1]])
    poses = reach(ends, odometry, stamps_ns)
    assert worst_m(odometry.xyyaw[::direction], truth[::direction]) > 0.15
    np.testing.assert_allclose(poses, truth, atol=1e-3)


def test_beyond_the_ends_the_odometry_is_followed() -> None:
    truth = drive(np.arange(0.0, 10.0, 0.1))
    inner = Trajectory(truth.stamps_ns[10:-10].copy(), truth.xyyaw[10:-10].copy())
    poses = reach(inner, moved(truth, se2(1.0, 2.0, 3.0)), truth.stamps_ns)
    np.testing.assert_allclose(relative(truth.xyyaw, poses), 0.0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2])
def test_short_trajectories(count: int) -> None:
    truth = drive(np.arange(0.0, 2.0, 0.1))
    short = Trajectory(truth.stamps_ns[:count].copy(), truth.xyyaw[:count].copy())
    poses = reach(short, truth, truth.stamps_ns)
    np.testing.assert_allclose(relative(truth.xyyaw, poses), 0.0, atol=1e-9)


def test_without_odometry_it_interpolates() -> None:
    trajectory = Trajectory(np.array([0, 100]), np.array([[0.0, 0.0, 3.1], [1.0, 2.0, -3.1]]))
    poses = reach(trajectory, None, np.array([50, 500]))
    np.testing.assert_allclose(poses[0, :2], [0.5, 1.0])
    np.testing.assert_allclose(np.cos(poses[0, 2]), -1.0, atol=1e-9)
    np.testing.assert_allclose(poses[1, :2], [1.0, 2.0])


def test_standing_still_jitter_of_the_odometry_does_not_matter() -> None:
    stamps_ns = np.arange(5, dtype=np.int64) * 10**9
    still = Trajectory(stamps_ns, np.tile([1.0, 2.0, 0.5], (5, 1)))
    odometry = Trajectory(stamps_ns, np.zeros((5, 3)))
    between = np.array([250_000_000, 1_750_000_000])
    np.testing.assert_allclose(reach(still, odometry, between), still.xyyaw[:2])
