"""``slam export``, ``slam evaluate`` and ``slam optimise``: after a run."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from slam import cli_options as options
from slam.whole_file import write_whole

if TYPE_CHECKING:
    from datasets.trajectory import Trajectory
    from slam.evaluation.wall_thickness import WallThickness


def export(
    run: options.RunFolder,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="The folder to write; else a new one beside the run."),
    ] = None,
    resolution: Annotated[
        float | None, typer.Option("--resolution", metavar="M", help="Side of a cell.")
    ] = None,
    occupied_threshold: Annotated[
        float | None, typer.Option("--occupied-threshold", metavar="P", help="Occupied from here.")
    ] = None,
    free_threshold: Annotated[
        float | None, typer.Option("--free-threshold", metavar="P", help="Free below.")
    ] = None,
    max_range: Annotated[
        float | None, typer.Option("--max-range", metavar="M", help="Longer beams hit nothing.")
    ] = None,
    align_walls: Annotated[
        bool, typer.Option("--align-walls", help="Turn map and trajectory onto the walls.")
    ] = False,
    layer: Annotated[
        str | None,
        typer.Option("--layer", metavar="NAME", help="What this layer saw only: lidar, camera."),
    ] = None,
    force: options.Force = False,
) -> None:
    """Write the map of a run again: other cells, thresholds, one layer, walls along the axes."""
    from slam.export import export_run  # noqa: PLC0415
    from slam.run_folder import new_run_folder  # noqa: PLC0415

    done = export_run(
        run,
        out or new_run_folder(run.resolve().parent, f"{run.resolve().name}-map"),
        resolution_m=resolution,
        occupied_threshold=occupied_threshold,
        free_threshold=free_threshold,
        max_range_m=max_range,
        align_walls=align_walls,
        layer=layer,
        force=force,
    )
    if done.walls is not None:
        turned = math.degrees(done.walls.yaw_rad)
        typer.echo(
            f"turned by {-turned:.2f} deg onto the walls (contrast {done.walls.contrast:.2f})"
        )
    height, width = done.grid.shape
    typer.echo(f"{width} x {height} cells of {done.grid.resolution_m:g} m")
    for path in sorted(done.folder.iterdir()):
        typer.echo(str(path))


def evaluate(
    run: options.RunFolder,
    relations: Annotated[
        Path | None, typer.Option("--relations", help="Relative poses checked by hand.")
    ] = None,
    ground_truth: Annotated[
        str | None,
        typer.Option("--ground-truth", metavar="TUM|BAG[:TOPIC]", help="True poses: ATE and RPE."),
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

    from slam.evaluation.report import evaluate_run, print_report  # noqa: PLC0415

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


def optimise(
    graph: Annotated[
        Path, typer.Argument(metavar="GRAPH", help="A g2o or TORO file.", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The g2o or TORO file to write.", show_default=False)
    ],
    robust: Annotated[
        bool, typer.Option("--robust", help="Expect false loop closures, leave them out.")
    ] = False,
    force: options.Force = False,
) -> None:
    """Optimise a pose graph from a file."""
    from rich.console import Console  # noqa: PLC0415

    from slam.optimise import optimise_file, print_report  # noqa: PLC0415

    print_report(optimise_file(graph, out, robust, force=force), Console())


def read_ground_truth(text: str) -> Trajectory:
    """Poses from ``TUM``, ``BAG`` or ``BAG:TOPIC``.

    Raises InputError if there is no such file or no pose in it.
    """
    from datasets.bag_source import magic  # noqa: PLC0415
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
    from slam.run_folder import read_run  # noqa: PLC0415

    run = read_run(run_folder)
    return wall_thickness(*points_of_run(run.scans, run.trajectory))


def _structures(run_folder: Path, file: Path, *, apart: bool) -> list[dict[str, Any]]:
    """Print how long each structure came out, and give it as plain data."""
    from slam.evaluation.run_structures import (  # noqa: PLC0415
        measured_of_file,
        restoration_dict,
        restoration_line,
    )
    from slam.evaluation.structures_file import read_structures  # noqa: PLC0415
    from slam.run_folder import read_run  # noqa: PLC0415

    wanted = read_structures(file)
    run = read_run(run_folder)
    found = measured_of_file(wanted, run.scans, run.trajectory)
    heading = "restoration degree, gamma = length in the map / true length:"
    typer.echo(f"\n{heading}" if apart else heading)
    for result in found:
        typer.echo(f"  {restoration_line(result)}")
    return [restoration_dict(result) for result in found]
