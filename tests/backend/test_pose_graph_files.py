"""Pose graph files: round trips, other people's reader, and errors that name their line."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.graph import optimise
from backend.graph_arrays import ConstraintArrays
from backend.pose_graph_files import Format, PoseGraphFile, read_pose_graph, write_pose_graph
from datasets.errors import InputError
from datasets.se2 import pose_matrices

FILES = (
    "CSAIL_P_toro.graph",
    "FRH_P_toro.graph",
    "input_INTEL_g2o.g2o",
    "input_M3500b_g2o.g2o",
    "input_MITb_g2o.g2o",
)


def some_graph(seed: int = 0, count: int = 12) -> PoseGraphFile:
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(count, 3, 3)) * (1.0, 10.0, 100.0)
    ends = np.array([rng.choice(count, 2, replace=False) for _ in range(count)])
    return PoseGraphFile(
        rng.permutation(100)[:count].astype(np.int64),
        rng.normal(size=(count, 3)),
        ConstraintArrays(
            ends[:, 0],
            ends[:, 1],
            rng.normal(size=(count, 3)),
            np.swapaxes(roots, 1, 2) @ roots,
        ),
    )


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_g2o_file_gives_back_the_same_bits(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    graph, path = some_graph(seed), tmp_path_factory.mktemp("g") / "a.g2o"
    write_pose_graph(path, graph, "g2o")
    again = read_pose_graph(path)
    for name in ("node_ids", "nodes_xyyaw"):
        np.testing.assert_array_equal(getattr(again, name), getattr(graph, name))
    for name in ("from_nodes", "to_nodes", "xyyaw"):
        ours, theirs = getattr(graph.constraints, name), getattr(again.constraints, name)
        np.testing.assert_array_equal(theirs, ours)
    upper = np.triu_indices(3)
    ours, theirs = graph.constraints.information, again.constraints.information
    np.testing.assert_array_equal(theirs[:, *upper], ours[:, *upper])


def test_a_toro_file_gives_back_the_same_graph(tmp_path: Path) -> None:
    graph = some_graph()
    write_pose_graph(tmp_path / "a.graph", graph, "toro")
    again = read_pose_graph(tmp_path / "a.graph")
    np.testing.assert_array_equal(again.nodes_xyyaw, graph.nodes_xyyaw)
    np.testing.assert_array_equal(again.constraints.xyyaw, graph.constraints.xyyaw)
    np.testing.assert_allclose(
        again.constraints.information, graph.constraints.information, rtol=1e-9, atol=1e-9
    )


def test_gtsam_reads_what_is_written_with_the_same_residuals(tmp_path: Path) -> None:
    import gtsam

    graph = some_graph()
    graph = PoseGraphFile(np.arange(12), graph.nodes_xyyaw, graph.constraints)
    write_pose_graph(tmp_path / "a.g2o", graph, "g2o")
    factors, values = gtsam.readG2o(str(tmp_path / "a.g2o"))
    assert values.size() == 12
    theirs = [2.0 * factors.at(i).error(values) for i in range(factors.size())]
    np.testing.assert_allclose(theirs, graph.constraints.chi2(graph.nodes_xyyaw), rtol=1e-6)


def test_toro_information_is_in_the_axes_of_the_from_node(tmp_path: Path) -> None:
    """A step along map x that ends turned by 90 deg: TORO's x is the to-node's -y."""
    path = tmp_path / "a.graph"
    path.write_text(
        "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 1.5707963267948966\n"
        "EDGE2 0 1 1 0 1.5707963267948966 4 0.5 9 16 0.1 0.2\n"
    )
    information = read_pose_graph(path).constraints.information[0]
    expected = [[9.0, -0.5, 0.2], [-0.5, 4.0, -0.1], [0.2, -0.1, 16.0]]
    np.testing.assert_allclose(information, expected, atol=1e-12)


@pytest.mark.parametrize("name", [name for name in FILES if "M3500" not in name])
def test_recorded_graphs_are_weak_along_their_motion(shared_data: Path, name: str) -> None:
    """Odometry is least sure along the way: that shows in whose axes an information is given."""
    constraints = read_pose_graph(shared_data / "posegraphs" / name).constraints
    values, vectors = np.linalg.eigh(constraints.information[:, :2, :2])
    z = constraints.xyyaw
    clear = (values[:, 1] > 1.2 * values[:, 0]) & (np.hypot(z[:, 0], z[:, 1]) > 0.02)
    assert clear.sum() > 500
    axis = np.arctan2(vectors[clear, 1, 0], vectors[clear, 0, 0])
    motion_in_to = np.arctan2(z[clear, 1], z[clear, 0]) - z[clear, 2]
    off = np.abs((axis - motion_in_to + np.pi / 2) % np.pi - np.pi / 2)
    assert np.median(off) < 1e-5


@pytest.mark.parametrize(
    ("name", "chi2"),
    list(zip(FILES, (40.551, 0.00019, 215.838, 2055.4, 41.207), strict=True)),
)
def test_recorded_graphs_are_optimised(shared_data: Path, name: str, chi2: float) -> None:
    """Each from its file's poses, which are the odometry: the least known error is reached."""
    graph = read_pose_graph(shared_data / "posegraphs" / name)
    assert not graph.left_out
    result = optimise(pose_matrices(graph.nodes_xyyaw), graph.constraints)
    assert result.converged
    assert result.chi2 == pytest.approx(chi2, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize("form", ["g2o", "toro"])
@pytest.mark.parametrize("name", FILES[1:3])
def test_recorded_graphs_survive_both_forms(
    shared_data: Path, tmp_path: Path, name: str, form: Format
) -> None:
    graph = read_pose_graph(shared_data / "posegraphs" / name)
    write_pose_graph(tmp_path / "again", graph, form)
    again = read_pose_graph(tmp_path / "again")
    np.testing.assert_array_equal(again.node_ids, graph.node_ids)
    np.testing.assert_array_equal(again.constraints.xyyaw, graph.constraints.xyyaw)
    np.testing.assert_allclose(
        again.constraints.information, graph.constraints.information, rtol=1e-6, atol=1e-3
    )


def test_comments_and_other_lines_are_passed_over_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(
        "# a comment\n\nEDGE_SE2 7 3 1 0 0 1 0 0 1 0 1  # before its vertices\n"
        "VERTEX_SE2 7 0 0 0\nVERTEX_SE2 3 1 0 0\nFIX 7\nVERTEX_XY 9 1 1\nVERTEX_XY 8 1 1\n"
    )
    graph = read_pose_graph(path)
    assert graph.left_out == {"FIX": 1, "VERTEX_XY": 2}
    assert graph.node_ids.tolist() == [7, 3]
    assert graph.constraints.from_nodes.tolist() == [0]
    assert graph.constraints.to_nodes.tolist() == [1]


GOOD = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n"


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("", "", "no planar vertices"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", "", "no planar vertices"),
        (GOOD + "VERTEX_SE2 1 1 0 0\n", ", line 3", "twice"),
        (GOOD + "EDGE_SE2 0 5 1 0 0 1 0 0 1 0 1\n", ", line 3", "vertex 5"),
        (GOOD + "EDGE_SE2 1 1 1 0 0 1 0 0 1 0 1\n", ", line 3", "itself"),
        (GOOD + "\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0\n", ", line 4", "9 finite numbers"),
        (GOOD + "EDGE_SE2 0 1 1 0 nan 1 0 0 1 0 1\n", ", line 3", "9 finite numbers"),
        (GOOD + "EDGE_SE2 0 1 1 0 0 1 0 0 -1 0 1\n", ", line 3", "negative eigenvalue"),
        ("VERTEX_SE2 zero 0 0 0\n", ", line 1", "no vertex number"),
        ("VERTEX_SE2\n", ", line 1", "no vertex number"),
    ],
)
def test_what_is_wrong_is_told_with_file_and_line(
    tmp_path: Path, text: str, where: str, what: str
) -> None:
    path = tmp_path / "bad.g2o"
    path.write_text(text)
    with pytest.raises(InputError, match=what) as caught:
        read_pose_graph(path)
    assert caught.value.where == f"{path}{where}"
    assert caught.value.remedy.endswith(".")


@given(st.binary(max_size=200))
@settings(max_examples=60, deadline=None)
def test_any_bytes_give_a_graph_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    path = tmp_path_factory.mktemp("g") / "any"
    path.write_bytes(b"VERTEX_SE2 0 0 0 0\n" + data)
    with contextlib.suppress(InputError):  # the only error allowed
        assert len(read_pose_graph(path).node_ids) >= 1


def test_a_missing_file_and_an_unwritable_place_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_pose_graph(tmp_path / "none.g2o")
    with pytest.raises(InputError, match="cannot be written"):
        write_pose_graph(tmp_path / "no folder" / "a.g2o", some_graph(), "g2o")
    assert not list(tmp_path.iterdir())
