"""A pose graph's file optimised into another: what is written, told and refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from backend.graph_arrays import ConstraintArrays, joined
from backend.pose_graph_files import PoseGraphFile, read_pose_graph, write_pose_graph
from datasets.errors import InputError
from datasets.se2 import between
from slam.runs.optimise import optimise_file, print_report


def square(tmp_path: Path) -> Path:
    """Two laps of eight vertices, ids from 100, a bad start, good closures and a false one."""
    corners = [(0, 0, 0), (1, 0, 0), (2, 0, 1.57), (2, 1, 1.57)]
    corners += [(2, 2, 3.14), (1, 2, 3.14), (0, 2, -1.57), (0, 1, -1.57)]
    truth = np.array(corners * 2, dtype=float)
    a = np.concatenate([np.arange(15), np.arange(8)])
    b = np.concatenate([np.arange(1, 16), np.arange(8) + 8])
    information = np.tile(np.diag([400.0, 400.0, 1e4]), (len(a), 1, 1))
    right = ConstraintArrays(a, b, between(truth[a], truth[b]), information)
    wrong = ConstraintArrays(
        np.array([2]), np.array([13]), np.array([[0.5, -0.4, 0.3]]), information[:1]
    )
    start = truth + np.random.default_rng(0).normal(0.0, 0.1, truth.shape)
    start[0] = truth[0]
    path = tmp_path / "in.g2o"
    graph = PoseGraphFile(np.arange(100, 116), start, joined(right, wrong))
    write_pose_graph(path, graph, "g2o")
    with path.open("a") as file:
        file.write("FIX 100\n")
    return path


def test_a_false_closure_is_left_out_and_told(tmp_path: Path) -> None:
    report = optimise_file(square(tmp_path), tmp_path / "out.g2o", robust=True)
    assert [(r.from_id, r.to_id) for r in report.rejected] == [(102, 113)]
    assert (report.vertices, report.steps, report.closures) == (16, 15, 9)
    assert report.left_out == {"FIX": 1}
    assert report.chi2 < 1e-3 < report.chi2_start
    assert report.degrees_of_freedom == 3 * 8
    written = read_pose_graph(tmp_path / "out.g2o")
    assert len(written.constraints) == 23
    assert written.node_ids.tolist() == list(range(100, 116))
    np.testing.assert_allclose(written.nodes_xyyaw[4, :2], (2, 2), atol=1e-3)

    console = Console(record=True, width=100)
    print_report(report, console)
    text = console.export_text()
    assert "1 closures left out" in text
    assert "FIX" in text
    assert "out.g2o" in text


def test_without_robust_every_closure_counts(tmp_path: Path) -> None:
    report = optimise_file(square(tmp_path), tmp_path / "out.graph", robust=False)
    assert report.rejected == ()
    assert report.chi2 > 10.0
    assert (tmp_path / "out.graph").read_text().startswith("VERTEX2 100 ")
    assert len(read_pose_graph(tmp_path / "out.graph").constraints) == 24


def test_what_cannot_be_done_is_refused_and_nothing_written(tmp_path: Path) -> None:
    path = square(tmp_path)
    (tmp_path / "there.g2o").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        optimise_file(path, tmp_path / "there.g2o", robust=True)
    assert (tmp_path / "there.g2o").read_text() == "mine"
    (tmp_path / "empty.g2o").write_text("VERTEX_SE2 0 0 0 0\n")
    with pytest.raises(InputError, match="no edges"):
        optimise_file(tmp_path / "empty.g2o", tmp_path / "out.g2o", robust=True)
    assert not (tmp_path / "out.g2o").exists()


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize(
    ("before", "after", "line", "what"),
    [
        ("VERTEX_SE2 103 ", "VERTEX_SE2 103 nan ", 4, "finite"),
        ("VERTEX_SE2 103 ", "VERTEX_SE2 103 1e308 ", 4, "out of range"),
        ("EDGE_SE2 100 101 ", "EDGE_SE2 100 101 1e200 ", 17, "out of range"),
        ("EDGE_SE2 100 101 ", "EDGE_SE2 100 101 inf ", 17, "finite"),
        ("EDGE_SE2 100 101 ", "EDGE_SE2 100 101 1 0 0 1e308", 17, "out of range"),
    ],
)
def test_numbers_out_of_range_are_refused_with_their_line(
    tmp_path: Path, before: str, after: str, line: int, what: str, robust: bool
) -> None:
    path = square(tmp_path)
    lines = path.read_text().splitlines()
    changed = next(k for k, each in enumerate(lines) if each.startswith(before))
    head = after.split()
    lines[changed] = " ".join([*head, *lines[changed].split()[len(head) :]])
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=what) as caught:
        optimise_file(path, tmp_path / "out.g2o", robust=robust)
    assert caught.value.where == f"{path}, line {line}"
    assert not (tmp_path / "out.g2o").exists()


@pytest.mark.parametrize("robust", [False, True])
def test_vertices_that_no_edge_joins_to_the_others_are_refused(
    tmp_path: Path, robust: bool
) -> None:
    path = tmp_path / "two.g2o"
    edge = "0 0 1 0 0 1 0 1\n"
    path.write_text(
        "VERTEX_SE2 7 0 0 0\n# a comment\nVERTEX_SE2 8 1 0 0\nVERTEX_SE2 9 1 0 0\n"
        f"VERTEX_SE2 10 2 0 0\nEDGE_SE2 7 8 1 {edge}EDGE_SE2 9 10 1 {edge}"
    )
    with pytest.raises(InputError, match="no edges lead from vertex 7 to vertex 9") as caught:
        optimise_file(path, tmp_path / "out.g2o", robust=robust)
    assert caught.value.where == f"{path}, line 4"


def test_closures_that_claim_to_be_exact_are_no_fault(tmp_path: Path) -> None:
    """Their covariance is zero to rounding, and so is that of the cycles through them."""
    path = square(tmp_path)
    path.write_text(path.read_text().replace("400.0", "1e18").replace("10000.0", "1e18"))
    report = optimise_file(path, tmp_path / "out.g2o", robust=True)
    assert np.isfinite(report.chi2)


@pytest.mark.parametrize("name", ["input_INTEL_g2o.g2o", "CSAIL_P_toro.graph"])
def test_recorded_graphs_lose_no_closure(shared_data: Path, tmp_path: Path, name: str) -> None:
    report = optimise_file(shared_data / "posegraphs" / name, tmp_path / name, robust=True)
    assert report.rejected == ()
    assert report.chi2 < report.degrees_of_freedom < report.chi2_start
    again = optimise_file(tmp_path / name, tmp_path / ("again" + name), robust=False)
    assert again.chi2_start == pytest.approx(report.chi2, rel=1e-6)
    assert again.chi2 == pytest.approx(report.chi2, rel=1e-3)
