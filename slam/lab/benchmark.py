"""``make bench``: measure what the project promises, on real and simulated recordings.

    python -m slam.lab.benchmark [--data DIR] [--only PART]... [--runs N] [--write/--no-write]

What is measured is in ``bench/``. Whole commands are run as processes of their own, and the
operating system says what they used.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from datasets.errors import InputError
from datasets.whole_file import write_whole
from slam.config import versions
from slam.lab.bench import accuracy, cost, fusion, obstacles, simulation, whole_maps
from slam.lab.bench.measure import SLAM, CommandFailedError, measure
from slam.lab.bench.session import Part, Session
from slam.lab.page import Measured, Result, circumstances, commit, page

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "benchmarks.md"
PARTS: Mapping[str, Part] = {
    part.name: part
    for module in (accuracy, whole_maps, cost, simulation, fusion, obstacles)
    for part in module.PARTS
}


def main(
    data: Annotated[
        Path, typer.Option("--data", help="The folder that holds recordings/.", show_default=False)
    ] = ROOT.parent / "shared" / "data",
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="PART", help=f"Repeatable; one of {', '.join(PARTS)}."),
    ] = None,
    runs: Annotated[int, typer.Option(min=1, help="How often what is timed is run.")] = 3,
    write: Annotated[
        bool | None,
        typer.Option("--write/--no-write", help="Write docs/benchmarks.md; without --only it is."),
    ] = None,
) -> None:
    """Measure, print the page, and write it to docs/benchmarks.md."""
    for name in only or ():
        if name not in PARTS:
            raise typer.BadParameter(f"{name!r} is none of {', '.join(PARTS)}")
    commit_before = commit(ROOT)
    with tempfile.TemporaryDirectory(prefix="slam-benchmark-") as scratch:
        session = Session(data / "recordings", Path(scratch), runs)
        _say("warming up")
        measure([SLAM, "demo", "-o", str(Path(scratch) / "warm-up")])
        results = {
            name: measure_part(part, session)
            for name, part in PARTS.items()
            if not only or name in only
        }
    words = ["python -m slam.lab.benchmark", f"--data {_relative(data)}", f"--runs {runs}"]
    command = " ".join(words + [f"--only {name}" for name in only or ()])
    text = page(results, circumstances(ROOT, command, versions(), commit_before))
    typer.echo(text)
    if write or (write is None and not only):
        write_whole(PAGE, text.encode())
        _say(f"written to {PAGE}")


def measure_part(part: Part, session: Session) -> Result:
    """Measure a part; where that can't be done the result says why."""
    missing = [name for name in part.needs if not (session.recordings / name).is_file()]
    measured: Measured | str
    if missing:
        measured = f"no {', '.join(missing)} in {_relative(session.recordings)}"
    else:
        _say(part.title)
        try:
            measured = part.measure(session)
        except (CommandFailedError, InputError) as error:
            measured = str(error).replace(str(session.scratch), "").replace(str(ROOT.parent), "..")
    if isinstance(measured, str):
        _say(f"  not measured: {measured}")
    return Result(part.title, part.bars, measured)


def _relative(path: Path) -> str:
    """A path as it is seen from the project's root, so that the page depends less on a machine."""
    return os.path.relpath(path, ROOT)


def _say(what: str) -> None:
    typer.echo(what, err=True)


if __name__ == "__main__":
    typer.run(main)
