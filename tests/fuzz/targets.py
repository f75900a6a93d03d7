"""What reads each kind of input, as the commands do."""

from __future__ import annotations

from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import Final

from rich.console import Console

from datasets.calibration_file import read_calibration_file
from datasets.open_recording import open_recording
from datasets.options import ReadOptions
from datasets.relations_file import read_relations
from datasets.simulation.place import load_drive, load_place
from datasets.tum import read_tum
from slam.checks.check import check_recording, print_report
from slam.commands.evaluate import read_ground_truth
from slam.config import load_config
from slam.evaluation.structures_file import read_structures
from slam.runs.evaluate import evaluate_run
from slam.runs.export import export_run
from slam.runs.optimise import optimise_file
from slam.runs.run_folder import read_run


def _check(path: Path, way: int) -> None:
    report = check_recording(open_recording([path], ReadOptions(salvage=way % 2 == 1)))
    shown = StringIO()
    print_report(report, Console(file=shown, width=200))
    if "\x1b" in shown.getvalue():
        raise AssertionError("an escape reaches the terminal")


def _bag(path: Path, way: int) -> None:
    if way % 8 == 7:
        read_ground_truth(f"{path}:/ground_truth")
    else:
        _check(path, way)


def _graph(path: Path, way: int) -> None:
    optimise_file(path, path.with_name("out.g2o"), way % 2 == 1, force=True)


def _run(path: Path, way: int) -> None:
    folder = path.parent
    run = read_run(folder)
    if way % 4 == 1:
        export_run(folder, folder.with_name("out"), force=True)
    elif way % 4 == 2:
        evaluate_run(folder, None, run.trajectory, 0.0)


READERS: Final[dict[str, Callable[[Path, int], object]]] = {
    "bag": _bag,
    "folder": lambda path, way: _check(path.parent, way),
    "log": _check,
    "calibration": lambda path, way: read_calibration_file(path),
    "config": lambda path, way: load_config(path, ["map.resolution_m=0.1"][: way % 2]),
    "place": lambda path, way: load_place(path),
    "drive": lambda path, way: load_drive(path, load_place("room")),
    "structures": lambda path, way: read_structures(path),
    "tum": lambda path, way: read_tum(path),
    "relations": lambda path, way: read_relations(path),
    "graph": _graph,
    "run": _run,
}
"""By kind of sample; ``way`` chooses among the ways in which a kind is read."""
