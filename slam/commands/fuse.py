"""``slam fuse``: how one depth image is fused with a scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from datasets.whole_file import check_target, write_new
from slam.commands import options


def fuse(
    recording: options.Recordings,
    at: Annotated[
        float,
        typer.Option(
            "--at",
            metavar="S",
            help="When: seconds from the first message, or a stamp.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="The PNG to write; else RECORDING-S.png here."),
    ] = None,
    mode: Annotated[
        options.Fusion | None, typer.Option("--mode", help="Better, or that of the paper.")
    ] = None,
    force: options.Force = False,
    calibration: options.Calibration = None,
    config: options.ConfigFile = None,
    setting: options.Settings = None,
    no_odometry: options.NoOdometry = False,
    lidar: options.Lidar = None,
    camera: options.Camera = None,
    odometry: options.OdometryTopic = None,
    salvage: options.Salvage = False,
) -> None:
    """Draw how one depth image is fused with the scan nearest to it: for people who tune.

    Depth image, what became of its pixels, ranges over bearings with the tolerance of the
    association, and from above the pseudo-laser, the lidar's scan and the fused one by source.
    """
    from slam.comparison.fuse_moment import fuse_moment  # noqa: PLC0415
    from slam.comparison.fuse_picture import fuse_picture  # noqa: PLC0415

    chosen = options.configuration(
        config, setting, None, no_odometry=no_odometry, no_loops=False, fusion=mode
    )
    reading = options.read_options(
        0.0, None, calibration, lidar, odometry, None, salvage=salvage, cameras=camera
    )
    target = out or Path(f"{recording[0].stem}-{at:g}.png")
    check_target(target, force=force)
    moment = fuse_moment(recording, reading, chosen, at)
    write_new(target, fuse_picture(moment), force=force)
    for line in moment.title():
        typer.echo(line)
    typer.echo(str(target))
