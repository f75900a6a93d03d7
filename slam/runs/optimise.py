"""What ``slam optimise GRAPH`` does: a pose graph's file in, the optimised one out."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from datasets.errors import InputError
from datasets.se2 import pose_matrices, xyyaw_rows

if TYPE_CHECKING:
    from rich.console import Console

    from backend.graph_arrays import ConstraintArrays, Mask
    from backend.pose_graph_files import Format, PoseGraphFile
    from backend.robust import RobustResult

REJECTED_SHOWN = 20
SUFFIXES: dict[str, Format] = {".g2o": "g2o", ".graph": "toro", ".toro": "toro"}


@dataclass(frozen=True, slots=True)
class Rejection:
    """A closure that was left out, by the file's own numbers of its vertices."""

    from_id: int
    to_id: int
    chi2: float
    reason: str


@dataclass(frozen=True, slots=True)
class OptimiseReport:
    """What was done to a pose graph.

    written             : the file with the optimised poses and the constraints kept.
    vertices, steps     : vertices, and edges between consecutive ones.
    closures            : all other edges.
    left_out            : lines of other kinds, by tag; not in the file written.
    chi2_start, chi2    : over the constraints kept, at the poses of the file and at the end.
    degrees_of_freedom  : what chi2 is expected to be where information is right.
    rejected            : closures left out (robust only).
    scale               : factor by which the covariances were taken to be too small (robust only).
    steps_ratio, closures_ratio : chi2 over what is expected, near 1 where information is right
                          (robust only; NaN where there is nothing to compare).
    """

    written: Path
    vertices: int
    steps: int
    closures: int
    left_out: Counter[str]
    chi2_start: float
    chi2: float
    degrees_of_freedom: int
    rejected: tuple[Rejection, ...] = ()
    scale: float = 1.0
    steps_ratio: float = float("nan")
    closures_ratio: float = float("nan")


def optimise_file(
    path_in: Path, path_out: Path, robust: bool, *, force: bool = False
) -> OptimiseReport:
    """Optimise the graph of one file and write it to another.

    robust : edges between vertices that don't follow each other in the file are suspects, and
             those that don't agree with the rest are left out of the file written.

    The form follows the suffix of ``path_out`` (.g2o; .graph or .toro), else it is g2o.
    Raises InputError for a file that can't be read, has no constraints, is not
    connected, or exists already.
    """
    from backend.graph import optimise  # noqa: PLC0415
    from backend.graph_arrays import first_nodes  # noqa: PLC0415
    from backend.pose_graph_files import (  # noqa: PLC0415
        PoseGraphFile,
        read_pose_graph,
        write_pose_graph,
    )
    from backend.robust import robust_optimise  # noqa: PLC0415

    if path_out.exists() and not force:
        raise InputError(
            "this file exists already",
            where=str(path_out),
            remedy="Give another one, or --force to replace it.",
        )
    graph = read_pose_graph(path_in)
    if not len(graph.constraints):
        raise InputError(
            "no edges (EDGE_SE2 or EDGE2) in it",
            where=str(path_in),
            remedy="Give a graph with constraints: there is nothing to optimise.",
        )
    parts = first_nodes(len(graph.node_ids), graph.constraints)
    if len(parts) > 1:
        raise InputError(
            f"no edges lead from vertex {graph.node_ids[0]} to vertex {graph.node_ids[parts[1]]}",
            where=f"{path_in}, line {graph.node_lines[parts[1]]}",
            remedy="Add an edge between them, or give the connected parts as files of their own.",
        )
    steps = _consecutive(graph.constraints)
    kept, found = graph.constraints, None
    start = pose_matrices(graph.nodes_xyyaw)
    if robust:
        known, loops = graph.constraints.pick(steps), graph.constraints.pick(~steps)
        found = robust_optimise(start, known, loops)
        chosen = steps.copy()
        chosen[~steps] = [verdict.kept for verdict in found.verdicts]
        kept, T_map_nodes = graph.constraints.pick(chosen), found.T_map_nodes
    else:
        T_map_nodes = optimise(start, kept, iterations=100).T_map_nodes
    nodes = xyyaw_rows(T_map_nodes)
    chi2_start, chi2 = (float(kept.chi2(xyyaw).sum()) for xyyaw in (graph.nodes_xyyaw, nodes))
    if not (np.isfinite(nodes).all() and np.isfinite((chi2_start, chi2)).all()):
        raise InputError(
            "the poses that its edges ask for can't be computed",
            where=str(path_in),
            remedy="Look for edges that contradict each other by far, or claim to be exact.",
        )
    form = SUFFIXES.get(path_out.suffix.lower(), "g2o")
    write_pose_graph(path_out, PoseGraphFile(graph.node_ids, nodes, kept), form)
    return OptimiseReport(
        written=path_out,
        vertices=len(nodes),
        steps=int(steps.sum()),
        closures=int((~steps).sum()),
        left_out=graph.left_out,
        chi2_start=chi2_start,
        chi2=chi2,
        degrees_of_freedom=3 * (len(kept) - len(nodes) + 1),
        rejected=() if found is None else _rejections(graph, ~steps, found),
        scale=1.0 if found is None else found.scale,
        steps_ratio=float("nan") if found is None else found.known_ratio,
        closures_ratio=float("nan") if found is None else found.loops_ratio,
    )


def print_report(report: OptimiseReport, console: Console) -> None:
    """A few lines for a person; the closures left out in a table, the worst first."""
    from rich.table import Table  # noqa: PLC0415

    console.print(
        f"{report.vertices} vertices, {report.steps} steps between consecutive ones, "
        f"{report.closures} closures"
    )
    for tag, count in sorted(report.left_out.items()):
        console.print(f"left out: {count} lines of kind {tag}", markup=False)
    console.print(
        f"chi2 {report.chi2_start:.6g} at the file's poses, {report.chi2:.6g} optimised, "
        f"{report.degrees_of_freedom} expected where information is right"
    )
    if np.isfinite(report.steps_ratio):
        console.print(
            f"residuals over expected: steps {report.steps_ratio:.2f}, "
            f"closures {report.closures_ratio:.2f}; covariances taken {report.scale:.1f} "
            "times as large as stated when judging closures"
        )
    if report.rejected:
        table = Table("from", "to", "chi2", "why it was left out")
        worst = sorted(report.rejected, key=lambda r: (-r.chi2, r.from_id, r.to_id))
        for rejection in worst[:REJECTED_SHOWN]:
            ends = (str(rejection.from_id), str(rejection.to_id))
            table.add_row(*ends, f"{rejection.chi2:.3g}", rejection.reason)
        console.print(f"{len(report.rejected)} closures left out:")
        console.print(table)
        if len(worst) > REJECTED_SHOWN:
            console.print(f"and {len(worst) - REJECTED_SHOWN} more")
    console.print(f"written: {report.written}", markup=False, soft_wrap=True)


def _consecutive(constraints: ConstraintArrays) -> Mask:
    steps: Mask = np.abs(constraints.from_nodes - constraints.to_nodes) == 1
    return steps


def _rejections(graph: PoseGraphFile, suspects: Mask, found: RobustResult) -> tuple[Rejection, ...]:
    a = graph.node_ids[graph.constraints.from_nodes[suspects]].tolist()
    b = graph.node_ids[graph.constraints.to_nodes[suspects]].tolist()
    return tuple(
        Rejection(i, j, verdict.chi2, verdict.reason)
        for i, j, verdict in zip(a, b, found.verdicts, strict=True)
        if not verdict.kept
    )
