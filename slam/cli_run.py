"""``slam run`` and ``slam demo``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from slam import cli_options as options
from slam.cli_progress import StageLines

if TYPE_CHECKING:
    from slam.run import RunDone, RunRequest


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
    from slam.run import RunRequest  # noqa: PLC0415

    request = RunRequest(tuple(recording), reading, chosen, out, force)
    done, number = _run(request, quiet=quiet)
    if quiet:
        typer.echo(str(done.folder))
    else:
        print_summary(done)
    if done.run.partial:
        raise typer.Exit(128 + number)


def demo(
    out: options.NewFolder = None,
    force: options.Force = False,
) -> None:
    """Simulate a short drive along a corridor, map it, and compare the map's way with the truth.

    The last line is the path of the map's picture.
    """
    from datasets.bags import read_trajectory  # noqa: PLC0415
    from slam.demo import write_demo_recording  # noqa: PLC0415
    from slam.evaluation.trajectory_error import trajectory_error  # noqa: PLC0415
    from slam.map_set import MAP_PICTURE  # noqa: PLC0415
    from slam.run import RESULTS, RunRequest  # noqa: PLC0415
    from slam.run_folder import check_run_target, new_run_folder  # noqa: PLC0415

    folder = out or new_run_folder(RESULTS, "demo")
    check_run_target(folder / "run", force=force)
    typer.echo("simulating a robot in a corridor", err=True)
    bag = write_demo_recording(folder)
    typer.echo(f"simulated {bag}: a lidar, a depth camera and wheels in a corridor\n")
    done, number = _run(RunRequest((bag,), out=folder / "run", force=force))
    print_summary(done)
    if done.run.partial:
        raise typer.Exit(128 + number)
    truth = read_trajectory(bag, None)
    mapped = trajectory_error(done.run.trajectory, truth)
    assert done.run.odometry is not None  # the demo recording has it
    wheels = trajectory_error(done.run.odometry, truth)
    typer.echo("\nerror against the ground truth (ATE rmse, SE(2) aligned):")
    for name, error in (("raw odometry", wheels), ("slam", mapped)):
        metres, degrees = error.translation_m.rmse, error.rotation_deg.rmse
        typer.echo(f"  {name:<13} {metres:.3f} m, {degrees:.2f} deg, n = {error.count}")
    typer.echo(f"\n{done.folder / MAP_PICTURE}")


def _run(request: RunRequest, *, quiet: bool = False) -> tuple[RunDone, int]:
    """The run, and the number of the signal that interrupted it, or 0."""
    from slam.interruption import Interruption  # noqa: PLC0415
    from slam.run import run_recording  # noqa: PLC0415

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
    from slam.summary import summary_lines  # noqa: PLC0415

    run = done.run
    for line in summary_lines(run.metrics, run.timing, done.folder, partial=run.partial):
        typer.echo(line)
