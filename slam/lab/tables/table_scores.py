"""Table 5 beside the paper's: match scores of constraints, and what they are worth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.evaluation.match_scores import ScoreSummary, evenly_spaced, summarise
from slam.lab.drives.rows import ClosureRow, ConstraintRow, TrajectoryRow
from slam.lab.drives.systems import (
    CAMERA,
    CORRELATIVE,
    FUSED,
    FUSED_PAPER,
    LIDAR,
    POSE_INCREMENT,
)
from slam.lab.page import table
from slam.lab.tables import paper_tables as paper
from slam.lab.tables.spread import by_system, mean_of, mean_spread, number

PRINTED = {
    LIDAR.name: "Lidar",
    CAMERA.name: "Camera",
    POSE_INCREMENT.name: "Paper [16]",
    CORRELATIVE.name: "Paper [17]",
    FUSED_PAPER.name: "Lidar + Camera",
    FUSED.name: "Lidar + Camera",
}
"""The row of the paper's table that each system stands beside, in the table's order."""
LABELS = {
    POSE_INCREMENT.name: "Paper [16], re-implemented here",
    CORRELATIVE.name: "Paper [17], re-implemented here",
}


def scores_table(rows: Sequence[ConstraintRow]) -> str:
    """Of 8 accepted constraints evenly spaced in time, for each seed; means over the seeds."""
    of_system, printed = by_system(rows), {row.name: row for row in paper.MATCH_SCORES}
    head = ["", "paper: min", "max", "mean", "min", "max", "mean", "lidar's beams alone: mean"]
    body = []
    for name in _ordered(of_system):
        theirs = printed[PRINTED[name]]
        eights = [_eight(own) for own in _by_seed(of_system[name])]
        summaries = [_summary(eight) for eight in eights]
        body.append(
            [
                LABELS.get(name, name),
                *(f"{each:.3f}" for each in (theirs.minimum, theirs.maximum, theirs.mean)),
                mean_spread(each.minimum for each in summaries),
                mean_spread(each.maximum for each in summaries),
                f"**{mean_spread(each.mean for each in summaries)}**",
                mean_spread(mean_of(row.lidar_score for row in eight) for eight in eights),
            ]
        )
    return table(head, body)


def worth_table(rows: Sequence[ConstraintRow]) -> str:
    """Of all accepted constraints: their scores, and their errors against the truth.

    The last three columns are of what reached the score and was not accepted.
    """
    of_system = by_system(rows)
    head = ["", "accepted of tried", "score", "lidar's beams alone", "error, m", "median, m"]
    head += ["error, deg", "false", "slide, or ambiguous", "their error, m", "false"]
    body = []
    for name in _ordered(of_system):
        seeds = [[row for row in own if row.accepted] for own in _by_seed(of_system[name])]
        every = [row for own in seeds for row in own]
        errors_m = [row.error_m for row in every if row.error_m is not None]
        unsure = [row for row in of_system[name] if row.scored and not row.accepted]
        body.append(
            [
                LABELS.get(name, name),
                f"{len(every)} of {len(of_system[name])}",
                mean_spread(mean_of(row.score for row in own) for own in seeds),
                mean_spread(mean_of(row.lidar_score for row in own) for own in seeds),
                mean_spread((mean_of(row.error_m for row in own) for own in seeds), 4),
                number(float(np.median(errors_m)) if errors_m else None, 4),
                mean_spread(mean_of(row.error_deg for row in own) for own in seeds),
                f"{sum(row.false for row in every)}",
                f"{len(unsure)}",
                number(mean_of(row.error_m for row in unsure)),
                f"{sum(row.false for row in unsure)}",
            ]
        )
    return table(head, body)


def closures_table(rows: Sequence[ClosureRow], trajectories: Sequence[TrajectoryRow]) -> str:
    """The loop closures of each system's own search, and the trajectory that came of it."""
    of_system, ways = by_system(rows), by_system(trajectories)
    head = ["", "searched", "accepted", "false", "kept in the graph", "false", "error of kept, m"]
    head += ["deg", "ATE rmse, m", "ATE, deg", "CPU, s"]
    body = []
    for name, own in of_system.items():
        ran = ways.get(name, [])
        counts = ("tried", "accepted", "false_accepted", "kept", "false_kept")
        body.append(
            [
                LABELS.get(name, name),
                *(str(sum(getattr(row, count) for row in own)) for count in counts),
                mean_spread((row.kept_error_m for row in own), 4),
                mean_spread(row.kept_error_deg for row in own),
                mean_spread(row.ate_m for row in ran),
                mean_spread(row.ate_deg for row in ran),
                mean_spread((row.cpu_s for row in ran), 1),
            ]
        )
    return table(head, body)


def mean_errors(rows: Sequence[ConstraintRow], system: str) -> tuple[float | None, float | None]:
    """(m, deg) of all accepted constraints of a system."""
    own = [row for row in rows if row.system == system and row.accepted]
    return mean_of(row.error_m for row in own), mean_of(row.error_deg for row in own)


def scored_errors(rows: Sequence[ConstraintRow], system: str) -> tuple[float | None, int]:
    """(mean error m, false ones) of all that reach the score, accepted or not."""
    own = [row for row in rows if row.system == system and row.scored]
    return mean_of(row.error_m for row in own), sum(row.false for row in own)


def closure_errors(rows: Sequence[ClosureRow]) -> list[float]:
    """Mean error, m, of the closures that stay, of each drive that has some."""
    return [row.kept_error_m for row in rows if row.kept_error_m is not None]


def _ordered(of_system: dict[str, list[ConstraintRow]]) -> list[str]:
    return [name for name in PRINTED if name in of_system]


def _by_seed(rows: Sequence[ConstraintRow]) -> list[list[ConstraintRow]]:
    seeds = sorted({row.seed for row in rows})
    return [[row for row in rows if row.seed == seed] for seed in seeds]


def _eight(rows: Sequence[ConstraintRow]) -> list[ConstraintRow]:
    """The accepted ones of a drive that are nearest to 8 even times."""
    accepted = [row for row in rows if row.accepted]
    stamps_ns = np.array([round(row.after_s * 1e9) for row in accepted], dtype=np.int64)
    chosen = evenly_spaced(stamps_ns, paper.CONSTRAINTS_A_ROW)
    return [accepted[k] for k in chosen.tolist()]


def _summary(rows: Sequence[ConstraintRow]) -> ScoreSummary:
    scores = [row.score for row in rows if row.score is not None]
    return summarise(scores, len(rows))
