"""``slam simulate``: a simulated drive as a bag."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from datasets.simulation.bag_writer import Estimate, Written
    from datasets.simulation.place import DriveSpec, Place
    from datasets.simulation.robot import Robot
    from datasets.simulation.simulated_drive import SimulatedDrive


def simulate(
    place: Annotated[
        str,
        typer.Argument(
            metavar="PLACE",
            help="A place by its name (room, ring-corridor, beam-room, office, campus) "
            "or its YAML file.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="The bag: .mcap is ROS 2, .bag is ROS 1, no ending a ROS 2 folder.",
            show_default=False,
        ),
    ],
    drive: Annotated[
        str | None,
        typer.Option(
            "--drive",
            metavar="NAME|FILE",
            help="A drive of the place, the first unless said otherwise, or a YAML file of one.",
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            "--robot",
            metavar="NAME",
            help="paper, tilted, rolled, offset, two-lidars, "
            "low-lidar or gyro; else the one the drive names.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same gives the same bytes.")] = 1,
    laps: Annotated[
        int, typer.Option("--laps", min=1, max=1000, help="So many rounds of a closed drive.")
    ] = 1,
    depth: Annotated[
        str | None,
        typer.Option("--depth", metavar="MODE", help="1280x720, 848x480 or 640x480, the default."),
    ] = None,
    depth_rate: Annotated[
        float,
        typer.Option("--depth-rate", min=0.1, max=90.0, metavar="HZ", help="Images a second."),
    ] = 5.0,
    no_depth: Annotated[bool, typer.Option("--no-depth", help="Without the depth camera.")] = False,
    raw_depth: Annotated[
        bool, typer.Option("--raw-depth", help="Images as 16UC1, not as compressedDepth.")
    ] = False,
    no_odometry: Annotated[bool, typer.Option("--no-odometry", help="Without wheels.")] = False,
    slip: Annotated[bool, typer.Option("--slip", help="Wheels that slip far more often.")] = False,
    no_people: Annotated[
        bool, typer.Option("--no-people", help="Without anything that moves.")
    ] = False,
    trouble: Annotated[
        str | None,
        typer.Option(
            "--trouble",
            metavar="KIND",
            help="What goes wrong, drawn from the seed: carried, turned, odometry-reset, "
            "lidar-silent or door-closed.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a bag that is there.")] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print nothing but the bag's path.")
    ] = False,
) -> None:
    """Let a robot drive through a simulated place and write what its sensors say as a bag.

    The bag appears whole or not at all: Ctrl-C leaves nothing behind.
    """
    from datasets.simulation.bag_writer import (  # noqa: PLC0415
        check_room,
        check_target,
        estimate,
        write_bag,
    )
    from datasets.simulation.place import load_place  # noqa: PLC0415
    from datasets.simulation.simulated_drive import SimulatedDrive  # noqa: PLC0415

    check_target(out, force=force)
    where = load_place(place)
    name, spec = _drive(where, drive)
    if trouble is not None:
        spec = _troubled(where, spec, trouble, seed, laps)
    chosen = _robot(robot or spec.robot, depth, depth_rate, no_depth=no_depth)
    chosen = _wheels(chosen, slip=slip, no_odometry=no_odometry)
    simulated = SimulatedDrive(where, spec, chosen, seed, laps=laps, people=not no_people)
    with _broken_off():
        expected = estimate(simulated, raw_depth=raw_depth)
        check_room(out, expected.size_bytes)
        if not quiet:
            what = f"{where.name}, drive {name}, robot {robot or spec.robot}, seed {seed}"
            typer.echo(f"{what}: {_said(simulated, expected)}", err=True)
        with _progress(simulated.drive.duration_s, quiet=quiet) as progress:
            written = write_bag(simulated, out, raw_depth=raw_depth, force=force, progress=progress)
    if quiet:
        typer.echo(str(out))
        return
    for line in _summary(simulated, written):
        typer.echo(line)


def _drive(place: Place, asked: str | None) -> tuple[str, DriveSpec]:
    """A drive and its name: one of the place's, or one from a file."""
    from datasets.errors import InputError  # noqa: PLC0415
    from datasets.simulation.place import load_drive  # noqa: PLC0415

    known = ", ".join(place.drives) or "none"
    if asked is None and not place.drives:
        raise InputError(
            "no drive leads through this place",
            where=place.name,
            remedy="Add one under `drives` (docs/places.md), or give a file of one with --drive",
        )
    name = next(iter(place.drives)) if asked is None else asked
    if name in place.drives:
        return name, place.drives[name]
    if not Path(name).exists():
        raise InputError(
            f"no such drive: {name}",
            where=place.name,
            remedy=f"Its drives are: {known}. Or give the path of a YAML file (docs/places.md)",
        )
    return name, load_drive(Path(name), place)


def _troubled(place: Place, spec: DriveSpec, asked: str, seed: int, laps: int) -> DriveSpec:
    """The drive with trouble of a kind in place of what its file says."""
    from datasets.errors import InputError  # noqa: PLC0415
    from datasets.simulation.trouble import KINDS, drawn_trouble  # noqa: PLC0415

    kind = next((each for each in KINDS if each == asked), None)
    if kind is None:
        raise InputError(
            f"no such trouble: {asked}", where="--trouble", remedy=f"There are: {', '.join(KINDS)}"
        )
    doors = {name: (door.hinge, door.tip) for name, door in place.doors.items()}
    where = f"{place.name}, its drive"
    return replace(spec, trouble=(drawn_trouble(kind, spec.driven(laps), doors, seed, where),))


def _robot(name: str, mode: str | None, rate_hz: float, *, no_depth: bool) -> Robot:
    from datasets.errors import InputError  # noqa: PLC0415
    from datasets.simulation.depth_camera import MODES, DepthModel  # noqa: PLC0415
    from datasets.simulation.robot import ROBOTS  # noqa: PLC0415

    robot = next((each for known, each in ROBOTS.items() if known == name), None)
    if robot is None:
        raise InputError(
            f"no such robot: {name}", where="--robot", remedy=f"There are: {', '.join(ROBOTS)}"
        )
    if mode is not None and mode not in MODES:
        raise InputError(
            f"no such mode: {mode}", where="--depth", remedy=f"There are: {', '.join(MODES)}"
        )
    if mode is not None and not robot.cameras:
        raise InputError(
            f"the robot {name} has no depth camera",
            where="--depth",
            remedy="Leave --depth out, or choose another robot",
        )
    if no_depth:
        return replace(robot, cameras={})
    # Checked above: a mode that is none of MODES got no further.
    model = DepthModel.model_validate({"mode": mode}) if mode else None
    return robot.seeing(model, rate_hz)


def _wheels(robot: Robot, *, slip: bool, no_odometry: bool) -> Robot:
    from datasets.simulation.robot import SLIPPERY  # noqa: PLC0415

    if no_odometry:
        return replace(robot, wheels=None)
    return replace(robot, wheels=SLIPPERY) if slip else robot


@contextmanager
def _broken_off() -> Iterator[None]:
    """Ctrl-C and SIGTERM break off, with the exit code of the signal."""
    from slam.runs.interruption import Interrupted, Interruption  # noqa: PLC0415

    with Interruption() as interruption:
        try:
            with interruption.breaking_off():
                yield
        except Interrupted:
            typer.echo("broken off, nothing was written", err=True)
            raise typer.Exit(128 + interruption.number) from None


@contextmanager
def _progress(duration_s: float, *, quiet: bool) -> Iterator[Callable[[float], None]]:
    """A bar on stderr, where that is a terminal."""
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: PLC0415

    console = Console(stderr=True, highlight=False)
    progress = Progress(
        TextColumn("simulating"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:3.0f} %"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    )
    with progress:
        task = progress.add_task("", total=duration_s)
        yield lambda driven_s: progress.update(task, completed=driven_s)


def _said(drive: SimulatedDrive, expected: Estimate) -> str:
    size, writing_s = _size(expected.size_bytes), max(1.0, expected.duration_s)
    driven = f"{drive.drive.duration_s:.0f} s, {drive.drive.length_m:.0f} m"
    return f"{driven}; about {size}, written in about {writing_s:.0f} s"


def _summary(drive: SimulatedDrive, written: Written) -> Iterator[str]:
    yield f"{written.path}: {_size(written.size_bytes)}, {drive.drive.duration_s:.0f} s"
    for topic, count in sorted(written.messages.items()):
        yield f"  {topic:<44} {count:>7} messages"
    bag = shlex.quote(str(written.path))
    yield "\nnext:"
    yield f"  slam run {bag} -o run"
    yield f"  slam evaluate run --ground-truth {bag}"


def _size(size_bytes: int) -> str:
    return f"{size_bytes / 1e9:.1f} GB" if size_bytes >= 1e9 else f"{size_bytes / 1e6:.1f} MB"
