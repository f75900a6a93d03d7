"""The parts of the benchmark that compare runs with what is known of their recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

from datasets.relations_file import read_relations
from datasets.trajectory import Trajectory
from datasets.tum import read_tum
from slam.evaluation.relations import relation_errors
from slam.evaluation.wall_thickness import CELL_M
from slam.lab.bench.session import MappedRecording, Part, Session
from slam.lab.page import Bar, Measured, Value, table

JARVIS: Final = "jarvis_complex_path_fast.bag"
JARVIS_HIGH: Final = "/driver_laser_navigation/laser_scan"
GUARDIAN: Final = "guardian_controller_2.bag"

Score = dict[str, Any]


def by_relations(session: Session, name: str) -> Measured:
    """Errors over the relations, CPU time and memory of ``slam run`` with all defaults."""
    run = session.map_timed(f"{name}.log.gz")
    relations = session.recordings / f"{name}.relations"
    scores = _scores_of(session, run, relations)
    metres, degrees = scores[0]["abs_translation_m"], scores[0]["abs_rotation_deg"]
    cpu_s, imports = run.usages.cpu_s, session.imports
    by_choice = {score["over"]: score for score in scores} | _in_other_ways(run, relations)
    return Measured(
        values=(
            Value(metres["mean"], f"+- {metres['std']:.4f} m, n = {scores[0]['count']}"),
            Value(degrees["mean"], f"+- {degrees['std']:.3f} deg"),
            Value(metres["maximum"], f"relation {scores[0]['worst'] + 1}"),
            Value(cpu_s.median, f"{cpu_s.words('s')}; imports alone {imports.cpu_s.median:.2f} s"),
            Value(run.usages.peak_mb, f"the most of all; imports alone {imports.peak_mb:.0f} MB"),
        ),
        details=_score_table(by_choice),
        brief=f"{metres['mean']:.3f} m, {degrees['mean']:.2f} deg, {cpu_s.median:.1f} s",
    )


def without_odometry(session: Session) -> Measured:
    """``intel`` from its scans alone; the run keeps the odometry for the evaluator only."""
    run = session.map_recording(session.recordings / "intel.log.gz", "--no-odometry")
    relations = session.recordings / "intel.relations"
    evaluation = session.evaluate(run, "--relations", str(relations))["relations"]
    scores, metrics = evaluation["scores"], run.metrics()
    unmatched: Mapping[str, int] = metrics["scans_unmatched"]
    times_lost = sum(count for why, count in unmatched.items() if why.startswith("lost"))
    places = ", ".join(
        f"after {place['after_s']:.0f} s near ({place['x_m']:.1f}, {place['y_m']:.1f})"
        for place in metrics["lost"]
    )
    reasons = ", ".join(f"{why}: {count}" for why, count in unmatched.items())
    return Measured(
        values=(
            Value(
                scores[0]["abs_translation_m"]["mean"],
                f"lost {times_lost} times" + (f": {places}" if places else ""),
                met=len(metrics["lost"]) == times_lost,
            ),
        ),
        details=_score_table({score["over"]: score for score in scores})
        + f"\n\nPoses between scans {evaluation['between_scans']}, which the run did not use. "
        f"Of {metrics['scans']} scans without a match: {reasons or 'none'}. It took {_cost(run)}.",
    )


def jarvis(session: Session) -> Measured:
    """The high lidar without odometry, against the reflectors' ground truth."""
    path = session.recordings / JARVIS
    run = session.map_recording(path, "--lidar", JARVIS_HIGH, "--no-odometry")
    options = ("--ground-truth", str(path), "--time-offset", "auto")
    error = session.evaluate(run, *options)["trajectory"]
    metres, degrees = error["ate_translation_m"], error["ate_rotation_deg"]
    return Measured(
        values=(
            Value(
                metres["rmse"],
                f"SE(2) aligned, n = {error['pairs']} of {error['poses']}, "
                f"clock offset {error['time_offset']['offset_s']:+.4f} s",
            ),
        ),
        details=f"`slam run {JARVIS} --lidar {JARVIS_HIGH} --no-odometry`: ATE mean "
        f"{metres['mean']:.4f} m, maximum {metres['maximum']:.4f} m, rotation rmse "
        f"{degrees['rmse']:.3f} deg. It took {_cost(run)}.",
    )


def guardian(session: Session) -> Measured:
    """Both lidars, out and back: how thick the walls came out."""
    run = session.map_recording(session.recordings / GUARDIAN)
    return Measured(
        values=(_thickness(session, run),),
        details=f"`slam run {GUARDIAN}`: {run.metrics()['way_m']:.1f} m driven. It took "
        f"{_cost(run)}. The strip across a wall that holds the central 95 % of its hits, over half"
        " metres of wall (`slam evaluate --walls`).",
    )


def kiss_icp(session: Session) -> Measured:
    """The second front end on three recordings."""
    values = []
    for name in ("intel", "fr079"):
        run = session.map_recording(session.recordings / f"{name}.log.gz", "--frontend=kiss-icp")
        relations = session.recordings / f"{name}.relations"
        score = _scores_of(session, run, relations)[0]
        metres, degrees = score["abs_translation_m"], score["abs_rotation_deg"]
        how = f"{degrees['mean']:.2f} deg, maximum {metres['maximum']:.2f} m; {_cost(run)}"
        values.append(Value(metres["mean"], how))
    run = session.map_recording(session.recordings / GUARDIAN, "--frontend=kiss-icp")
    thickness = _thickness(session, run)
    values.append(Value(thickness.value, f"{thickness.how}; {_cost(run)}"))
    return Measured(tuple(values))


def _thickness(session: Session, run: MappedRecording) -> Value:

    walls = session.evaluate(run, "--walls")["walls"]
    return Value(
        walls["thickness_95_m"] / CELL_M,
        f"{walls['thickness_95_m']:.3f} m, median {walls['thickness_median_m']:.3f} m, "
        f"{walls['stretches']} stretches of {walls['walls']} walls, {walls['left_out']} left out",
    )


def _cost(run: MappedRecording) -> str:
    return f"{run.usages.cpu_s.median:.1f} s CPU, {run.usages.peak_mb:.0f} MB"


def _scores_of(session: Session, run: MappedRecording, relations: Path) -> list[Score]:
    """Over all relations, and over choices of them, as ``slam evaluate`` has them."""
    data = session.evaluate(run, "--relations", str(relations))
    scores: list[Score] = data["relations"]["scores"]
    return scores


def _in_other_ways(run: MappedRecording, relations_file: Path) -> dict[str, Score]:
    """Over all relations: the same run with its poses interpolated, and the raw odometry."""
    mapped, odometry = (read_tum(run.folder / f"{x}.tum") for x in ("trajectory", "odometry"))
    raw = Trajectory(mapped.stamps_ns, odometry.at(mapped.stamps_ns))
    relations = read_relations(relations_file)
    interpolated = relation_errors(relations, mapped, None).scores[0]
    uncorrected = relation_errors(relations, raw, odometry).scores[0]
    return {
        "all relations, but poses between scans interpolated": asdict(interpolated),
        "all relations, raw odometry": asdict(uncorrected),
    }


def _score_table(scores: Mapping[str, Score]) -> str:
    head = (
        "over",
        "n",
        "mean, m",
        "median, m",
        "maximum, m",
        "mean, deg",
        "median, deg",
        "max, deg",
    )
    rows = []
    for over, score in scores.items():
        metres, degrees = score["abs_translation_m"], score["abs_rotation_deg"]
        rows.append(
            (
                over,
                str(score["count"]),
                f"{metres['mean']:.4f} +- {metres['std']:.4f}",
                f"{metres['median']:.4f}",
                f"{metres['maximum']:.3f}",
                f"{degrees['mean']:.3f} +- {degrees['std']:.3f}",
                f"{degrees['median']:.3f}",
                f"{degrees['maximum']:.2f}",
            )
        )
    return table(head, rows)


def _log_part(name: str, *bars: Bar) -> Part:
    needs = (f"{name}.log.gz", f"{name}.relations")
    return Part(name, f"`{name}`, all defaults", bars, needs, partial(by_relations, name=name))


PARTS: Final = (
    _log_part(
        "intel",
        Bar("`intel`, mean translation over all relations", "m", 0.050, 0.043, 4),
        Bar("`intel`, mean rotation", "deg", 1.45, 1.2, 3),
        Bar("`intel`, maximum translation over all relations", "m", 0.65, None, 3),
        Bar("`intel`, CPU time of `slam run`", "s", 8.0, 5.0),
        Bar("`intel`, peak memory", "MB", 600, 400, 0),
    ),
    _log_part(
        "fr079",
        Bar("`fr079`, mean translation over all relations", "m", 0.040, 0.034, 4),
        Bar("`fr079`, mean rotation", "deg", 0.80, 0.70, 3),
        Bar("`fr079`, maximum translation over all relations", "m", 0.25, 0.20, 3),
        Bar("`fr079`, CPU time of `slam run`", "s", 12.0, 8.0),
        Bar("`fr079`, peak memory", "MB", 600, 400, 0),
    ),
    Part(
        "no-odometry",
        "`intel` without odometry",
        (
            Bar(
                "`intel` without odometry, mean translation",
                "m",
                "completes, says where lost",
                0.06,
                4,
            ),
        ),
        ("intel.log.gz", "intel.relations"),
        without_odometry,
    ),
    Part(
        "jarvis",
        "`jarvis_complex`, high lidar alone",
        (Bar("`jarvis_complex`, high lidar, no odometry, ATE rmse", "m", 0.05, 0.02, 4),),
        (JARVIS,),
        jarvis,
    ),
    Part(
        "guardian",
        "`guardian_controller_2`, both lidars",
        (Bar("`guardian_controller_2`, wall thickness, p95", "cells", 3, 2, 2),),
        (GUARDIAN,),
        guardian,
    ),
    Part(
        "kiss-icp",
        "The front end kiss-icp",
        (
            Bar("`intel` with kiss-icp, mean translation", "m", decimals=4),
            Bar("`fr079` with kiss-icp, mean translation", "m", decimals=4),
            Bar("`guardian_controller_2` with kiss-icp, wall thickness, p95", "cells"),
        ),
        ("intel.log.gz", "intel.relations", "fr079.log.gz", "fr079.relations", GUARDIAN),
        kiss_icp,
    ),
)
