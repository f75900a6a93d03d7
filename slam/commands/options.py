"""Options that several commands share, and what they say together."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from datasets.options import ReadOptions
    from slam.config import Config


class Frontend(StrEnum):
    """The ways to track scan after scan."""

    SCAN_MATCHING = "scan-matching"
    KISS_ICP = "kiss-icp"
    POSE_INCREMENT = "pose-increment"
    CORRELATIVE = "correlative"


class Sensors(StrEnum):
    """Which sensors a run uses."""

    FUSED = "fused"
    LIDAR = "lidar"
    CAMERA = "camera"


class Fusion(StrEnum):
    """How lidar and camera are fused."""

    BETTER = "better"
    PAPER = "paper"
    UNION = "union"


LONGEST_S = 1e9
"""Thirty years: what is longer doesn't fit into nanoseconds in the end."""

Recordings = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING",
        help="A CARMEN log, a ROS 1 or ROS 2 bag, or the files of a split one.",
        show_default=False,
    ),
]
RunFolder = Annotated[
    Path, typer.Argument(metavar="RUN", help="A folder that 'slam run' wrote.", show_default=False)
]
NewFolder = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="The folder to write; else a new one under results/."),
]
Force = Annotated[bool, typer.Option("--force", help="Replace what an earlier one wrote there.")]
Start = Annotated[
    float,
    typer.Option("--start", min=0.0, max=LONGEST_S, metavar="S", help="Skip the first seconds."),
]
Duration = Annotated[
    float | None,
    typer.Option(
        "--duration",
        min=0.0,
        max=LONGEST_S,
        metavar="S",
        help="Read no more than so many seconds.",
    ),
]
Calibration = Annotated[
    Path | None,
    typer.Option("--calibration", help="A YAML file of mountings, masks and topics."),
]
Lidar = Annotated[
    list[str] | None, typer.Option("--lidar", metavar="TOPIC", help="Only this lidar; repeatable.")
]
Camera = Annotated[
    list[str] | None,
    typer.Option("--camera", metavar="TOPIC", help="Only this depth camera; repeatable."),
]
NoCamera = Annotated[bool, typer.Option("--no-camera", help="Leave out all depth cameras.")]
OdometryTopic = Annotated[
    str | None, typer.Option("--odometry", metavar="TOPIC|tf", help="Where odometry comes from.")
]
GroundTruthTopic = Annotated[
    str | None, typer.Option("--ground-truth", metavar="TOPIC", help="Where the true pose is.")
]
Salvage = Annotated[bool, typer.Option("--salvage", help="Read what is readable of a damaged bag.")]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", help="A YAML file as 'slam config' prints it, or a run's config."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="A.B=C", help="A key of the configuration; repeatable."),
]
FrontendChoice = Annotated[
    Frontend | None, typer.Option("--frontend", help="How scans are matched.")
]
SensorChoice = Annotated[
    Sensors | None,
    typer.Option("--sensors", help="Which sensors take part; fused: all there are."),
]
FusionChoice = Annotated[
    Fusion | None,
    typer.Option("--fusion", help="Better: in layers; paper: to the letter of the paper."),
]
NoOdometry = Annotated[
    bool, typer.Option("--no-odometry", help="Match scans alone; odometry is kept for evaluation.")
]
NoLoops = Annotated[bool, typer.Option("--no-loops", help="Without loop closure and final passes.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but the folder.")]


def read_options(
    start_s: float,
    duration_s: float | None,
    calibration: Path | None,
    lidars: list[str] | None,
    odometry: str | None,
    ground_truth: str | None,
    *,
    salvage: bool,
    cameras: list[str] | None = None,
    no_camera: bool = False,
    no_lidar: bool = False,
) -> ReadOptions:
    """The options of a reader. Raises InputError if they contradict each other."""
    from datasets.errors import InputError  # noqa: PLC0415
    from datasets.options import ReadOptions  # noqa: PLC0415

    for kind, chosen, without in (("camera", cameras, no_camera), ("lidar", lidars, no_lidar)):
        if chosen and without:
            raise InputError(
                f"--{kind} asks for what is to be left out",
                where="command line",
                remedy=f"Leave out `--{kind} {chosen[0]}` or what goes against it",
            )
    return ReadOptions(
        start_s=start_s,
        duration_s=duration_s,
        lidars=tuple(lidars or ()),
        use_lidars=not no_lidar,
        cameras=tuple(cameras or ()),
        use_cameras=not no_camera,
        odometry=odometry,
        ground_truth=ground_truth,
        calibration=calibration,
        salvage=salvage,
    )


def configuration(
    path: Path | None,
    settings: list[str] | None,
    frontend: Frontend | None,
    *,
    no_odometry: bool,
    no_loops: bool,
    sensors: Sensors | None = None,
    fusion: Fusion | None = None,
) -> Config:
    """The configuration of a file, ``--set`` over it, and the options that are short for a key."""
    from slam.config import load_config  # noqa: PLC0415

    asked = list(settings or ())
    chosen = {"frontend": frontend, "sensors": sensors, "fusion": fusion}
    asked += [f"{key}={value.value}" for key, value in chosen.items() if value is not None]
    if no_odometry:
        asked.append("odometry=false")
    if no_loops:
        asked.append("loops=false")
    return load_config(path, asked)
