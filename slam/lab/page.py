"""The page of the benchmark: bars, what was measured against them, and where."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

NOTHING = "-"

COMPARED = (
    "intel",
    "fr079",
    *(f"whole-{x}" for x in ("intel", "fr079", "aces", "infinite-corridor", "acapulco")),
)
"""Parts whose figures stand beside those of other systems."""

PAGES = ("docs/benchmarks.md", "docs/results*")
"""What is made by measuring."""

COMPARISON = """\
| | GMapping, stock | Karto (slam_toolbox), stock | Cartographer, stock \
| Cartographer, tuned to each log | raw odometry | here |
|---|---|---|---|---|---|---|
| `intel` | 0.057 m, 1.53 deg, 70 s | 0.24 m, 1.88 deg, 14 s | loses the loop \
| 0.104 m, 1.35 deg, 928 s | 7.4 m | {intel} |
| `fr079` | 1.1 m, 89 s | 2.1 m, 14 s | loses the loop \
| 0.036 m, 0.76 deg, 311 s | 6.5 m | {fr079} |
"""

CAVEAT = """\
Mean translational error over all relations, mean rotational error, CPU seconds. Only the last
column was measured by this benchmark, with one parameter set, the defaults. The others were
measured for the project beforehand, on the same files and the same kind of machine, and are quoted.
How an evaluator reaches the relations' stamps, most of which lie between scans, shifts a mean by
some millimetres, on `intel` by more than that (below: the same trajectory, its poses reached along
the odometry, and interpolated): compare differences of that size only within one evaluator.
"""

WHOLE_MAPS = """\
| | GMapping, stock | Karto (slam_toolbox), stock | Cartographer, tuned to sparse logs | here |
|---|---|---|---|---|
| `intel` | 0 % / 0.17 m / 132 s | 31 % / 1.1 m / 17 s | 66 % / - / 387 s, 0 % in another setting \
| {whole-intel} |
| `fr079` | 11 % / 1.0 m / 216 s | 78 % / 20 m / 25 s | 0 % / - / 560 s | {whole-fr079} |
| `aces` | 49 % / 1.6 m / 37 s | 53 % / 2.2 m / 4 s | 74 % / 3.3 m / 21 s | {whole-aces} |
| `infinite-corridor` | 74 % / 6.9 m / 159 s | 95 % / 14 m / 16 s | 92 % / 53 m / 88 s \
| {whole-infinite-corridor} |
| `acapulco` | 0 % / 0.19 m / 72 s | 65 % / 12 m / 7 s | 87 % / 54 m / 62 s \
| {whole-acapulco} |
"""

WHOLE_MAPS_CAVEAT = """\
The map as a whole: the share of the revisits that is off by more than 0.5 m, 95th percentile of the
revisits' errors ([measures.md](measures.md)), CPU seconds. Again only the last column was measured
here; GMapping's result on `aces` depends on its seed (ATE 0.55, 0.23 and 0.14 m).
"""


@dataclass(frozen=True, slots=True)
class Bar:
    """What is measured, in which unit, and how small it must be; both None: for information.

    must : a number, or words where it is no number. at_least : how large it must be, not how small.
    """

    what: str
    unit: str
    must: float | str | None = None
    aim: float | None = None
    decimals: int = 2
    at_least: bool = False

    def words(self, value: float | str | None, decimals: int | None = None) -> str:
        """A value with its unit; a bar has no more digits than it needs."""
        if value is None:
            return NOTHING
        if isinstance(value, str):
            return value
        text = f"{value:g}" if decimals is None else f"{value:.{decimals}f}"
        return f"{text} {self.unit}"

    def verdict(self, value: Value) -> str:
        """Which of the bars is reached, in words."""
        if self.must is None:
            return "information"
        if not (value.met and (isinstance(self.must, str) or self._reached(value, self.must))):
            return "MISSED"
        if self.aim is None:
            return "must reached"
        return "aim reached" if self._reached(value, self.aim) else "must reached, aim not"

    def _reached(self, value: Value, bar: float) -> bool:
        return value.value >= bar if self.at_least else value.value <= bar


@dataclass(frozen=True, slots=True)
class Value:
    """What was measured against a bar.

    how : what else belongs to it, in a few words. met : whether a ``must`` in words holds.
    """

    value: float
    how: str = ""
    met: bool = True


@dataclass(frozen=True, slots=True)
class Measured:
    """What was measured for one part of the benchmark.

    values  : one for each bar of the part. details : markdown.
    brief   : for the comparison with other systems.
    """

    values: tuple[Value, ...]
    details: str = ""
    brief: str = ""


@dataclass(frozen=True, slots=True)
class Result:
    """What came of one part. measured : words that say why, where it was not measured."""

    title: str
    bars: tuple[Bar, ...]
    measured: Measured | str

    def rows(self) -> list[str]:
        """The rows of the table of bars."""
        if isinstance(self.measured, str):
            return [_row(bar, NOTHING, "**not measured**", self.measured) for bar in self.bars]
        return [
            _row(
                bar,
                bar.words(value.value, bar.decimals),
                _emphasised(bar.verdict(value)),
                value.how,
            )
            for bar, value in zip(self.bars, self.measured.values, strict=True)
        ]


def _row(bar: Bar, measured: str, verdict: str, how: str) -> str:
    cells = (bar.what, bar.words(bar.must), bar.words(bar.aim), measured, verdict, how)
    return table_row(cells)


def _emphasised(verdict: str) -> str:
    return f"**{verdict}**" if verdict == "MISSED" else verdict


def table_row(cells: Sequence[str]) -> str:
    """A row of a markdown table; a vertical bar in a cell would end it."""
    return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A markdown table."""
    lines = [table_row(head), "|" + "---|" * len(head), *map(table_row, rows)]
    return "\n".join(lines)


def page(results: Mapping[str, Result], facts: Mapping[str, str]) -> str:
    """The whole page. results : by the name of the part. facts : about the measurement."""
    rows = [row for result in results.values() for row in result.rows()]
    head = ("what", "must", "aim", "measured", "verdict", "")
    measured = {
        name: result.measured
        for name, result in results.items()
        if isinstance(result.measured, Measured)
    }
    briefs = {
        name: measured[name].brief if name in measured else "not measured" for name in COMPARED
    }
    parts = [
        "# Benchmarks",
        "Written by `make bench` (`slam/lab/benchmark.py`); not to be edited. Accuracy is that of "
        "the default configuration, one for all recordings. Times are CPU seconds (user and "
        "system, all threads), so that other work on the machine shows less; each is of a whole "
        "process, "
        "with kernels compiled beforehand, unless it says something else.",
        table(("", ""), list(facts.items())),
        "## Bars",
        table_row(head) + "\n|" + "---|" * len(head) + "\n" + "\n".join(rows),
        "## Other systems",
        COMPARISON.format(**briefs),
        CAVEAT,
        WHOLE_MAPS.format(**briefs),
        WHOLE_MAPS_CAVEAT,
    ]
    for name, found in measured.items():
        if found.details:
            parts += [f"## {results[name].title}", found.details]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def circumstances(
    root: Path, command: str, versions: Mapping[str, str], commit_before: str
) -> dict[str, str]:
    """Where and of what was measured: date, command, commit, machine, versions.

    commit_before : what ``commit`` said before the measuring.
    """
    measured = commit(root)
    if measured != commit_before:
        measured = f"changed while measuring: first {commit_before}; then {measured}"
    return {
        "date": datetime.now(tz=UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "command": f"`{command}`",
        "commit": measured,
        "machine": machine(),
        "load when done": f"{os.getloadavg()[0]:.1f} processes on average in the last minute",
        "versions": ", ".join(
            [f"Python {platform.python_version()}", *(f"{k} {v}" for k, v in versions.items())]
        ),
    }


def commit(root: Path) -> str:
    """The commit that is checked out, and whether anything but the pages of figures differs."""
    try:
        head = _git(root, "rev-parse", "--short=12", "HEAD").strip()
        changed = _git(root, "status", "--porcelain", "--", ".", *(f":!{page}" for page in PAGES))
    except (OSError, subprocess.CalledProcessError):
        return "unknown: this is no git checkout"
    files = len(changed.splitlines())
    return f"{head}, " + (f"with {files} files changed since" if files else "tree clean")


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True)
    return done.stdout


def machine() -> str:
    """Processor, cores, memory, system."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next(line.partition(":")[2].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        pass
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 1e-9
    return (
        f"{model}, {os.cpu_count()} cores, {memory_gb:.1f} GB, "
        f"{platform.system()} {platform.release()}"
    )
