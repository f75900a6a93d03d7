"""Pose graphs in files: g2o (VERTEX_SE2, EDGE_SE2) and TORO (VERTEX2, EDGE2), both ways.

The two differ in more than tags. g2o writes the information's upper triangle xx xy xt yy yt tt in
the axes of the to-node, as ``Constraint`` has it. TORO writes xx xy yy tt xt yt in the axes of
the *from*-node: in the TORO files of the literature the weak axis lies along the measured motion
to 1e-10 rad, in the g2o files to 1e-7 after turning by the measured yaw. Other readers reorder
the numbers and forget to turn them.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from backend.graph_arrays import ConstraintArrays, Indices
from datasets.bounds import FARTHEST_M, LARGEST_INFORMATION, LARGEST_RAD
from datasets.errors import InputError, reading
from datasets.messages import Array
from datasets.se2 import pose_matrices

Format = Literal["g2o", "toro"]

VERTEX_TAGS = ("VERTEX_SE2", "VERTEX2")
EDGE_TAGS = ("EDGE_SE2", "EDGE2")
# Where each of the six numbers belongs.
G2O_ORDER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
TORO_ORDER = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))


@dataclass(frozen=True, slots=True)
class PoseGraphFile:
    """A pose graph as a file holds it.

    node_ids    : (N,) int64, the file's own numbers, in the file's order.
    nodes_xyyaw : (N, 3) float64, poses in the map: m, m, rad.
    constraints : between rows of ``nodes_xyyaw``, not between ids.
    left_out    : lines that say something else, by tag.
    node_lines  : (N,) int64, the lines of the nodes in the file; empty where it was not read.
    """

    node_ids: Indices
    nodes_xyyaw: Array
    constraints: ConstraintArrays
    left_out: Counter[str] = field(default_factory=Counter)
    node_lines: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


def read_pose_graph(path: Path) -> PoseGraphFile:
    """Read a g2o or TORO file; the tags tell which, line by line.

    Comments (#) are passed over; other lines (FIX, landmarks) are left out and counted.
    Raises InputError naming file and line for anything that can't be read as it stands, numbers out
    of range among it.
    """
    ids: dict[int, int] = {}
    nodes: list[list[float]] = []
    node_lines: list[int] = []
    ends: list[tuple[int, int, int]] = []
    edges: list[list[float]] = []
    toro: list[bool] = []
    left_out: Counter[str] = Counter()
    for line, words in _lines(path):
        tag = words[0]
        if tag in VERTEX_TAGS:
            number = _integer(path, line, words, 1)
            if number in ids:
                raise _error(path, line, f"vertex {number} is there twice", "Remove one of them.")
            ids[number] = len(ids)
            nodes.append(_floats(path, line, words, 2, 3))
            node_lines.append(line)
        elif tag in EDGE_TAGS:
            ends.append(
                (_integer(path, line, words, 1), _integer(path, line, words, 2), line),
            )
            edges.append(_floats(path, line, words, 3, 9))
            toro.append(tag == "EDGE2")
        else:
            left_out[tag] += 1
    if not nodes:
        raise InputError(
            "no planar vertices (VERTEX_SE2 or VERTEX2) in it",
            where=str(path),
            remedy="Give a g2o or TORO file of a planar pose graph.",
        )
    constraints = _constraints(path, ids, ends, np.array(edges).reshape(-1, 9), np.array(toro))
    return PoseGraphFile(
        np.array(list(ids), dtype=np.int64),
        np.array(nodes),
        constraints,
        left_out,
        np.array(node_lines, dtype=np.int64),
    )


def write_pose_graph(path: Path, graph: PoseGraphFile, form: Format) -> None:
    """Write a graph, whole or not at all. Reading it again gives the same numbers.

    g2o to the last bit; TORO's information to rounding, as it is turned to other axes.
    """
    order = G2O_ORDER if form == "g2o" else TORO_ORDER
    vertex, edge = ("VERTEX_SE2", "EDGE_SE2") if form == "g2o" else ("VERTEX2", "EDGE2")
    constraints = graph.constraints
    information = constraints.information
    if form == "toro":
        information = _turned(information, -constraints.xyyaw[:, 2])
    rows, columns = (list(axis) for axis in zip(*order, strict=True))
    lines = [
        " ".join([vertex, str(number), *map(repr, pose)])
        for number, pose in zip(graph.node_ids.tolist(), graph.nodes_xyyaw.tolist(), strict=True)
    ]
    lines += [
        " ".join([edge, str(a), str(b), *map(repr, pose), *map(repr, six)])
        for a, b, pose, six in zip(
            graph.node_ids[constraints.from_nodes].tolist(),
            graph.node_ids[constraints.to_nodes].tolist(),
            constraints.xyyaw.tolist(),
            information[:, rows, columns].tolist(),
            strict=True,
        )
    ]
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        unfinished.write_text("\n".join(lines) + "\n", encoding="ascii")
        unfinished.replace(path)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise InputError(
            f"cannot be written ({error.strerror})",
            where=str(path),
            remedy="Give a place that can be written to.",
        ) from error


def _constraints(
    path: Path,
    ids: dict[int, int],
    ends: list[tuple[int, int, int]],
    edges: Array,
    toro: Array,
) -> ConstraintArrays:
    for a, b, line in ends:
        for number in (a, b):
            if number not in ids:
                what = f"an edge names vertex {number}, which is not in the file"
                raise _error(path, line, what, "Add the vertex or remove the edge.")
        if a == b:
            raise _error(path, line, "an edge joins a vertex to itself", "Remove the edge.")
    information = np.zeros((len(ends), 3, 3))
    for form, order in ((toro == 0, G2O_ORDER), (toro == 1, TORO_ORDER)):
        chosen = np.flatnonzero(form)
        for column, (i, j) in enumerate(order, start=3):
            information[chosen, i, j] = information[chosen, j, i] = edges[chosen, column]
    yaws_rad = np.where(toro == 1, edges[:, 2], 0.0)
    information = np.where((toro == 1)[:, None, None], _turned(information, yaws_rad), information)
    lowest = np.linalg.eigvalsh(information)
    bad = np.flatnonzero(lowest[:, 0] < -1e-6 * np.abs(lowest).max(axis=1))
    if bad.size:
        what = f"the information of an edge has the negative eigenvalue {lowest[bad[0], 0]:g}"
        remedy = "Information must be positive semi-definite: check the order of its six numbers."
        raise _error(path, ends[bad[0]][2], what, remedy)
    return ConstraintArrays(
        np.array([ids[a] for a, _, _ in ends], dtype=np.int64),
        np.array([ids[b] for _, b, _ in ends], dtype=np.int64),
        edges[:, :3].copy(),
        information,
    )


def _turned(information: Array, yaws_rad: Array) -> Array:
    """Information in axes that are turned by the yaws against the present ones."""
    turns = pose_matrices(np.column_stack([np.zeros((len(yaws_rad), 2)), yaws_rad]))
    turned: Array = np.swapaxes(turns, 1, 2) @ information @ turns
    return 0.5 * (turned + np.swapaxes(turned, 1, 2))


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    with (
        reading("cannot be read", where=str(path), remedy="Give a g2o or TORO file."),
        path.open(encoding="ascii") as file,
    ):
        for line, text in enumerate(file, start=1):
            words = text.split("#", 1)[0].split()
            if words:
                yield line, words


def _integer(path: Path, line: int, words: list[str], at: int) -> int:
    try:
        number = int(words[at])
    except (ValueError, IndexError):
        what = f"{words[0]} has no vertex number at word {at + 1}"
        raise _error(path, line, what, "Correct or remove the line.") from None
    if not -(2**63) <= number < 2**63:
        raise _error(path, line, f"vertex number {number} is out of range", "Number from 0.")
    return number


def _floats(path: Path, line: int, words: list[str], first: int, count: int) -> list[float]:
    given = words[first:]
    try:
        numbers = [float(word) for word in given]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        what = f"{words[0]} needs {count} finite numbers after its vertex, not {' '.join(given)!r}"
        raise _error(path, line, what, "Correct or remove the line.")
    limits = [FARTHEST_M, FARTHEST_M, LARGEST_RAD, *[LARGEST_INFORMATION] * 6]
    for number, limit in zip(numbers, limits, strict=False):
        if abs(number) > limit:
            what = f"{words[0]} has the number {number:g}, which is out of range"
            raise _error(path, line, what, "Correct or remove the line.")
    return numbers


def _error(path: Path, line: int, what: str, remedy: str) -> InputError:
    return InputError(what, where=f"{path}, line {line}", remedy=remedy)
