"""The revisit measure on laps with known errors, and against an independent script."""

from __future__ import annotations

import gzip
import itertools
import re
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

import slam.evaluation.revisits
from datasets.messages import Array
from datasets.se2 import between, se2
from datasets.trajectory import Trajectory
from datasets.tum import read_tum, write_tum
from slam.evaluation.revisits import RevisitErrors, revisit_errors

EPOCH_NS = 1_686_652_417_123_456_789
S = 1_000_000_000
SIDE_M, LAP_M = 15.0, 60.0


def square(at_m: Array) -> Array:
    """Poses (N, 3) after so many metres of a square driven counter-clockwise."""
    side, along = np.divmod(np.mod(at_m, LAP_M), SIDE_M)
    corners = SIDE_M * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    yaw = 0.5 * np.pi * side
    points = corners[side.astype(int)] + along[:, None] * np.column_stack(
        [np.cos(yaw), np.sin(yaw)]
    )
    return np.column_stack([points, yaw])


def laps(count: int = 120, step_m: float = 1.0, period_s: float = 1.0) -> Trajectory:
    """Two laps of a pose a metre are 120 poses; each has its own place again 60 m later."""
    stamps_ns = EPOCH_NS + np.rint(np.arange(count) * period_s * 1e9).astype(np.int64)
    return Trajectory(stamps_ns, square(step_m * np.arange(count)))


def shifted(trajectory: Trajectory, first: int, x_m: float, y_m: float = 0.0) -> Trajectory:
    """Poses from the index on moved within the map, their yaws as they were."""
    rows = trajectory.xyyaw.copy()
    rows[first:, :2] += (x_m, y_m)
    return Trajectory(trajectory.stamps_ns, rows)


def without(trajectory: Trajectory, *indices: int) -> Trajectory:
    keep = np.setdiff1d(np.arange(len(trajectory)), indices)
    return Trajectory(trajectory.stamps_ns[keep], trajectory.xyyaw[keep])


def pairs_one_by_one(reference: Trajectory) -> list[tuple[int, int]]:
    """By the definition: nearer than 2 m, more than 20 m of path apart."""
    points = reference.xyyaw[:, :2]
    path_m = [0.0]
    for a, b in itertools.pairwise(points):
        path_m.append(path_m[-1] + float(np.hypot(*(b - a))))
    return [
        (i, j)
        for i in range(len(points))
        for j in range(i + 1, len(points))
        if np.hypot(*(points[j] - points[i])) < 2.0 and path_m[j] - path_m[i] > 20.0
    ]


def test_a_rigid_motion_of_the_map_is_no_error() -> None:
    truth = laps()
    T = se2(-7.0, 3.0, 2.5)
    moved = [T @ T_truth_base for T_truth_base in truth.matrices()]
    errors = revisit_errors(Trajectory.from_matrices(truth.stamps_ns.tolist(), moved), truth)
    assert errors.count == len(pairs_one_by_one(truth)) > 120
    assert errors.missing == errors.off == 0
    assert errors.off_share == errors.missing_share == 0.0
    assert errors.p95_m == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("size_m", "off"), [(0.3, False), (0.49, False), (0.51, True)])
def test_a_second_lap_beside_the_first(size_m: float, off: bool) -> None:
    """All revisits of one lap by the other are wrong by the same length."""
    truth = laps()
    lap = 60
    within = [(i, j) for i, j in pairs_one_by_one(truth) if (i < lap) == (j < lap)]
    errors = revisit_errors(shifted(truth, lap, 0.6 * size_m, 0.8 * size_m), truth)
    across = errors.count - len(within)
    assert errors.median_m == pytest.approx(size_m)
    assert errors.p95_m == pytest.approx(size_m)
    assert errors.mean_m == pytest.approx(size_m * across / errors.count)
    assert errors.off == (across if off else 0)


def test_a_wrong_heading_moves_what_is_seen_from_there() -> None:
    """The error is of the later position in the frame of the earlier pose, by 2 sin(yaw / 2) d."""
    truth = laps()
    rows = truth.xyyaw.copy()
    rows[7, 2] += 0.2
    errors = revisit_errors(Trajectory(truth.stamps_ns, rows), truth)
    pairs = [(i, j) for i, j in pairs_one_by_one(truth) if i == 7]
    points = truth.xyyaw[:, :2]
    lengths = [np.hypot(*(points[j] - points[i])) for i, j in pairs]
    assert sum(length > 0 for length in lengths) >= 2
    expected = 2.0 * np.sin(0.1) * sum(lengths) / errors.count
    assert errors.mean_m == pytest.approx(expected)


def test_many_poses_in_blocks_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = laps()
    wrong = shifted(truth, 73, 0.1, 0.4)
    whole = revisit_errors(wrong, truth)
    monkeypatch.setattr(slam.evaluation.revisits, "BLOCK", 7)
    assert asdict(revisit_errors(wrong, truth)) == pytest.approx(asdict(whole))
    pairs = np.array(pairs_one_by_one(truth))
    a, b = (between(t.xyyaw[pairs[:, 0]], t.xyyaw[pairs[:, 1]])[:, :2] for t in (wrong, truth))
    error_m = np.hypot(*(a - b).T)
    assert whole.count == len(pairs)
    assert whole.mean_m == pytest.approx(error_m.mean())
    assert whole.p95_m == pytest.approx(np.percentile(error_m, 95))


def test_what_is_missing_counts_as_off() -> None:
    truth = laps()
    lost = (50, 60, 61)
    errors = revisit_errors(without(truth, *lost), truth)
    pairs = pairs_one_by_one(truth)
    missing = sum(i in lost or j in lost for i, j in pairs)
    assert (errors.count, errors.missing, errors.off) == (len(pairs), missing, missing)
    assert errors.missing_share == errors.off_share == missing / len(pairs)
    assert errors.p95_m == pytest.approx(0.0, abs=1e-9)


def test_all_revisits_are_missing() -> None:
    truth = laps()
    errors = revisit_errors(without(truth, *range(60, 120)), truth)
    assert errors.count > errors.missing  # a place beside a corner is met again within the lap
    only = revisit_errors(without(truth, *range(20, 120)), truth)
    assert only == RevisitErrors(only.count, only.count, only.count, None, None, None)
    assert only.off_share == 1.0


def test_there_are_no_revisits() -> None:
    stamps_ns = EPOCH_NS + S * np.arange(100)
    straight = Trajectory(stamps_ns, np.column_stack([np.arange(100.0), *np.zeros((2, 100))]))
    errors = revisit_errors(straight, straight)
    assert errors == RevisitErrors(0, 0, 0, None, None, None)
    assert errors.off_share is None
    assert errors.missing_share is None
    there = laps(19)
    assert revisit_errors(there, there).count == 0  # one pose after the other is no revisit


@pytest.mark.parametrize(("late_s", "share"), [(0.019, 0.0), (-0.019, 0.0), (0.021, 1.0)])
def test_a_pose_within_20_ms_stands_for_a_reference_pose(late_s: float, share: float) -> None:
    truth = laps()
    late = Trajectory(truth.stamps_ns + round(late_s * 1e9), truth.xyyaw)
    assert revisit_errors(late, truth).missing_share == share
    assert revisit_errors(late, truth, time_offset_s=-late_s).missing_share == 0.0


def test_the_nearest_pose_is_taken() -> None:
    """Poses 10 ms apart; those 6 ms away from the reference's stamps are wrong by 5 m."""
    truth = laps()
    near, far = truth.stamps_ns + 4_000_000, truth.stamps_ns - 6_000_000
    wrong = truth.xyyaw + np.random.default_rng(1).normal(0.0, 5.0, truth.xyyaw.shape)
    order = np.argsort(np.concatenate([near, far]))
    stamps_ns = np.concatenate([near, far])[order]
    both = Trajectory(stamps_ns, np.concatenate([truth.xyyaw, wrong])[order])
    assert revisit_errors(both, truth).p95_m == pytest.approx(0.0, abs=1e-9)


def test_reference_poses_at_scans_alone() -> None:
    """Of every third scan; the path stays that of the whole reference."""
    truth = laps(240, 0.5)
    third = np.arange(1, 240, 3)
    kept = without(truth, *np.setdiff1d(np.arange(240), third))
    count = sum(i in third and j in third for i, j in pairs_one_by_one(truth))
    errors = revisit_errors(kept, truth, scans_ns=kept.stamps_ns)
    assert (errors.count, errors.missing) == (count, 0)
    lost = revisit_errors(without(kept, 40), truth, scans_ns=kept.stamps_ns)
    assert lost.count == count
    assert lost.missing == lost.off > 0
    denser = revisit_errors(kept, truth)  # without the scans' stamps: they are the poses' own
    assert asdict(denser) == pytest.approx(asdict(errors), abs=1e-9)


def test_a_dense_reference_is_interpolated_at_the_poses() -> None:
    """Ground truth at 50 Hz, scans at 7 Hz: the stamps hardly meet, and nothing is missing."""
    truth = laps(6001, 0.02, 0.02)
    stamps_ns = EPOCH_NS + np.arange(0, 120 * S, S // 7)
    exact = Trajectory(stamps_ns, truth.at(stamps_ns))
    errors = revisit_errors(exact, truth)
    assert errors.count > 1000
    assert errors.missing == 0
    assert errors.p95_m == pytest.approx(0.0, abs=1e-9)
    beside = revisit_errors(shifted(exact, 60 * 7, 0.0, 0.6), truth)
    assert beside.median_m == pytest.approx(0.6)


def test_a_gap_before_a_dense_reference_is_missing() -> None:
    truth = laps(6001, 0.02, 0.02)
    stamps_ns = EPOCH_NS + np.arange(0, 120 * S, S // 5)
    exact = Trajectory(stamps_ns, truth.at(stamps_ns))
    whole = revisit_errors(exact, truth)
    for lost in (range(100), range(300, 400), range(500, 600)):
        gap = revisit_errors(without(exact, *lost), truth)
        assert gap.count == pytest.approx(whole.count, rel=0.01)
        met_again = (np.array(lost)[:, None] % 300 == np.arange(600) % 300).any(axis=0).mean()
        assert gap.missing_share == pytest.approx(met_again, abs=0.05)
        assert gap.off == gap.missing


def test_a_stretch_lost_from_a_recording_of_every_third_scan() -> None:
    """The same as with the stamps of its scans, though it stood where nothing was recorded."""
    truth = laps(240, 0.5)
    stood_ns = truth.stamps_ns + 500 * S * (np.arange(240) > 100)
    truth = Trajectory(stood_ns, truth.xyyaw)
    kept = without(truth, *np.setdiff1d(np.arange(240), np.arange(1, 240, 3)))
    lost = without(kept, *range(40, 60))
    for mapped in (kept, lost, without(kept, *range(60, 80)), without(kept, *range(20))):
        exact = revisit_errors(mapped, truth, scans_ns=kept.stamps_ns)
        assert asdict(revisit_errors(mapped, truth)) == pytest.approx(asdict(exact), abs=1e-9)
    assert revisit_errors(lost, truth).missing > 20


def test_two_clocks_that_never_meet() -> None:
    truth = laps()
    errors = revisit_errors(Trajectory(truth.stamps_ns - 10**18, truth.xyyaw), truth)
    assert errors.missing_share == 1.0


SCRIPT = Path("tools") / "revisits.py"


@pytest.mark.parametrize("every", [1, 3])
def test_the_figures_are_those_of_the_script(shared_data: Path, tmp_path: Path, every: int) -> None:
    """``aces``, its odometry in place of a run's poses and every 13th of them left out."""
    script = shared_data.parent / SCRIPT
    if not script.is_file():
        pytest.skip(f"no script at {script}")
    recordings = shared_data / "recordings"
    reference = recordings / "aces.reference.tum"
    truth = read_tum(reference)
    rows = truth.xyyaw.copy()
    rows[:, 2] += 1e-4 * np.arange(len(rows))
    rows[:, 0] += 1.2 * (np.arange(len(rows)) > 250)
    bent = without(Trajectory(truth.stamps_ns, rows), *range(0, len(rows), 13))
    mapped = tmp_path / "trajectory.tum"
    write_tum(mapped, bent)
    words: list[Path] = [mapped, reference]
    scans_ns = None
    if every > 1:
        words.append(tmp_path / "thinned.log.gz")
        scans_ns = every_kth_scan(recordings / "aces.log.gz", words[-1], every)
    command = [sys.executable, str(script), *map(str, words)]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    line = next(line for line in told.splitlines() if line.startswith("revisits"))
    count, median, mean, p95, missing, off = (
        float(text)
        for text in re.findall(r"(?:revisits|median|mean|p95|missing|0\.5 m) ([0-9.]+)", line)
    )
    errors = revisit_errors(bent, truth, scans_ns)
    assert errors.count == count > 50
    assert errors.median_m == pytest.approx(median, abs=6e-4)
    assert errors.mean_m == pytest.approx(mean, abs=6e-4)
    assert errors.p95_m == pytest.approx(p95, abs=6e-4)
    assert errors.missing_share == pytest.approx(missing / 100.0, abs=6e-4)
    assert errors.off_share == pytest.approx(off / 100.0, abs=6e-4)
    assert 0.0 < missing < off


def every_kth_scan(source: Path, target: Path, every: int) -> Array:
    """Write a log with every k-th scan of another; the stamps of those scans."""
    stamps_ns, seen = [], 0
    with gzip.open(source, "rt") as lines, gzip.open(target, "wt") as out:
        for line in lines:
            if line.startswith("FLASER"):
                seen += 1
                if seen % every:
                    continue
                stamps_ns.append(round(float(line.split()[-1]) * 1e9))
            out.write(line)
    return np.array(stamps_ns)
