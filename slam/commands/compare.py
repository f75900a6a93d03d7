"""``slam compare``: what fusing the sensors is worth."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.commands import options
from slam.commands.progress import StageLines

if TYPE_CHECKING:
    from slam.comparison.compare import Compared, CompareRequest


def compare(
    recording: options.Recordings,
    out: options.NewFolder = None,
    force: options.Force = False,
    paper: Annotated[bool, typer.Option("--paper", help="The paper's own method as well.")] = False,
    every: Annotated[
        bool,
        typer.Option(
            "--all", help="Paper mode, the union of the scans, and layers fused by Bayes' rule."
        ),
    ] = False,
    place: Annotated[
        str | None,
        typer.Option(
            "--place",
            metavar="NAME|FILE",
            help="The simulated place it was recorded in: obstacles and structures are judged.",
        ),
    ] = None,
    structures: Annotated[
        Path | None,
        typer.Option("--structures", help="A YAML file of measured lengths (docs/measures.md)."),
    ] = None,
    start: options.Start = 0.0,
    duration: options.Duration = None,
    calibration: options.Calibration = None,
    config: options.ConfigFile = None,
    setting: options.Settings = None,
    frontend: options.FrontendChoice = None,
    no_odometry: options.NoOdometry = False,
    no_loops: options.NoLoops = False,
    lidar: options.Lidar = None,
    camera: options.Camera = None,
    odometry: options.OdometryTopic = None,
    ground_truth: options.GroundTruthTopic = None,
    salvage: options.Salvage = False,
    quiet: options.Quiet = False,
) -> None:
    """Map a recording by lidar alone, by camera alone and by both, and lay the maps side by side.

    The folder holds a run folder for each, compare.png, and the table as compare.md, .csv and
    .json. Of lidars at different heights the highest is taken alone, then all together. Ctrl-C ends
    the run at hand and leaves out the rest; the exit code is then 130 (143), a second one leaves
    nothing.
    """
    from slam.comparison.compare import CompareRequest  # noqa: PLC0415
    from slam.comparison.parts import BAYES_PART, PAPER_PART, UNION_PART  # noqa: PLC0415

    chosen = options.configuration(
        config, setting, frontend, no_odometry=no_odometry, no_loops=no_loops
    )
    reading = options.read_options(
        start,
        duration,
        calibration,
        lidar,
        odometry,
        ground_truth,
        salvage=salvage,
        cameras=camera,
    )
    extra = (PAPER_PART, UNION_PART, BAYES_PART) if every else (PAPER_PART,) if paper else ()
    request = CompareRequest(
        tuple(recording), reading, chosen, out, force, extra, place, structures
    )
    done, number = _compared(request, quiet=quiet)
    if quiet:
        typer.echo(str(done.folder))
    else:
        _print(done)
    if done.partial:
        raise typer.Exit(128 + number)


def _compared(request: CompareRequest, *, quiet: bool) -> tuple[Compared, int]:
    """The comparison, and the number of the signal that interrupted it, or 0."""
    from slam.comparison.compare import compare_recording  # noqa: PLC0415
    from slam.runs.interruption import Interruption  # noqa: PLC0415

    watch = StageLines(quiet=quiet, duration_s=request.reading.duration_s)
    try:
        with Interruption() as interruption, watch:
            done = compare_recording(request, watch, interruption)
    except KeyboardInterrupt:
        typer.echo("broken off, nothing was written", err=True)
        raise typer.Exit(130) from None
    return done, interruption.number


def _print(done: Compared) -> None:
    """The table, a column for each map."""
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    from slam.comparison.table import measures, missing_lines  # noqa: PLC0415

    # Into a file or a pipe nothing is folded or cut to the width of a terminal.
    console = Console(width=None if sys.stdout.isatty() else 200, highlight=False)
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for row in done.rows:
        table.add_column(row["name"], justify="right")
    for name, cells in measures(done.rows):
        table.add_row(name, *cells)
    console.print(table)
    for line in missing_lines(done.rows):
        console.print(line, markup=False, soft_wrap=True)
    names = sorted(path.name for path in done.folder.iterdir())
    typer.echo(f"\nin {done.folder}:\n  {', '.join(names)}")
