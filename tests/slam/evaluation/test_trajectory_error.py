"""ATE and RPE on known motions, and against evo."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import inverse, se2, xyyaw
from datasets.trajectory import Stamps, Trajectory
from slam.evaluation.alignment import alignment
from slam.evaluation.association import Pairs, TooFewPairsError, associate, covered
from slam.evaluation.trajectory_error import stretches, trajectory_error

EPOCH_NS = 1_686_652_417_123_456_789


def figure_of_eight(stamps_ns: Stamps) -> Trajectory:
    t_s = (stamps_ns - EPOCH_NS) * 1e-9
    x, y = 4 * np.sin(0.4 * t_s), 2 * np.sin(0.8 * t_s)
    yaw = np.unwrap(np.arctan2(1.6 * np.cos(0.8 * t_s), 1.6 * np.cos(0.4 * t_s)))
    return Trajectory(stamps_ns, np.column_stack([x, y, yaw]))


def stamps(start_s: float, end_s: float, step_s: float) -> Stamps:
    return EPOCH_NS + np.rint(np.arange(start_s, end_s, step_s) * 1e9).astype(np.int64)


def moved(trajectory: Trajectory, T_b_a: Array) -> Trajectory:
    matrices = [T_b_a @ T for T in trajectory.matrices()]
    return Trajectory.from_matrices(trajectory.stamps_ns.tolist(), matrices)


def noisy(trajectory: Trajectory, sigma_m: float, seed: int = 0) -> Trajectory:
    noise = np.random.default_rng(seed).normal(0.0, sigma_m, trajectory.xyyaw.shape)
    return Trajectory(trajectory.stamps_ns, trajectory.xyyaw + noise)


def stamped_late(trajectory: Trajectory, late_s: float) -> Trajectory:
    return Trajectory(trajectory.stamps_ns + round(late_s * 1e9), trajectory.xyyaw)


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-math.pi, math.pi))
@settings(max_examples=20)
def test_a_rigid_motion_is_no_error_and_is_recovered(x: float, y: float, yaw: float) -> None:
    truth = figure_of_eight(stamps(0, 30, 0.1))
    T = se2(x, y, yaw)
    result = trajectory_error(moved(truth, inverse(T)), truth)
    assert result.count == result.poses == 300
    assert result.translation_m.maximum < 1e-9
    assert result.rotation_deg.maximum < 1e-6
    np.testing.assert_allclose(result.T_truth_map, T, atol=1e-9)
    assert all(error.translation_m.maximum < 1e-9 for error in result.relative)


def test_a_standing_base_is_aligned_by_its_heading() -> None:
    truth = Trajectory(stamps(0, 5, 0.1), np.tile([3.0, 4.0, 2.0], (50, 1)))
    estimate = noisy(moved(truth, se2(1.0, 1.0, 1.0)), 1e-4)
    result = trajectory_error(estimate, truth)
    assert result.rotation_deg.maximum < 0.05
    assert {(error.delta, error.unit) for error in result.relative} == {(1.0, "s")}


def as_evo(stamps_ns: Stamps, poses: Array) -> Any:  # noqa: ANN401
    from evo.core.trajectory import PoseTrajectory3D

    half = poses[:, 2] / 2
    zeros = np.zeros_like(half)
    return PoseTrajectory3D(
        positions_xyz=np.column_stack([poses[:, :2], zeros]),
        orientations_quat_wxyz=np.column_stack([np.cos(half), zeros, zeros, np.sin(half)]),
        timestamps=(stamps_ns - EPOCH_NS) * 1e-9,
    )


@pytest.mark.parametrize("seed", range(3))
def test_evo_gives_the_same(seed: int) -> None:
    from evo.core import metrics
    from evo.core.units import Unit

    truth = figure_of_eight(stamps(-1, 41, 0.037))
    T = se2(3.0, -8.0, 2.0)
    estimate = noisy(moved(figure_of_eight(stamps(0, 40, 0.1)), T), 0.03, seed)
    ours = trajectory_error(estimate, truth)
    pairs = associate(estimate, truth, 0.0)
    reference, evaluated = (as_evo(pairs.stamps_ns, p) for p in (pairs.truth, pairs.estimate))
    aligned = copy.deepcopy(evaluated)
    aligned.align(copy.deepcopy(reference), correct_scale=False)
    both = (copy.deepcopy(reference), aligned)
    for relation, statistics in (
        (metrics.PoseRelation.translation_part, ours.translation_m),
        (metrics.PoseRelation.rotation_angle_deg, ours.rotation_deg),
    ):
        ape = metrics.APE(relation)
        ape.process_data(copy.deepcopy(both))
        theirs = ape.get_all_statistics()
        assert statistics.rmse == pytest.approx(theirs["rmse"], rel=1e-6)
        assert statistics.mean == pytest.approx(theirs["mean"], rel=1e-6)
        assert statistics.median == pytest.approx(theirs["median"], rel=1e-6)
        assert statistics.maximum == pytest.approx(theirs["max"], rel=1e-6)
    for error in (error for error in ours.relative if error.unit == "m"):
        for relation, statistics in (
            (metrics.PoseRelation.translation_part, error.translation_m),
            (metrics.PoseRelation.rotation_angle_deg, error.rotation_deg),
        ):
            rpe = metrics.RPE(
                relation, error.delta, Unit.meters, 0.1, True, pairs_from_reference=True
            )
            rpe.process_data((copy.deepcopy(reference), copy.deepcopy(evaluated)))
            theirs = rpe.get_all_statistics()
            assert error.count == rpe.get_result().np_arrays["error_array"].size
            assert statistics.rmse == pytest.approx(theirs["rmse"], rel=1e-6)
            assert statistics.maximum == pytest.approx(theirs["max"], rel=1e-6)


def test_a_scale_error_shows_in_rpe() -> None:
    truth = Trajectory(
        stamps(0, 40, 0.1),
        np.column_stack([np.arange(400) * 0.05, np.zeros(400), np.zeros(400)]),
    )
    estimate = Trajectory(truth.stamps_ns, truth.xyyaw * np.array([1.02, 1.0, 1.0]))
    by_length = {(e.delta, e.unit): e for e in trajectory_error(estimate, truth).relative}
    assert by_length[1.0, "m"].translation_m.median == pytest.approx(0.02)
    assert by_length[5.0, "m"].translation_m.median == pytest.approx(0.1)
    assert by_length[10.0, "s"].translation_m.median == pytest.approx(0.1)
    assert by_length[10.0, "s"].count == 310


@given(
    st.lists(st.floats(0.0, 2.0).map(lambda v: round(v, 2)), min_size=1, max_size=40),
    st.floats(0.1, 5.0),
)
def test_stretches_are_the_nearest_in_length(steps: list[float], delta: float) -> None:
    along = np.cumsum(np.array(steps))
    first, second = stretches(along, delta)
    found = dict(zip(first.tolist(), second.tolist(), strict=True))
    for i in range(along.size - 1):
        off = np.abs(along[i + 1 :] - along[i] - delta)
        if i in found:
            assert found[i] > i
            assert abs(along[found[i]] - along[i] - delta) == pytest.approx(off.min(), abs=1e-9)
        else:
            assert off.min() > 0.1 * delta - 1e-9


@pytest.mark.parametrize("late_s", [-0.31, -0.08, 0.0, 0.08, 0.2345])
def test_a_clock_offset_is_recovered_over_noise(late_s: float) -> None:
    truth = figure_of_eight(stamps(-1, 41, 0.02))
    estimate = stamped_late(
        noisy(moved(figure_of_eight(stamps(0, 40, 0.1)), se2(1.0, 2.0, 3.0)), 0.02), late_s
    )
    offset = trajectory_error(estimate, truth, "auto").time_offset
    assert offset.offset_s == pytest.approx(-late_s, abs=0.003)
    assert not offset.at_limit
    words = str(offset)
    assert ("late" in words) == (offset.offset_s < 0)
    assert offset.telling == (abs(late_s) > 0.01)
    given_error = trajectory_error(estimate, truth, -late_s)
    assert given_error.translation_m.rmse == pytest.approx(0.02 * math.sqrt(2), rel=0.1)


def test_a_stretch_that_was_lost_does_not_move_the_offset() -> None:
    truth = figure_of_eight(stamps(-1, 41, 0.02))
    lost = stamped_late(figure_of_eight(stamps(0, 40, 0.1)), 0.1)
    rows = lost.xyyaw.copy()
    rows[200:230, :2] += [3.0, -2.0]
    offset = trajectory_error(Trajectory(lost.stamps_ns, rows), truth, "auto").time_offset
    assert offset.offset_s == pytest.approx(-0.1, abs=0.002)


def test_a_base_that_stands_tells_no_offset() -> None:
    times = stamps(0, 40, 0.1)
    standing = Trajectory(times, np.zeros((times.size, 3)))
    offset = trajectory_error(noisy(standing, 0.01), standing, "auto").time_offset
    assert not offset.telling
    assert "hardly matters" in str(offset) or offset.at_limit


def test_an_offset_beyond_the_search_is_called_not_found() -> None:
    truth = figure_of_eight(stamps(-2, 42, 0.02))
    estimate = stamped_late(figure_of_eight(stamps(0, 40, 0.1)), 0.9)
    offset = trajectory_error(estimate, truth, "auto").time_offset
    assert offset.at_limit
    assert "NOT FOUND" in str(offset)


def test_ground_truth_that_covers_a_part_is_used_for_that_part() -> None:
    estimate = figure_of_eight(stamps(0, 40, 0.1))
    result = trajectory_error(estimate, figure_of_eight(stamps(10, 20, 0.02)))
    assert (result.count, result.poses) == (100, 400)
    assert result.translation_m.maximum < 1e-3
    assert trajectory_error(estimate, figure_of_eight(stamps(10, 20, 0.02)), "auto").count > 85


def test_nothing_is_interpolated_across_gaps() -> None:
    times = np.concatenate([stamps(0, 10, 0.05), stamps(15, 20, 0.05)])
    truth = figure_of_eight(times)
    query = stamps(0, 21, 0.01)
    mask = covered(truth, query)
    t_s = (query - EPOCH_NS) * 1e-9
    np.testing.assert_array_equal(mask, (t_s <= 9.951) | ((t_s > 14.999) & (t_s <= 19.951)))


@pytest.mark.parametrize("time_offset", [0.0, "auto"])
def test_too_few_pairs_are_named(time_offset: Any) -> None:  # noqa: ANN401
    estimate, truth = figure_of_eight(stamps(0, 10, 0.1)), figure_of_eight(stamps(100, 110, 0.1))
    with pytest.raises(TooFewPairsError, match=r"only 0 of 100 poses.*from 100.0 to 109.9 s"):
        trajectory_error(estimate, truth, time_offset)
    with pytest.raises(TooFewPairsError, match="the ground truth is empty"):
        trajectory_error(estimate, Trajectory(truth.stamps_ns[:0], np.zeros((0, 3))), time_offset)


def test_alignment_of_two_points_by_hand() -> None:
    pairs = Pairs(
        np.array([0, 1]),
        np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]),
        np.array([[1.0, 1.0, 0.0], [1.0, 4.0, 0.0]]),
    )
    np.testing.assert_allclose(xyyaw(alignment(pairs)), [1.0, 1.5, math.pi / 2])
