"""``slam evaluate``: a run compared with what is known."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from datasets.whole_file import write_whole
from slam.commands import options

if TYPE_CHECKING:
    from datasets.trajectory import Trajectory
    from slam.evaluation.wall_thickness import WallThickness


def evaluate(
    run: options.RunFolder,
    relations: Annotated[
        Path | None, typer.Option("--relations", help="Relative poses checked by hand.")
    ] = None,
    ground_truth: Annotated[
        str | None,
        typer.Option(
            "--ground-truth",
            metavar="TUM|BAG[:TOPIC]",
            help="True poses: ATE, RPE and how right places are that were visited again.",
        ),
    ] = None,
    time_offset: Annotated[
        str,
        typer.Option(
            "--time-offset",
            metavar="auto|S",
            help="To add to the run's stamps for the ground truth's; auto estimates it.",
        ),
    ] = "0",
    walls: Annotated[
        bool, typer.Option("--walls", help="How thick the walls of the map are.")
    ] = False,
    structures: Annotated[
        Path | None,
        typer.Option(
            "--structures", help="Measured lengths (docs/measures.md): how long they came out."
        ),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write all of it there, too.")
    ] = None,
) -> None:
    """Compare a run with what is known: relations, ground truth, straight walls, lengths."""
    from rich.console import Console  # noqa: PLC0415

    from slam.runs.evaluate import evaluate_run, print_report  # noqa: PLC0415

    offset = _time_offset(time_offset)
    data: dict[str, Any] = {}
    if relations is not None or ground_truth is not None or not (walls or structures):
        truth = None if ground_truth is None else read_ground_truth(ground_truth)
        report = evaluate_run(run, relations, truth, offset)
        print_report(report, Console())
        data |= report.as_dict()
    if walls:
        thickness = _walls(run)
        typer.echo(f"\n{thickness}" if data else str(thickness))
        data["walls"] = {
            "thickness_95_m": thickness.percentile_95_m,
            "thickness_median_m": thickness.median_m,
            "walls": len(thickness.walls),
            "stretches": int(thickness.thickness_m.size),
            "left_out": thickness.left_out,
        }
    if structures is not None:
        data["structures"] = _structures(run, structures, apart=bool(data))
    if json_file is not None:
        write_whole(json_file, (json.dumps(data, indent=2, allow_nan=False) + "\n").encode())


def read_ground_truth(text: str) -> Trajectory:
    """Poses from ``TUM``, ``BAG`` or ``BAG:TOPIC``.

    Raises InputError if there is no such file or no pose in it.
    """
    from datasets.bag_parts import magic  # noqa: PLC0415
    from datasets.bags import read_trajectory  # noqa: PLC0415
    from datasets.errors import InputError  # noqa: PLC0415
    from datasets.tum import read_tum  # noqa: PLC0415

    path, topic = Path(text), None
    if not path.exists():
        name, sign, after = text.rpartition(":")
        if sign and Path(name).exists():
            path, topic = Path(name), after
    if not path.exists():
        raise InputError(
            "there is no such ground truth",
            where=text,
            remedy="Give a TUM file, a bag or BAG:TOPIC",
        )
    if path.is_dir() or magic(path) is not None:
        return read_trajectory(path, topic or None)
    return read_tum(path)


def _time_offset(text: str) -> float | Literal["auto"]:
    if text == "auto":
        return "auto"
    try:
        offset_s = float(text)
    except ValueError:
        offset_s = math.nan
    if not math.isfinite(offset_s):
        raise typer.BadParameter(f"--time-offset is 'auto' or seconds, not {text!r}")
    return offset_s


def _walls(run_folder: Path) -> WallThickness:
    from slam.evaluation.wall_thickness import points_of_run, wall_thickness  # noqa: PLC0415
    from slam.runs.run_folder import read_run  # noqa: PLC0415

    run = read_run(run_folder)
    return wall_thickness(*points_of_run(run.scans, run.trajectory))


def _structures(run_folder: Path, file: Path, *, apart: bool) -> list[dict[str, Any]]:
    """Print how long each structure came out, and give it as plain data."""
    from slam.evaluation.structures_file import read_structures  # noqa: PLC0415
    from slam.runs.run_folder import read_run  # noqa: PLC0415
    from slam.runs.structures import (  # noqa: PLC0415
        measured_of_file,
        restoration_dict,
        restoration_line,
    )

    wanted = read_structures(file)
    run = read_run(run_folder)
    found = measured_of_file(wanted, run.scans, run.trajectory)
    heading = "restoration degree, gamma = length in the map / true length:"
    typer.echo(f"\n{heading}" if apart else heading)
    for result in found:
        typer.echo(f"  {restoration_line(result)}")
    return [restoration_dict(result) for result in found]
