"""``slam calibrate``: where the depth camera stands."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from datasets.whole_file import check_target, write_new
from slam.commands import options


def calibrate(
    recording: options.Recordings,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="The calibration file to write; else it is only shown."),
    ] = None,
    guess: Annotated[
        str | None,
        typer.Option(
            "--guess",
            metavar="X,Y,Z,ROLL,PITCH,YAW",
            help="The rough mounting, m and degrees, x ahead; else the recording's, or level.",
        ),
    ] = None,
    camera: Annotated[
        str | None, typer.Option("--camera", metavar="TOPIC", help="Which depth camera.")
    ] = None,
    floor_z: Annotated[
        float,
        typer.Option(
            "--floor-z",
            min=-5.0,
            max=5.0,
            metavar="M",
            help="Height of the floor in the base frame: -0.1 if the base is 10 cm above it.",
        ),
    ] = 0.0,
    with_clock: Annotated[
        bool, typer.Option("--with-clock", help="Estimate and write the camera's clock as well.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="A PNG of the walls before and after.")
    ] = None,
    force: options.Force = False,
    start: options.Start = 0.0,
    duration: options.Duration = None,
    calibration: options.Calibration = None,
    lidar: options.Lidar = None,
    odometry: options.OdometryTopic = None,
    salvage: options.Salvage = False,
) -> None:
    """Estimate where the depth camera stands, from walls that the lidar sees too, and the floor.

    Writes the calibration file that 'slam run --calibration' takes; what a file given with
    --calibration says besides stays in it. Exit code 0: all six values are determined, 1: some
    keep the values that it began with, 2: nothing can be said.
    """
    import cv2  # noqa: PLC0415
    from rich.console import Console  # noqa: PLC0415

    from datasets.open_recording import open_recording  # noqa: PLC0415
    from fusion.calibration.estimate import CalibrationConfig  # noqa: PLC0415
    from fusion.calibration.estimate import calibrate as estimate  # noqa: PLC0415
    from slam.calibration import calibrate as told  # noqa: PLC0415
    from slam.calibration.picture import calibration_picture  # noqa: PLC0415

    for target in (out, picture):
        if target is not None:
            check_target(target, force=force)
    T_base_camera_guess = None if guess is None else told.parse_guess(guess)
    reading = options.read_options(
        start, duration, calibration, lidar, odometry, None, salvage=salvage
    )
    config = CalibrationConfig(floor_z_m=floor_z, with_clock=with_clock)
    notes: Counter[str] = Counter()
    opened = open_recording(recording, replace(reading, unmounted_cameras=True))
    result = estimate(opened, config, notes, camera=camera, T_base_camera_guess=T_base_camera_guess)
    # Into a file or a pipe nothing is folded or cut to the width of a terminal.
    console = Console(
        width=None if sys.stdout.isatty() else 200, highlight=False, soft_wrap=True, markup=False
    )
    told.print_result(result, notes, console)
    if picture is not None:
        image = cv2.imencode(".png", calibration_picture(result, floor_z))[1]
        write_new(picture, image.tobytes(), force=force)
    if out is not None:
        text = told.calibration_yaml(result, calibration, with_clock=with_clock)
        write_new(out, text.encode(), force=force)
    raise typer.Exit(0 if result.determined else 1)
