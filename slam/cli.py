"""The command line, ``slam``. What costs time to import is imported by the commands."""

from __future__ import annotations

import sys
from importlib.metadata import version
from typing import Annotated

import typer

from datasets.errors import InputError, one_line
from slam.commands.calibrate import calibrate
from slam.commands.check import check
from slam.commands.compare import compare
from slam.commands.config import config
from slam.commands.demo import demo
from slam.commands.evaluate import evaluate
from slam.commands.export import export
from slam.commands.fuse import fuse
from slam.commands.optimise import optimise
from slam.commands.run import run
from slam.commands.simulate import simulate
from slam.commands.tables import tables

app = typer.Typer(
    name="slam",
    help="Maps from recordings of a robot with 2D lidars.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for command in (
    run,
    compare,
    fuse,
    simulate,
    check,
    calibrate,
    export,
    evaluate,
    optimise,
    tables,
    config,
    demo,
):
    app.command()(command)


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"corridor-slam {version('corridor-slam')}")
        raise typer.Exit


@app.callback()
def _options(
    version_: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Maps from recordings of a robot with 2D lidars."""


def main() -> None:
    """Run a command; what is wrong with its input is one line on stderr and exit code 2."""
    try:
        app()
    except InputError as error:
        _fail(str(error))
    except OSError as error:
        where = one_line(error.filename or "the system", 300)
        why = one_line(error.strerror or str(error), 300)
        _fail(f"{where}: {why}. Check path, rights and room on the disk")


def _fail(message: str) -> None:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)
