"""``slam tables``: the paper's tables, from simulated drives."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Callable

    from slam.lab.drives.drives import Job
    from slam.lab.drives.rows import Rows

TABLES = (1, 2, 3, 4, 5)
HARD_SEEDS = 3


def tables(
    numbers: Annotated[
        list[int] | None,
        typer.Argument(metavar="[1 2 3 4 5]", help="Which; all without.", show_default=False),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Drives of each place.")] = 10,
    hard: Annotated[
        bool, typer.Option("--hard", help="Also drives under hard conditions, 3 seeds.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, max=64, help="Processes.")] = 2,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for page, CSV and pictures.")
    ] = Path("results/tables"),
    page: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write the page here, pictures beside it."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Compute the paper's tables from simulated drives, beside the paper's figures."""
    from slam.lab.drives.conditions import CONDITIONS  # noqa: PLC0415
    from slam.lab.drives.drives import hard_jobs, jobs_of  # noqa: PLC0415
    from slam.lab.drives.seeds import run_all  # noqa: PLC0415
    from slam.lab.tables.results import Results  # noqa: PLC0415

    asked = _asked(numbers)
    folder = Results(out, page)
    every = range(1, seeds + 1)
    jobs = jobs_of(asked, every, folder.pictures)
    if hard:
        jobs += hard_jobs(CONDITIONS, every[:HARD_SEEDS])
    command = shlex.join(["slam", *sys.argv[1:]])
    folder.begin(jobs)
    with _broken_off(out), _progress(len(jobs), quiet=quiet) as advance:

        def done(job: Job, rows: Rows) -> None:
            folder.keep(job, rows)
            advance(job)

        results = run_all(jobs, workers, done)
    text = folder.finish(results, asked, command)
    typer.echo(text)
    typer.echo(f"written to {folder.page}" + (f" and {page}" if page else ""), err=True)


def _asked(numbers: Sequence[int] | None) -> Collection[int]:
    from datasets.errors import InputError  # noqa: PLC0415

    for number in numbers or ():
        if number not in TABLES:
            raise InputError(
                f"the paper has no table {number}",
                where="slam tables",
                remedy=f"Give some of {', '.join(map(str, TABLES))}, or none for all",
            )
    return set(numbers or TABLES)


@contextmanager
def _broken_off(out: Path) -> Iterator[None]:
    """Ctrl-C and SIGTERM break off, with the exit code of the signal."""
    from slam.runs.interruption import Interrupted, Interruption  # noqa: PLC0415

    with Interruption() as interruption:
        try:
            with interruption.breaking_off():
                yield
        except Interrupted:
            typer.echo(f"broken off: {out / 'seeds'} has the rows of the seeds done", err=True)
            raise typer.Exit(128 + interruption.number) from None


@contextmanager
def _progress(total: int, *, quiet: bool) -> Iterator[Callable[[Job], None]]:
    """A bar on stderr where that is a terminal, else a line for each drive."""
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True, highlight=False, soft_wrap=True)
    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    )
    with progress:
        task = progress.add_task("drives", total=total)
        finished = 0

        def advance(job: Job) -> None:
            nonlocal finished
            finished += 1
            progress.update(task, completed=finished)
            if not quiet:
                what = f", {job.condition.name}" if job.condition else ""
                line = f"{finished} of {total}: {job.place}{what}, seed {job.seed}"
                console.print(line, markup=False)

        yield advance
