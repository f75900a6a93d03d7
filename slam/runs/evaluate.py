"""A run compared with what is known of it, in words and as plain data.

Numbers never travel without their unit and how they came about.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from datasets.errors import InputError
from datasets.relations_file import Relations, read_relations
from datasets.trajectory import Trajectory
from datasets.tum import format_stamp, read_tum
from slam.evaluation.relations import RelationErrors, cartographer_form, relation_errors
from slam.evaluation.revisits import APART_M, NEAR_M, OFF_M, RevisitErrors, revisit_errors
from slam.evaluation.trajectory_error import TrajectoryError, trajectory_error
from slam.runs.run_folder import ODOMETRY, TRAJECTORY

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True, slots=True)
class RelationReport:
    """The relations metric and how stamps between scans were reached (in words)."""

    file: str
    relations: Relations
    errors: RelationErrors
    reached: str


@dataclass(frozen=True, slots=True)
class EvaluationReport:
    """What was compared; None where there was nothing to compare with."""

    relations: RelationReport | None
    trajectory: TrajectoryError | None
    revisits: RevisitErrors | None = None

    def lines(self) -> list[str]:
        """The report in words, a line each."""
        lines = [] if self.relations is None else _relation_lines(self.relations)
        if self.trajectory is not None:
            lines += [""] if lines else []
            lines += _trajectory_lines(self.trajectory)
        if self.revisits is not None:
            lines += _revisit_lines(self.revisits)
        return lines

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON, units in the keys; what is not known is None."""
        relations = None if self.relations is None else _relation_dict(self.relations)
        trajectory = None if self.trajectory is None else _trajectory_dict(self.trajectory)
        revisits = None if self.revisits is None else _revisit_dict(self.revisits)
        return {"relations": relations, "trajectory": trajectory, "revisits": revisits}


def evaluate_run(
    run_folder: Path,
    relations: Path | None,
    ground_truth: Trajectory | None,
    time_offset: float | Literal["auto"] = 0.0,
) -> EvaluationReport:
    """Compare the trajectory of a run folder with relations, ground truth or both.

    Stamps of relations between the scans are reached along ``odometry.tum`` of the folder, which
    should hold all odometry that was recorded; without it they are interpolated. ``time_offset``
    is for the ground truth: seconds to add to a stamp of the run, or "auto".

    Raises InputError if a file cannot be read, no relation lies within the run, the run and the
    ground truth share too few times, or there is nothing to compare with.
    """
    if not run_folder.is_dir():
        raise InputError(
            "there is no such folder",
            where=str(run_folder),
            remedy="Give a folder that 'slam run' wrote.",
        )
    if relations is None and ground_truth is None:
        raise InputError(
            "there is nothing to compare the run with",
            where=str(run_folder),
            remedy="Give --relations, --ground-truth, or --walls or --structures alone.",
        )
    trajectory = read_tum(run_folder / TRAJECTORY)
    by_relations = None
    if relations is not None:
        path = run_folder / ODOMETRY
        odometry = read_tum(path) if path.exists() else None
        by_relations = _by_relations(relations, trajectory, odometry)
    by_truth = revisits = None
    if ground_truth is not None:
        by_truth = trajectory_error(trajectory, ground_truth, time_offset)
        offset_s = by_truth.time_offset.offset_s
        revisits = revisit_errors(trajectory, ground_truth, time_offset_s=offset_s)
    return EvaluationReport(by_relations, by_truth, revisits)


def print_report(report: EvaluationReport, console: Console) -> None:
    """Print the report, unwrapped, so that lines can be searched for."""
    for line in report.lines():
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _by_relations(
    path: Path, trajectory: Trajectory, odometry: Trajectory | None
) -> RelationReport:
    relations = read_relations(path)
    errors = relation_errors(relations, trajectory, odometry)
    if not errors.scores:
        raise InputError(
            "no relation lies within the time of the run",
            where=str(path),
            remedy="Give the relations of the same recording.",
        )
    if odometry is None:
        reached = "interpolated, there is no odometry"
    else:
        between = int((~np.isin(odometry.stamps_ns, trajectory.stamps_ns)).sum())
        reached = f"reached along odometry, {between} poses of it between scans"
    return RelationReport(str(path), relations, errors, reached)


def _relation_lines(report: RelationReport) -> list[str]:
    errors = report.errors
    lines = [
        f"{len(report.relations)} relations; poses between scans {report.reached}",
        "error = inverse(relation) * inverse(T_map_1) * T_map_2, mean +/- standard deviation",
    ]
    if errors.left_out:
        lines.append(f"left out, since they reach beyond the run: {errors.left_out}")
    for score in errors.scores:
        metres, degrees = score.abs_translation_m, score.abs_rotation_deg
        first_ns = int(report.relations.stamps_1_ns[score.worst])
        second_ns = int(report.relations.stamps_2_ns[score.worst])
        lines += [
            "",
            f"{score.over}, n = {score.count}:",
            *cartographer_form(score).splitlines(),
            f"Median error {metres.median:.5f} m, {degrees.median:.5f} deg",
            f"Maximum error {metres.maximum:.5f} m (relation {score.worst + 1}, from "
            f"{format_stamp(first_ns)} to {format_stamp(second_ns)} s), {degrees.maximum:.5f} deg",
        ]
    return lines


def _trajectory_lines(error: TrajectoryError) -> list[str]:
    metres, degrees = error.translation_m, error.rotation_deg
    protocol = f"SE(2) aligned, n = {error.count}"
    lines = [
        f"ground truth at {error.count} of {error.poses} poses; {error.time_offset}",
        f"ATE rmse {metres.rmse:.4f} m, mean {metres.mean:.4f} m, median {metres.median:.4f} m, "
        f"maximum {metres.maximum:.4f} m, {protocol}",
        f"ATE rotation rmse {degrees.rmse:.3f} deg, mean {degrees.mean:.3f} deg, median "
        f"{degrees.median:.3f} deg, maximum {degrees.maximum:.3f} deg, {protocol}",
    ]
    for stretch in error.relative:
        of = "true way" if stretch.unit == "m" else "time"
        moved, turned = stretch.translation_m, stretch.rotation_deg
        lines.append(
            f"RPE over {stretch.delta:g} {stretch.unit} of {of}: rmse {moved.rmse:.4f} m, "
            f"{turned.rmse:.3f} deg; maximum {moved.maximum:.4f} m, {turned.maximum:.3f} deg, "
            f"not aligned, n = {stretch.count}"
        )
    return lines


def _revisit_lines(errors: RevisitErrors) -> list[str]:
    meant = f"poses of the ground truth within {NEAR_M:g} m, more than {APART_M:g} m of path apart"
    if errors.missing_share is None or errors.off_share is None:
        return [f"revisits: none ({meant})"]
    lines = [
        f"revisits off by more than {OFF_M:g} m: {100.0 * errors.off_share:.1f} %, missing "
        f"{100.0 * errors.missing_share:.1f} %, n = {errors.count} ({meant})"
    ]
    if errors.p95_m is not None:
        lines.append(
            f"relative position at revisits: median {errors.median_m:.4f} m, mean "
            f"{errors.mean_m:.4f} m, p95 {errors.p95_m:.4f} m, not aligned, "
            f"n = {errors.count - errors.missing}"
        )
    return lines


def _revisit_dict(errors: RevisitErrors) -> dict[str, Any]:
    return {
        "count": errors.count,
        "median_m": errors.median_m,
        "mean_m": errors.mean_m,
        "p95_m": errors.p95_m,
        "missing_share": errors.missing_share,
        "off_share": errors.off_share,
    }


def _relation_dict(report: RelationReport) -> dict[str, Any]:
    return {
        "file": report.file,
        "relations": len(report.relations),
        "left_out": report.errors.left_out,
        "between_scans": report.reached,
        "scores": [asdict(score) for score in report.errors.scores],
    }


def _trajectory_dict(error: TrajectoryError) -> dict[str, Any]:
    offset = {
        key: None if isinstance(value, float) and math.isnan(value) else value
        for key, value in asdict(error.time_offset).items()
    }
    return {
        "pairs": error.count,
        "poses": error.poses,
        "alignment": "SE(2)",
        "T_truth_map": error.T_truth_map.tolist(),
        "ate_translation_m": asdict(error.translation_m),
        "ate_rotation_deg": asdict(error.rotation_deg),
        "rpe": [asdict(stretch) for stretch in error.relative],
        "time_offset": offset,
    }
