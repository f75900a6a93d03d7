"""Maps written again from a run folder, and turned onto their walls."""

from __future__ import annotations

import gzip
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from datasets.errors import InputError
from datasets.se2 import inverse, se2, transform
from datasets.trajectory import Trajectory
from datasets.tum import read_tum
from slam.mapping.layers import draw_map
from slam.mapping.occupancy import OCCUPIED, MapConfig
from slam.mapping.scan_store import ScanStore
from slam.runs.export import export_run
from slam.runs.run_folder import Run, Table, read_run, write_run

TURN_RAD = math.radians(17.3)


@pytest.fixture(scope="module")
def run_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An L-shaped room of 8 m x 5 m, seen from 20 places by two lidars, turned by 17.3 deg."""
    corners = [(0, 0), (8, 0), (8, 2), (3, 2), (3, 5), (0, 5), (0, 0)]
    walls = np.vstack([np.linspace(a, b, 200) for a, b in pairwise(corners)])
    walls_map = transform(se2(1.0, -2.0, TURN_RAD), walls)
    rows, points = [], []
    for k in range(20):
        x_m, y_m = transform(se2(1.0, -2.0, TURN_RAD), np.array([[0.5 + 0.1 * k, 1.0]]))[0]
        rows.append((x_m, y_m, 0.3 * k))
        part = walls_map[walls[:, 0] <= 3] if k % 2 else walls_map[walls[:, 1] <= 2]
        points.append(transform(inverse(se2(*rows[-1])), part))
    # Somebody stood at (2.5, 0.5) of the room during the first scan.
    person_map = transform(se2(1.0, -2.0, TURN_RAD), np.array([[2.5, 0.5]]))
    points[0] = np.vstack([points[0], transform(inverse(se2(*rows[0])), person_map)])
    stamps = np.arange(20) * 10**8
    trajectory = Trajectory(stamps, np.array(rows))
    run = Run(
        trajectory=trajectory,
        odometry=None,
        scans=ScanStore.from_scans(
            stamps.tolist(), ["a", "b"] * 10, points, {"a": (0.1, 0.0), "b": (-0.1, 0.0)}
        ),
        constraints=Table(("kind",), []),
        write_graph=lambda path: path.touch(),
        metrics={},
        timing={},
        config={"config": {"map": {"resolution_m": 0.1}}},
        partial=False,
    )
    folder = tmp_path_factory.mktemp("results") / "run"
    config = MapConfig(resolution_m=0.1)
    write_run(folder, run, draw_map(run.scans, trajectory, config), config)
    return folder


def occupied_points(folder: Path) -> tuple[np.ndarray, float]:
    """Middles of occupied cells in the map, (N, 2) m, as map_server places them; cell side."""
    meta = yaml.safe_load((folder / "map.yaml").read_text())
    image = np.asarray(Image.open(folder / meta["image"]))[::-1]
    rows, columns = np.nonzero(image == 0)
    cells = np.column_stack([columns, rows]) + 0.5
    return np.array(meta["origin"][:2]) + cells * meta["resolution"], meta["resolution"]


def test_exported_unchanged_it_is_the_runs_map(run_path: Path, tmp_path: Path) -> None:
    done = export_run(run_path, tmp_path / "out")
    assert done.walls is None
    assert done.grid.resolution_m == 0.1, "as the run had it"
    for name in ("map.pgm", "map.yaml", "map.png"):
        assert (tmp_path / "out" / name).read_bytes() == (run_path / name).read_bytes()
    np.testing.assert_allclose(
        read_tum(tmp_path / "out" / "trajectory.tum").xyyaw,
        read_tum(run_path / "trajectory.tum").xyyaw,
        atol=1e-12,
    )


def test_resolution_and_thresholds_are_obeyed(run_path: Path, tmp_path: Path) -> None:
    export_run(run_path, tmp_path / "fine", resolution_m=0.025)
    points, side = occupied_points(tmp_path / "fine")
    assert side == 0.025
    room = transform(inverse(se2(1.0, -2.0, TURN_RAD)), points)
    assert room.min(axis=0) == pytest.approx((0.0, 0.0), abs=0.03)
    assert room.max(axis=0) == pytest.approx((8.0, 5.0), abs=0.03)
    assert not ((room > (3.1, 2.1)).all(axis=1)).any(), "the notch is upper right"
    export_run(run_path, tmp_path / "eager", occupied_threshold=0.1, free_threshold=0.05)
    eager, strict = (
        transform(inverse(se2(1.0, -2.0, TURN_RAD)), occupied_points(folder)[0])
        for folder in (tmp_path / "eager", run_path)
    )
    assert np.hypot(*(eager - (2.5, 0.5)).T).min() < 0.1, "once seen is enough for this map"
    assert np.hypot(*(strict - (2.5, 0.5)).T).min() > 0.3, "the run's own map erased the person"


def test_aligned_walls_lie_along_the_axes_and_the_trajectory_turns_alike(
    run_path: Path, tmp_path: Path
) -> None:
    done = export_run(run_path, tmp_path / "out", align_walls=True, resolution_m=0.05)
    assert done.walls is not None
    assert math.degrees(done.walls.yaw_rad) == pytest.approx(17.3, abs=0.1)
    points, _ = occupied_points(tmp_path / "out")
    corner_turned = transform(se2(0.0, 0.0, -TURN_RAD), np.array([[1.0, -2.0]]))[0]
    room = points - corner_turned
    on_a_wall = np.zeros(len(room), bool)
    for axis, value in ((0, 0.0), (0, 3.0), (0, 8.0), (1, 0.0), (1, 2.0), (1, 5.0)):
        on_a_wall |= np.abs(room[:, axis] - value) < 0.06
    assert on_a_wall.all()
    before, after = read_run(run_path).trajectory, read_tum(tmp_path / "out" / "trajectory.tum")
    expected = se2(0.0, 0.0, -done.walls.yaw_rad) @ before.matrices()
    np.testing.assert_allclose(after.matrices(), expected, atol=1e-9)


def test_the_run_folder_is_never_replaced_by_an_export(run_path: Path, tmp_path: Path) -> None:
    before = sorted(path.name for path in run_path.iterdir())
    with pytest.raises(InputError, match="not replaced"):
        export_run(run_path, run_path, force=True)
    with pytest.raises(InputError, match="not replaced"):
        export_run(run_path, run_path.parent, force=True)
    assert sorted(path.name for path in run_path.iterdir()) == before
    export_run(run_path, tmp_path / "out")
    with pytest.raises(InputError, match="exists already"):
        export_run(run_path, tmp_path / "out")
    export_run(run_path, tmp_path / "out", resolution_m=0.2, force=True)
    assert occupied_points(tmp_path / "out")[1] == 0.2


def test_a_run_of_several_layers_exports_them_all_or_one(run_path: Path, tmp_path: Path) -> None:
    """The two lidars as two layers: one saw the short leg of the L, the other the long one."""
    run = read_run(run_path)
    layered = replace(run, scans=replace(run.scans, layers=("lidar 0.10 m", "lidar 2.00 m")))
    config = MapConfig(resolution_m=0.1)
    write_run(tmp_path / "run", layered, draw_map(layered.scans, run.trajectory, config), config)
    done = export_run(tmp_path / "run", tmp_path / "all")
    assert list(done.grid.layers) == ["lidar 0.10 m", "lidar 2.00 m"]
    maps = sorted(path.name for path in (tmp_path / "all").glob("map*"))
    assert len(maps) == 8
    for name in maps:
        assert (tmp_path / "all" / name).read_bytes() == (tmp_path / "run" / name).read_bytes()
    export_run(tmp_path / "run", tmp_path / "low", layer="lidar 0.10 m")
    assert sorted(path.name for path in (tmp_path / "low").iterdir()) == [
        "map.pgm", "map.png", "map.yaml", "trajectory.tum",
    ]  # fmt: skip
    for name in ("map.pgm", "map.yaml"):
        own = (tmp_path / "run" / name.replace("map", "map_lidar-0.10-m")).read_bytes()
        alone = (tmp_path / "low" / name).read_bytes()
        assert alone == own.replace(b"map_lidar-0.10-m.pgm", b"map.pgm")
    low, both = (
        {tuple(np.round(p, 6)) for p in occupied_points(tmp_path / name)[0]}
        for name in ("low", "all")
    )
    assert low < both
    with pytest.raises(InputError, match=r"no layer 'camera'.*'lidar 0.10 m', 'lidar 2.00 m'"):
        export_run(tmp_path / "run", tmp_path / "out", layer="camera")
    assert not (tmp_path / "out").exists()


def test_impossible_wishes_are_input_errors(
    run_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="resolution_m"):
        export_run(run_path, tmp_path / "out", resolution_m=-1.0)
    with pytest.raises(InputError, match="free_threshold"):
        export_run(run_path, tmp_path / "out", free_threshold=0.9)
    monkeypatch.setattr("slam.mapping.occupancy.MAX_CELLS", 100_000)
    with pytest.raises(InputError, match=r"too large.*0\.04"):
        export_run(run_path, tmp_path / "out", resolution_m=0.01)
    assert not (tmp_path / "out").exists()


def test_a_minute_of_a_real_building(shared_data: Path, tmp_path: Path) -> None:
    """fr079 at its raw odometry: the walls are found, and stay where turning puts them."""
    stamps, rows, points = [], [], []
    bearings = np.deg2rad(-90.0 + 0.5 * np.arange(360))
    with gzip.open(shared_data / "recordings" / "fr079.log.gz", "rt") as log:
        for line in log:
            words = line.split()
            if words and words[0] == "FLASER" and len(stamps) < 150:
                ranges = np.array(words[2:362], float)
                xy = ranges[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
                points.append(xy[ranges < 80.0] + (-0.04, 0.0))
                rows.append([float(word) for word in words[362:365]])
                stamps.append(round(float(words[-1]) * 1e9))
    trajectory = Trajectory(np.array(stamps), np.array(rows))
    scans = ScanStore.from_scans(stamps, ["front"] * 150, points, {"front": (-0.04, 0.0)})
    config = MapConfig()
    grid = draw_map(scans, trajectory, config)
    run = Run(
        trajectory, trajectory, scans, Table(("kind",), []), lambda path: path.touch(), {}, {},
        {"config": {"map": config.model_dump()}}, False,
    )  # fmt: skip
    write_run(tmp_path / "run", run, grid, config)
    occupied = int((grid.classes(config) == OCCUPIED).sum())
    assert 500 < occupied < 10_000
    first = export_run(tmp_path / "run", tmp_path / "aligned", align_walls=True)
    assert first.walls is not None
    assert first.walls.contrast > 1.2
    assert len(occupied_points(tmp_path / "aligned")[0]) == pytest.approx(occupied, rel=0.2)
