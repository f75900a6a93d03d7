"""The report on a run folder: words, plain data, and what stops it."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from datasets.errors import InputError
from datasets.trajectory import Trajectory
from datasets.tum import read_tum, write_tum
from slam.evaluation.association import TooFewPairsError
from slam.runs.evaluate import EvaluationReport, evaluate_run, print_report

S = 1_000_000_000


def way(step_ns: int, count: int) -> Trajectory:
    """Along a circle of 5 m at 0.5 m/s."""
    stamps_ns = 1_000 * S + step_ns * np.arange(count, dtype=np.int64)
    angle = step_ns * 1e-9 * np.arange(count) * 0.1
    rows = [5 * np.sin(angle), 5 - 5 * np.cos(angle), angle]
    return Trajectory(stamps_ns, np.column_stack(rows))


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """A run whose odometry is exact: scans once in two seconds, odometry ten times a second."""
    folder = tmp_path / "run"
    folder.mkdir()
    write_tum(folder / "trajectory.tum", way(2 * S, 31))
    write_tum(folder / "odometry.tum", way(S // 10, 601))
    return folder


@pytest.fixture
def relations(tmp_path: Path) -> Path:
    """The way over 1 s (between scans) is 0.5 m of a circle; one relation is 0.3 m off."""
    chord = way(S, 2).xyyaw[1]
    lines = [f"{1000 + t} {1001 + t} {chord[0]} {chord[1]} 0 0 0 {chord[2]}" for t in range(20)]
    lines.append(f"1030 1031 {chord[0] + 0.3} {chord[1]} 0 0 0 {chord[2]}")
    path = tmp_path / "way.relations"
    path.write_text("\n".join(lines) + "\n")
    return path


def words(report: EvaluationReport) -> str:
    out = io.StringIO()
    print_report(report, Console(file=out, width=40))
    return out.getvalue()


def test_relations_are_told_in_full(run_folder: Path, relations: Path) -> None:
    report = evaluate_run(run_folder, relations, None)
    text = words(report)
    assert text.splitlines() == report.lines()
    assert "21 relations; poses between scans reached along odometry, 570 poses of it" in text
    assert "all relations, n = 21:\nAbs translational error 0.01429 +/- 0.06547 m\n" in text
    assert "Maximum error 0.30000 m (relation 21, from 1030.000000000 to 1031.0000" in text
    assert "more than 5 s apart" not in text


def test_odometry_between_scans_is_used_where_there_is_any(
    run_folder: Path, relations: Path
) -> None:
    with_odometry = evaluate_run(run_folder, relations, None).relations
    (run_folder / "odometry.tum").unlink()
    without = evaluate_run(run_folder, relations, None).relations
    assert with_odometry is not None
    assert without is not None
    assert with_odometry.errors.scores[0].abs_translation_m.median < 1e-9
    assert without.errors.scores[0].abs_translation_m.median > 0.001
    assert without.reached == "interpolated, there is no odometry"


def test_ground_truth_is_told_with_unit_and_protocol(run_folder: Path) -> None:
    report = evaluate_run(run_folder, None, way(S // 20, 1001), "auto")
    text = words(report)
    assert "ground truth at 25 of 31 poses; the trajectory is stamped" in text
    assert "m, SE(2) aligned, n = 25\n" in text
    assert "RPE over 1 m of true way: rmse 0.0" in text
    assert "RPE over 10 s of time: rmse 0.0" in text


def test_plain_data_is_strict_json(run_folder: Path, relations: Path) -> None:
    data = evaluate_run(run_folder, relations, way(S // 20, 1001)).as_dict()
    back = json.loads(json.dumps(data, allow_nan=False))
    assert back == data
    assert back["relations"]["scores"][0]["abs_translation_m"]["maximum"] == pytest.approx(0.3)
    assert back["trajectory"]["time_offset"]["rmse_without_m"] is None
    assert back["trajectory"]["ate_translation_m"]["rmse"] < 1e-3


def test_revisits_stand_beside_the_trajectory_error(run_folder: Path) -> None:
    """A circle of 31.4 m in 62.8 s: from 60 s on the start is met again within 2 m."""
    report = evaluate_run(run_folder, None, way(S // 20, 1201))
    text = words(report)
    assert "\nrevisits off by more than 0.5 m: 0.0 %, missing 0.0 %, n = " in text
    assert "\nrelative position at revisits: median 0.0000 m, mean 0.0000 m, p95 0.0000 m" in text
    data = report.as_dict()["revisits"]
    assert list(data) == ["count", "median_m", "mean_m", "p95_m", "missing_share", "off_share"]
    assert data["count"] > 0
    assert data["off_share"] == 0.0
    cut = read_tum(run_folder / "trajectory.tum")
    write_tum(run_folder / "trajectory.tum", Trajectory(cut.stamps_ns[:15], cut.xyyaw[:15]))
    lost = evaluate_run(run_folder, None, way(S // 20, 1201))
    assert "off by more than 0.5 m: 100.0 %, missing 100.0 %" in words(lost)
    assert lost.as_dict()["revisits"]["p95_m"] is None


def test_no_revisits_are_no_good_result(run_folder: Path) -> None:
    report = evaluate_run(run_folder, None, way(S // 20, 601))
    assert "revisits: none (poses of the ground truth within 2 m" in words(report)
    assert report.as_dict()["revisits"]["off_share"] is None


def test_what_stops_it_is_named(run_folder: Path, relations: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing to compare"):
        evaluate_run(run_folder, None, None)
    with pytest.raises(InputError, match="no such folder"):
        evaluate_run(run_folder / "nowhere", None, None)
    with pytest.raises(InputError, match="cannot read the trajectory"):
        evaluate_run(tmp_path, relations, None)
    other = tmp_path / "other.relations"
    other.write_text("5000 5001 0 0 0 0 0 0\n")
    with pytest.raises(InputError, match="no relation lies within"):
        evaluate_run(run_folder, other, None)
    early = Trajectory(np.arange(3, dtype=np.int64), np.zeros((3, 3)))
    with pytest.raises(TooFewPairsError):
        evaluate_run(run_folder, None, early)
