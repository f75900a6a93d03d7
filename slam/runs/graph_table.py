"""What a run tells of its graph: a row for each constraint and each search for a loop."""

from __future__ import annotations

import math

from backend.loop_attempt import ACCEPTED, LoopAttempt
from datasets.messages import Array
from datasets.se2 import inverse, xyyaw
from datasets.tum import format_stamp
from frontend.nodes import Node
from slam.pipeline import Slam
from slam.runs.run_folder import Cell, Table

COLUMNS = (
    "kind",
    "from_node",
    "to_node",
    "from_stamp_s",
    "to_stamp_s",
    "way_between_m",
    "result",
    "kept",
    "x_m",
    "y_m",
    "yaw_rad",
    "off_m",
    "off_rad",
    "window_m",
    "window_rad",
    "score",
    "second_score",
    "inlier_ratio",
)


def constraint_table(pipeline: Slam, T_map_nodes: Array) -> Table:
    """Rows of constraints.csv: the chain of submaps, then every search for a loop.

    x_m, y_m, yaw_rad : the pose of ``to_node`` in the frame of ``from_node`` as measured; off_m,
    off_rad: how far the final poses are from it. result : "accepted" or why not. kept : whether
    an accepted closure stayed when the closures were judged together at the end (empty: not asked).
    """
    rows = [
        _row("odometry", pipeline, T_map_nodes, ends, constraint.T_from_to)
        for constraint in pipeline.global_slam.constraints
        if constraint.kind == "odometry"
        for ends in [
            (
                pipeline.submaps[constraint.from_node].anchor,
                pipeline.submaps[constraint.to_node].anchor,
            )
        ]
    ]
    kept = kept_closures(pipeline)
    for attempt in pipeline.global_slam.search.attempts:
        ends = (attempt.submap.anchor, attempt.query)
        stays = kept.get(id(attempt))
        rows.append(
            _row("loop", pipeline, T_map_nodes, ends, attempt.T_anchor_base, attempt, stays)
        )
    return Table(COLUMNS, rows)


def kept_closures(pipeline: Slam) -> dict[int, bool]:
    """Whether each accepted closure stayed in the end, by the ``id`` of its attempt."""
    if pipeline.finished is None:
        return {}
    closures = pipeline.global_slam.closures
    return {
        id(attempt): stays
        for (attempt, _), stays in zip(closures, pipeline.finished.kept, strict=True)
    }


def _row(
    kind: str,
    pipeline: Slam,
    T_map_nodes: Array,
    ends: tuple[Node, Node],
    T_from_to: Array,
    attempt: LoopAttempt | None = None,
    kept: bool | None = None,
) -> tuple[Cell, ...]:
    first, last = ends
    T_final = inverse(T_map_nodes[first.index]) @ T_map_nodes[last.index]
    off_x, off_y, off_yaw = xyyaw(inverse(T_from_to) @ T_final)
    x, y, yaw = xyyaw(T_from_to)
    measured: tuple[Cell, ...] = (_short(x), _short(y), _short(yaw))
    measured += (_short(math.hypot(off_x, off_y)), _short(abs(off_yaw)))
    searched: tuple[Cell, ...] = (None,) * 5
    if attempt is not None:
        searched = (
            _short(attempt.window_m),
            _short(attempt.window_rad),
            _short(attempt.score),
            _short(attempt.second_score),
            _short(attempt.inlier_ratio),
        )
        if not attempt.score:  # nothing was found: there is no measurement
            measured = (None,) * 5
    return (
        kind,
        first.index,
        last.index,
        format_stamp(first.scan.stamp_ns),
        format_stamp(last.scan.stamp_ns),
        _short(abs(last.way_m - first.way_m)),
        attempt.result if attempt is not None else ACCEPTED,
        None if kept is None else "yes" if kept else "no",
        *measured,
        *searched,
    )


def _short(value: float) -> float:
    return round(float(value), 6)
