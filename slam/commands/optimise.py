"""``slam optimise``: a pose graph from a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam.commands import options


def optimise(
    graph: Annotated[
        Path, typer.Argument(metavar="GRAPH", help="A g2o or TORO file.", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The g2o or TORO file to write.", show_default=False)
    ],
    robust: Annotated[
        bool, typer.Option("--robust", help="Expect false loop closures, leave them out.")
    ] = False,
    force: options.Force = False,
) -> None:
    """Optimise a pose graph from a file."""
    from rich.console import Console  # noqa: PLC0415

    from slam.runs.optimise import optimise_file, print_report  # noqa: PLC0415

    print_report(optimise_file(graph, out, robust, force=force), Console())
