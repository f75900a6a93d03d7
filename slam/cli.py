"""The command line, ``slam``. What costs time to import is imported by the commands."""

from __future__ import annotations

import sys
from importlib.metadata import version
from typing import Annotated

import typer

from datasets.errors import InputError
from slam import (
    cli_calibrate,
    cli_compare,
    cli_recording,
    cli_results,
    cli_run,
    cli_simulate,
    cli_tables,
)

app = typer.Typer(
    name="slam",
    help="Maps from recordings of a robot with 2D lidars.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for command in (
    cli_run.run,
    cli_compare.compare,
    cli_compare.fuse,
    cli_simulate.simulate,
    cli_recording.check,
    cli_calibrate.calibrate,
    cli_results.export,
    cli_results.evaluate,
    cli_results.optimise,
    cli_tables.tables,
    cli_recording.config,
    cli_run.demo,
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
        where = error.filename or "the system"
        _fail(f"{where}: {error.strerror or error}. Check path, rights and room on the disk")


def _fail(message: str) -> None:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)
