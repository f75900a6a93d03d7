"""The run folder: everything a run leaves behind, written whole and read back."""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from datasets.errors import InputError, reading
from datasets.trajectory import Trajectory
from datasets.tum import read_tum, write_tum
from datasets.whole_folder import check_target, whole_folder
from datasets.yaml_file import MarkedYaml
from slam.mapping.layers import LayeredMap
from slam.mapping.map_set import write_map_set
from slam.mapping.occupancy import MapConfig
from slam.mapping.scan_store import ScanStore
from slam.runs.scan_files import read_scans, write_scans

TRAJECTORY = "trajectory.tum"
ODOMETRY = "odometry.tum"
GRAPH = "graph.g2o"
CONSTRAINTS = "constraints.csv"
METRICS = "metrics.json"
TIMING = "timing.json"
CONFIG = "config.yaml"
SCANS = "scans.npz"

LONGEST_JSON_BYTES = 20_000_000
"""A run of a day has metrics of a few megabytes."""
AGAIN = "Run 'slam run' on the recording again."

Cell = str | int | float | bool | None
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of one kind, as a CSV file holds them. Read back, every cell is text.

    Raises ValueError if a row has another length than the columns.
    """

    columns: tuple[str, ...]
    rows: Sequence[tuple[Cell, ...]]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a row of {len(row)} cells under {len(self.columns)} columns")


@dataclass(frozen=True, slots=True)
class Run:
    """What a run found, ready to be written.

    trajectory  : T_map_base of every scan's stamp.
    odometry    : as recorded, at its own stamps, T_odom_base in its own frame; None where the
                  recording has none. It is there for evaluation even if the run did not use it.
    scans       : de-skewed hits, so that the map can be drawn again without the recording.
    constraints : one row for each constraint and each search for a loop, refused ones included.
    write_graph : writes the pose graph as g2o to the path it is given.
    metrics, timing, config : plain data (numbers, text, lists, dicts); NaN and infinity are
                  written as null. ``timing`` alone may differ between two runs of the same input.
    partial     : the run was interrupted and holds what was mapped so far.
    """

    trajectory: Trajectory
    odometry: Trajectory | None
    scans: ScanStore
    constraints: Table
    write_graph: Callable[[Path], None]
    metrics: Mapping[str, Any]
    timing: Mapping[str, Any]
    config: Mapping[str, Any]
    partial: bool


def new_run_folder(results: Path, recording_name: str) -> Path:
    """The next free ``results/NAME-001``; nothing is made yet."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", recording_name).strip(".-") or "run"
    numbered = re.compile(rf"{re.escape(name)}-(\d{{3,}})")
    taken = [0]
    if results.is_dir():
        matches = (numbered.fullmatch(entry.name) for entry in results.iterdir())
        taken += [int(match[1]) for match in matches if match]
    return results / f"{name}-{max(taken) + 1:03d}"


def is_run_folder(folder: Path) -> bool:
    """Whether a run wrote this folder."""
    return all((folder / name).is_file() for name in (TRAJECTORY, METRICS, CONFIG))


def check_run_target(folder: Path, *, force: bool) -> None:
    """Raise InputError if a run could not be written to this folder: before the work, not after."""
    check_target(folder, force=force, replaceable=is_run_folder)


def write_run(
    folder: Path,
    run: Run,
    grid: LayeredMap,
    config: MapConfig,
    beside: Sequence[tuple[Trajectory, LayeredMap]] = (),
    *,
    force: bool = False,
) -> None:
    """Write a run folder, whole or not at all.

    beside : the other parts of a drive that fell apart, with map and trajectory of their own, in
             ``part-2``, ``part-3``, ...

    Raises InputError if the folder exists (unless ``force`` and a run wrote it) or cannot be
    written.
    """
    with whole_folder(folder, force=force, replaceable=is_run_folder) as staging:
        doubtful = [(doubt["x_m"], doubt["y_m"]) for doubt in run.metrics.get("doubts", ())]
        write_map_set(staging, grid, config, run.trajectory, doubtful)
        write_tum(staging / TRAJECTORY, run.trajectory)
        if run.odometry is not None:
            write_tum(staging / ODOMETRY, run.odometry)
        run.write_graph(staging / GRAPH)
        _write_table(staging / CONSTRAINTS, run.constraints)
        write_json(staging / METRICS, {"partial": run.partial, **run.metrics})
        write_json(staging / TIMING, run.timing)
        text = yaml.safe_dump(_plain(run.config), sort_keys=False, allow_unicode=True)
        (staging / CONFIG).write_text(text, encoding="utf-8")
        write_scans(staging / SCANS, run.scans)
        for number, (trajectory, drawn) in enumerate(beside, start=2):
            part = staging / f"part-{number}"
            part.mkdir()
            write_map_set(part, drawn, config, trajectory)
            write_tum(part / TRAJECTORY, trajectory)


def read_run(folder: Path) -> Run:
    """Read a run folder back. ``write_graph`` of the result copies the folder's graph.

    Raises InputError that names the file that is missing or damaged.
    """
    if not is_run_folder(folder):
        raise InputError(
            "no run wrote this folder" if folder.exists() else "there is no such folder",
            where=str(folder),
            remedy="Give a folder that 'slam run' wrote.",
        )
    metrics = _read(folder / METRICS, _read_mapping)
    odometry = folder / ODOMETRY
    return Run(
        trajectory=read_tum(folder / TRAJECTORY),
        odometry=read_tum(odometry) if odometry.exists() else None,
        scans=_read(folder / SCANS, read_scans),
        constraints=_read(folder / CONSTRAINTS, _read_table),
        write_graph=partial(shutil.copyfile, folder / GRAPH),
        metrics={key: value for key, value in metrics.items() if key != "partial"},
        timing=_read(folder / TIMING, _read_mapping),
        config=_read(folder / CONFIG, _read_mapping),
        partial=bool(metrics.get("partial", False)),
    )


def _plain(value: object) -> object:
    """The same data in the types that JSON and YAML have; what is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Plain data as JSON; NaN and infinity, which it doesn't have, become null."""
    text = json.dumps(_plain(data), indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def _write_table(path: Path, table: Table) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table.columns)
        writer.writerows([_plain(cell) for cell in row] for row in table.rows)


def _read(path: Path, reader: Callable[[Path], T]) -> T:
    with reading("cannot read this file of a run folder", where=str(path), remedy=AGAIN):
        return reader(path)


def _read_mapping(path: Path) -> dict[str, Any]:
    if path.suffix == ".json":
        if path.stat().st_size > LONGEST_JSON_BYTES:
            raise ValueError(f"longer than {LONGEST_JSON_BYTES} bytes")
        data = json.loads(path.read_text(encoding="utf-8"))
    else:
        data = MarkedYaml.read(path, "this file of a run folder", "", AGAIN).content
    if not isinstance(data, dict):
        raise ValueError("not a table of names and values")
    return data


def _read_table(path: Path) -> Table:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    if not rows:
        raise ValueError("the line of column names is missing")
    return Table(tuple(rows[0]), [tuple(row) for row in rows[1:]])
