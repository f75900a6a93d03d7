"""Match scores from a run folder's tables: submaps, poses and points that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datasets.messages import Array
from datasets.se2 import inverse, se2, transform, xyyaw
from datasets.trajectory import Trajectory
from datasets.tum import format_stamp
from slam.evaluation.match_scores import ScoreGridConfig
from slam.mapping.scan_store import CLEAR, SURFACE, ScanStore
from slam.runs.graph_table import COLUMNS
from slam.runs.run_folder import Cell, Table
from slam.runs.scores import run_scores

START_NS = 1_700_000_000_123_456_789
SCANS = 30
CONFIG = ScoreGridConfig(scans_per_submap=10)


def poses() -> list[Array]:
    return [se2(0.05 * k, 0.02 * k, 0.01 * k) for k in range(SCANS)]


def stamps() -> list[int]:
    return [START_NS + k * 100_000_000 for k in range(SCANS)]


def wall_map() -> Array:
    """Points in the middles of cells of the map, so that no rounding moves them to others."""
    return np.column_stack([np.full(60, 3.025), np.arange(60) * 0.05 - 1.475])


def store(layer: str = "lidar") -> ScanStore:
    points = [transform(inverse(T), wall_map()) for T in poses()]
    return ScanStore.from_scans(
        stamps(), ["scan"] * SCANS, points, {"scan": (0.0, 0.0)}, layers={"scan": layer}
    )


def row(kind: str, first: int, last: int, T: Array, result: str = "accepted",
        kept: Cell = None) -> tuple[Cell, ...]:  # fmt: skip
    values = dict.fromkeys(COLUMNS) | {
        "kind": kind,
        "from_stamp_s": format_stamp(stamps()[first]),
        "to_stamp_s": format_stamp(stamps()[last]),
        "result": result,
        "kept": kept,
    }
    values |= dict(zip(("x_m", "y_m", "yaw_rad"), xyyaw(T), strict=True))
    return tuple(values[name] for name in COLUMNS)


def step(first: int, last: int) -> Array:
    T: Array = inverse(poses()[first]) @ poses()[last]
    return T


def trajectory() -> Trajectory:
    return Trajectory.from_matrices(stamps(), poses())


def test_a_scan_that_fits_scores_what_its_scans_made_of_the_cells() -> None:
    """Ten hits of 0.55: the odds (0.55 / 0.45) ** 10; a scan's cell is mostly the submap's."""
    table = Table(COLUMNS, [row("odometry", 0, 10, step(0, 10)), row("odometry", 10, 20,
                                                                     step(10, 20))])  # fmt: skip
    scores = run_scores(table, store(), trajectory(), CONFIG)
    odds = (0.55 / 0.45) ** 10
    assert (scores.steps.tried, scores.steps.accepted) == (2, 2)
    assert scores.steps.maximum == pytest.approx(odds / (1 + odds), abs=0.02)
    assert scores.loops.mean is None


def test_a_scan_that_was_laid_elsewhere_scores_less() -> None:
    right = Table(COLUMNS, [row("odometry", 0, 10, step(0, 10))])
    off = Table(COLUMNS, [row("odometry", 0, 10, step(0, 10) @ se2(0.3, 0.0, 0.0))])
    good = run_scores(right, store(), trajectory(), CONFIG).steps.mean
    bad = run_scores(off, store(), trajectory(), CONFIG).steps.mean
    assert good is not None
    assert bad is not None
    assert bad < 0.5 < good


def test_only_accepted_loops_that_stayed_count() -> None:
    rows = [
        row("odometry", 0, 10, step(0, 10)),
        row("loop", 0, 25, step(0, 25), kept="yes"),
        row("loop", 0, 26, step(0, 26) @ se2(1.0, 0.0, 0.0), kept="no"),
        row("loop", 0, 27, step(0, 27), result="low score"),
    ]
    scores = run_scores(Table(COLUMNS, rows), store(), trajectory(), CONFIG)
    assert (scores.loops.tried, scores.loops.accepted) == (3, 1)
    assert scores.loops.mean is not None
    assert scores.loops.mean > 0.8


def test_text_of_a_file_is_as_good_as_numbers() -> None:
    table = Table(COLUMNS, [row("odometry", 0, 10, step(0, 10))])
    text = Table(COLUMNS, [tuple("" if c is None else str(c) for c in table.rows[0])])
    assert run_scores(table, store(), trajectory()) == run_scores(text, store(), trajectory())


def test_points_that_are_no_hits_score_nothing() -> None:
    scans = store("camera")
    roles = np.full(scans.roles.size, CLEAR, np.uint8)
    blind = ScanStore.from_scans(
        stamps(),
        ["scan"] * SCANS,
        np.split(scans.points_base, SCANS),
        {"scan": (0.0, 0.0)},
        roles=np.split(roles, SCANS),
    )
    table = Table(COLUMNS, [row("odometry", 0, 10, step(0, 10))])
    scores = run_scores(table, blind, trajectory(), CONFIG)
    assert (scores.steps.tried, scores.steps.accepted, scores.steps.mean) == (1, 0, None)
    seen = ScanStore.from_scans(
        stamps(),
        ["scan"] * SCANS,
        np.split(scans.points_base, SCANS),
        {"scan": (0.0, 0.0)},
        roles=np.split(np.full(roles.size, SURFACE, np.uint8), SCANS),
        layers={"scan": "camera"},
    )
    mean = run_scores(table, seen, trajectory(), CONFIG).steps.mean
    assert mean is not None
    assert math.isfinite(mean)
