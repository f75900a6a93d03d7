"""``slam export``: the map of a run, written again."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from slam.commands import options


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
    from slam.runs.export import export_run  # noqa: PLC0415
    from slam.runs.run_folder import new_run_folder  # noqa: PLC0415

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
