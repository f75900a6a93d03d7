"""What a command costs: CPU time, wall time, peak memory, as the operating system counts them."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

SLAM = str(Path(sys.executable).with_name("slam"))
"""The command as it is installed beside this interpreter."""


class CommandFailedError(Exception):
    """A command that was to be measured did not end with exit code 0."""


@dataclass(frozen=True, slots=True)
class Usage:
    """What one process used, its children included.

    cpu_s : user and system. peak_mb : largest resident memory, 10^6 bytes. out : its stdout.
    """

    cpu_s: float
    wall_s: float
    peak_mb: float
    out: str


@dataclass(frozen=True, slots=True)
class Spread:
    """Several measurements of one thing."""

    median: float
    low: float
    high: float
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Of at least one value."""
        return cls(statistics.median(values), min(values), max(values), len(values))

    def words(self, unit: str, decimals: int = 2) -> str:
        """Such as ``5.10 s (median of 3, 5.02 to 5.31)``."""
        text = f"{self.median:.{decimals}f} {unit}"
        if self.count == 1:
            return f"{text} (one run)"
        span = f"{self.low:.{decimals}f} to {self.high:.{decimals}f}"
        return f"{text} (median of {self.count}, {span})"


@dataclass(frozen=True, slots=True)
class Usages:
    """What several runs of one command used."""

    cpu_s: Spread
    wall_s: Spread
    peak_mb: float

    @classmethod
    def of(cls, usages: Sequence[Usage]) -> Self:
        """Of at least one run. The peak is the largest of all."""
        return cls(
            Spread.of([usage.cpu_s for usage in usages]),
            Spread.of([usage.wall_s for usage in usages]),
            max(usage.peak_mb for usage in usages),
        )


def measure(command: Sequence[str], environment: Mapping[str, str] | None = None) -> Usage:
    """Run a command to its end and say what it used.

    environment : variables over those of this process.

    It is started by a small process of its own (``python -m slam.lab.bench.measure``): the system
    counts to a process's peak what the one that started it had in memory.

    Raises CommandFailedError, which holds the last line of stderr, unless the exit code is 0.
    """
    with (
        tempfile.TemporaryFile("w+") as out,
        tempfile.TemporaryFile("w+") as err,
        tempfile.TemporaryFile("w+") as report,
    ):
        number = report.fileno()
        subprocess.run(
            [sys.executable, "-m", "slam.lab.bench.measure", str(number), *command],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            env={**os.environ, **(environment or {})},
            pass_fds=(number,),
            check=False,
        )
        for file in (out, err, report):
            file.seek(0)
        used = json.loads(report.read() or '{"code": "no start"}')
        if used["code"] != 0:
            last = (err.read().strip().splitlines() or ["nothing on stderr"])[-1]
            name = " ".join([Path(command[0]).name, *command[1:]])
            raise CommandFailedError(f"`{name}` ended with {used['code']}: {last}")
        return Usage(used["cpu_s"], used["wall_s"], used["peak_mb"], out.read())


def report_usage(number: int, command: Sequence[str]) -> None:
    """Run a command and write what it used to an open file, as JSON."""
    started = time.perf_counter()
    process = subprocess.Popen(command)
    _, status, used = os.wait4(process.pid, 0)
    wall_s = time.perf_counter() - started
    process.returncode = os.waitstatus_to_exitcode(status)  # it has been waited for
    unit = 1 if sys.platform == "darwin" else 1024
    report = {
        "code": process.returncode,
        "cpu_s": used.ru_utime + used.ru_stime,
        "wall_s": wall_s,
        "peak_mb": used.ru_maxrss * unit * 1e-6,
    }
    with open(number, "w", encoding="ascii") as file:
        json.dump(report, file)


def measure_often(command: Sequence[str], runs: int, *, warm_up: bool = True) -> Usages:
    """Run a command several times; before that once uncounted, which fills Numba's cache."""
    if warm_up:
        measure(command)
    return Usages.of([measure(command) for _ in range(runs)])


if __name__ == "__main__":
    report_usage(int(sys.argv[1]), sys.argv[2:])
