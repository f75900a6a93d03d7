"""The run folder: written, read back, equal bytes, bad numbers, damage."""

from __future__ import annotations

import json
import math
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from datasets.errors import InputError
from datasets.trajectory import Trajectory
from slam.mapping.layers import draw_map
from slam.mapping.occupancy import MapConfig
from slam.mapping.scan_store import ScanStore
from slam.runs import run_folder
from slam.runs.run_folder import Run, Table, check_run_target, new_run_folder, read_run, write_run

STAMP_NS = 1_700_000_000_123_456_789


def write_graph(path: Path) -> None:
    path.write_text("VERTEX_SE2 0 0 0 0\n")


def make_run(**changes: Any) -> Run:  # noqa: ANN401
    rng = np.random.default_rng(11)
    stamps = STAMP_NS + np.arange(6) * 137_000_001
    fields: dict[str, Any] = {
        "trajectory": Trajectory(stamps, rng.uniform(-3, 3, (6, 3))),
        "odometry": Trajectory(stamps, rng.uniform(-3, 3, (6, 3))),
        "scans": ScanStore.from_scans(
            np.repeat(stamps, 2).tolist(),
            ["front", "back"] * 6,
            [rng.uniform(-5, 5, (n, 2)) for n in range(12)],
            {"front": (0.2, 0.0), "back": (-0.2, 0.1)},
        ),
        "constraints": Table(
            ("kind", "accepted", "score", "reason"),
            [("loop", True, 0.1, None), ("loop", False, math.nan, 'a "second", peak')],
        ),
        "write_graph": write_graph,
        "metrics": {"way_m": np.float64(12.5), "loops": np.int64(3), "bad": math.inf, "t": (1, 2)},
        "timing": {"match_s": 0.25},
        "config": {"map": MapConfig().model_dump(), "versions": {"numpy": "2"}, "nan": math.nan},
        "partial": False,
    }
    return Run(**{**fields, **changes})


def write(folder: Path, run: Run, *, force: bool = False) -> None:
    grid = draw_map(run.scans, run.trajectory, MapConfig())
    write_run(folder, run, grid, MapConfig(), force=force)


def test_a_run_reads_back_as_it_was(tmp_path: Path) -> None:
    run = make_run()
    write(tmp_path / "run", run)
    back = read_run(tmp_path / "run")
    np.testing.assert_array_equal(back.trajectory.stamps_ns, run.trajectory.stamps_ns)
    np.testing.assert_allclose(back.trajectory.matrices(), run.trajectory.matrices(), atol=1e-12)
    assert back.odometry is not None
    assert run.odometry is not None
    np.testing.assert_allclose(back.odometry.matrices(), run.odometry.matrices(), atol=1e-12)
    for name in ScanStore.__slots__:
        np.testing.assert_array_equal(getattr(back.scans, name), getattr(run.scans, name))
    assert back.constraints.columns == run.constraints.columns
    assert list(back.constraints.rows) == [
        ("loop", "True", "0.1", ""),
        ("loop", "False", "", 'a "second", peak'),
    ]
    assert back.metrics == {"way_m": 12.5, "loops": 3, "bad": None, "t": [1, 2]}
    assert back.timing == run.timing
    assert back.config == {**run.config, "nan": None}
    assert not back.partial
    back.write_graph(tmp_path / "copy.g2o")
    assert (tmp_path / "copy.g2o").read_text() == "VERTEX_SE2 0 0 0 0\n"


def test_the_folder_holds_all_its_files(tmp_path: Path) -> None:
    write(tmp_path / "run", make_run())
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [
        "config.yaml", "constraints.csv", "graph.g2o", "map.pgm", "map.png", "map.yaml",
        "metrics.json", "odometry.tum", "scans.npz", "timing.json", "trajectory.tum",
    ]  # fmt: skip


def test_the_same_run_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write(tmp_path / name, make_run())
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes(), path.name


def test_json_is_json_and_yaml_is_plain(tmp_path: Path) -> None:
    write(tmp_path / "run", make_run())

    def refuse(name: str) -> None:
        pytest.fail(f"{name} is no JSON")

    text = (tmp_path / "run" / "metrics.json").read_text()
    assert list(json.loads(text, parse_constant=refuse)) == [
        "partial",
        "way_m",
        "loops",
        "bad",
        "t",
    ]
    assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["map"]["hit_weight"] == 3


def test_a_partial_run_without_odometry_says_so(tmp_path: Path) -> None:
    write(tmp_path / "run", make_run(partial=True, odometry=None))
    back = read_run(tmp_path / "run")
    assert back.partial
    assert back.odometry is None
    assert not (tmp_path / "run" / "odometry.tum").exists()


def test_force_replaces_a_run_and_a_failing_graph_leaves_the_old(tmp_path: Path) -> None:
    def fail(path: Path) -> None:
        path.write_text("half")
        raise RuntimeError("no graph")

    folder = tmp_path / "run"
    write(folder, make_run(timing={"match_s": 1.0}))
    with pytest.raises(InputError, match="exists already"):
        write(folder, make_run())
    with pytest.raises(InputError, match="exists already"):
        check_run_target(folder, force=False)
    with pytest.raises(RuntimeError, match="no graph"):
        write(folder, make_run(write_graph=fail), force=True)
    assert read_run(folder).timing == {"match_s": 1.0}
    check_run_target(folder, force=True)
    write(folder, make_run(timing={"match_s": 2.0}), force=True)
    assert read_run(folder).timing == {"match_s": 2.0}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_new_folders_count_up_and_keep_to_results(tmp_path: Path) -> None:
    results = tmp_path / "results"
    assert new_run_folder(results, "intel") == results / "intel-001"
    for name in ("intel-001", "intel-007", "intel-x", "intel-2-009", "other-100"):
        (results / name).mkdir(parents=True)
    assert new_run_folder(results, "intel") == results / "intel-008"
    assert new_run_folder(results, "../my bag.db3") == results / "my-bag.db3-001"
    assert new_run_folder(results, "..") == results / "run-001"


def test_no_folder_and_foreign_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_run(tmp_path / "missing")
    with pytest.raises(InputError, match="no run wrote"):
        read_run(tmp_path)


NAMES = (run_folder.SCANS, run_folder.METRICS, run_folder.CONFIG, run_folder.TRAJECTORY)
DAMAGES = (b"", b"\x00\xff{[:", b"PK\x03\x04 short", b"[1, 2]")


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        *product(NAMES, DAMAGES),
        # Any line of text is a header of a table.
        *product([run_folder.CONSTRAINTS], (b"", b"\x00\xff{[:", b"a,b\n1,2,3\n")),
    ],
)
def test_a_damaged_file_is_named(tmp_path: Path, name: str, damage: bytes) -> None:
    write(tmp_path / "run", make_run())
    (tmp_path / "run" / name).write_bytes(damage)
    with pytest.raises(InputError) as caught:
        read_run(tmp_path / "run")
    assert name in caught.value.where


def test_a_table_refuses_rows_of_another_length() -> None:
    with pytest.raises(ValueError, match="3 cells under 2 columns"):
        Table(("a", "b"), [(1, 2, 3)])
