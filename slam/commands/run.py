"""``slam run``: a recording becomes a run folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from slam.commands import options
from slam.commands.progress import StageLines

if TYPE_CHECKING:
    from slam.runs.run import RunDone, RunRequest


def run(
    recording: options.Recordings,
    out: options.NewFolder = None,
    force: options.Force = False,
    start: options.Start = 0.0,
    duration: options.Duration = None,
    calibration: options.Calibration = None,
    config: options.ConfigFile = None,
    setting: options.Settings = None,
    sensors: options.SensorChoice = None,
    fusion: options.FusionChoice = None,
    frontend: options.FrontendChoice = None,
    no_odometry: options.NoOdometry = False,
    no_loops: options.NoLoops = False,
    lidar: options.Lidar = None,
    camera: options.Camera = None,
    no_camera: options.NoCamera = False,
    odometry: options.OdometryTopic = None,
    ground_truth: options.GroundTruthTopic = None,
    salvage: options.Salvage = False,
    quiet: options.Quiet = False,
) -> None:
    """Map a recording: trajectory, occupancy grid, graph and metrics into a run folder.

    Ctrl-C (or SIGTERM) ends the reading and writes what was mapped so far, as a whole run folder
    that says it is partial; the exit code is then 130 (143). A second one breaks off: nothing is
    written.
    """
    chosen = options.configuration(
        config,
        setting,
        frontend,
        no_odometry=no_odometry,
        no_loops=no_loops,
        sensors=sensors,
        fusion=fusion,
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
        no_camera=no_camera,
    )
    from slam.runs.run import RunRequest  # noqa: PLC0415

    request = RunRequest(tuple(recording), reading, chosen, out, force)
    done, number = watched_run(request, quiet=quiet)
    if quiet:
        typer.echo(str(done.folder))
    else:
        print_summary(done)
    if done.run.partial:
        raise typer.Exit(128 + number)


def watched_run(request: RunRequest, *, quiet: bool = False) -> tuple[RunDone, int]:
    """The run, and the number of the signal that interrupted it, or 0."""
    from slam.runs.interruption import Interruption  # noqa: PLC0415
    from slam.runs.run import run_recording  # noqa: PLC0415

    watch = StageLines(quiet=quiet, duration_s=request.reading.duration_s)
    try:
        with Interruption() as interruption, watch:
            done = run_recording(request, watch, interruption)
    except KeyboardInterrupt:
        typer.echo("broken off", err=True)
        raise typer.Exit(130) from None
    return done, interruption.number


def print_summary(done: RunDone) -> None:
    """What a run came to, on stdout."""
    from slam.runs.summary import summary_lines  # noqa: PLC0415

    run = done.run
    for line in summary_lines(run.metrics, run.timing, done.folder, partial=run.partial):
        typer.echo(line)
