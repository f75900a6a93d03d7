"""``slam check``: what is in a recording, before a run."""

from __future__ import annotations

import sys

import typer

from slam.commands import options


def check(
    recording: options.Recordings,
    start: options.Start = 0.0,
    duration: options.Duration = None,
    calibration: options.Calibration = None,
    lidar: options.Lidar = None,
    odometry: options.OdometryTopic = None,
    ground_truth: options.GroundTruthTopic = None,
    salvage: options.Salvage = False,
) -> None:
    """Say what is in a recording and what is wrong with it.

    Exit code 0: ready for a run, 1: usable with warnings, 2: no run can come from it.
    """
    from rich.console import Console  # noqa: PLC0415

    from datasets.open_recording import open_recording  # noqa: PLC0415
    from slam.checks.check import check_recording, exit_code, print_report  # noqa: PLC0415

    reading = options.read_options(
        start, duration, calibration, lidar, odometry, ground_truth, salvage=salvage
    )
    report = check_recording(open_recording(recording, reading))
    # Into a file or a pipe nothing is folded or cut to the width of a terminal.
    print_report(report, Console(width=None if sys.stdout.isatty() else 200))
    raise typer.Exit(exit_code(report))
