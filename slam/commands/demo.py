"""``slam demo``: a short simulated drive, mapped and compared with the truth."""

from __future__ import annotations

import typer

from slam.commands import options
from slam.commands.run import print_summary, watched_run


def demo(
    out: options.NewFolder = None,
    force: options.Force = False,
) -> None:
    """Simulate a short drive along a corridor, map it, and compare the map's way with the truth.

    The last line is the path of the map's picture.
    """
    from datasets.bags import read_trajectory  # noqa: PLC0415
    from slam.commands.demo_recording import write_demo_recording  # noqa: PLC0415
    from slam.evaluation.trajectory_error import trajectory_error  # noqa: PLC0415
    from slam.mapping.map_set import MAP_PICTURE  # noqa: PLC0415
    from slam.runs.run import RESULTS, RunRequest  # noqa: PLC0415
    from slam.runs.run_folder import check_run_target, new_run_folder  # noqa: PLC0415

    folder = out or new_run_folder(RESULTS, "demo")
    check_run_target(folder / "run", force=force)
    typer.echo("simulating a robot in a corridor", err=True)
    bag = write_demo_recording(folder)
    typer.echo(f"simulated {bag}: a lidar, a depth camera and wheels in a corridor\n")
    done, number = watched_run(RunRequest((bag,), out=folder / "run", force=force))
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
