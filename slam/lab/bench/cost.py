"""The parts of the benchmark about what is spent besides whole runs: scans, growth, starts."""

from __future__ import annotations

import json
import sys
from typing import Any, Final

from slam.lab.bench.growth import write_there_and_back
from slam.lab.bench.measure import SLAM, measure, measure_often
from slam.lab.bench.session import Part, Session
from slam.lab.page import Bar, Measured, Value, table

LOGS: Final = ("intel", "fr079")
CLOCKS: Final = {"cpu_ms": "CPU", "wall_ms": "wall"}


def scan_after_scan(session: Session) -> Measured:
    """Messages fed one by one through the API, each recording in a fresh process."""
    values, rows = [], []
    for name in LOGS:
        path = session.recordings / f"{name}.log.gz"
        used = measure([sys.executable, "-m", "slam.lab.bench.scans", str(path)])
        passes: dict[str, Any] = json.loads(used.out)
        warm = passes["warm"]["cpu_ms"]
        wall = passes["warm"]["wall_ms"]
        how = f"{warm['scans']} scans, median {warm['p50']:.2f} ms, maximum {warm['max']:.1f} ms"
        values.append(Value(warm["p99"], f"{how}; wall time p99 {wall['p99']:.2f} ms"))
        for which, clocks in passes.items():
            for clock, word in CLOCKS.items():
                times = clocks[clock]
                figures = (f"{times[key]:.2f}" for key in ("p50", "p99", "max"))
                rows.append((f"`{name}`", which, word, str(times["scans"]), *figures))
    head = ("", "pass", "clock", "scans", "median, ms", "p99, ms", "maximum, ms")
    return Measured(
        tuple(values),
        "`slam.pipeline.Slam` fed message by message in one process, odometry and loop search "
        "included, reading and final passes not. In the first pass each kernel is loaded from "
        "Numba's cache when it is first needed; the bars are for the second, with all of them "
        "there.\n\n" + table(head, rows),
    )


def growth(session: Session) -> Measured:
    """``intel`` forward, reversed and forward again as one recording, against once."""
    once = session.map_timed("intel.log.gz")
    path = session.scratch / "intel-there-and-back.log.gz"
    write_there_and_back(session.recordings / "intel.log.gz", path)
    thrice = session.map_recording(path, runs=session.runs)
    relations = str(session.recordings / "intel.relations")
    score = session.evaluate(thrice, "--relations", relations)["relations"]["scores"][0]
    few, many = once.usages.cpu_s, thrice.usages.cpu_s
    imports_s = session.imports.cpu_s.median
    without_imports = (many.median - imports_s) / (few.median - imports_s)
    rows = [
        (
            what,
            str(run.metrics()["scans"]),
            run.usages.cpu_s.words("s"),
            f"{run.usages.peak_mb:.0f}",
        )
        for what, run in (("once", once), ("forward, reversed, forward", thrice))
    ]
    return Measured(
        values=(
            Value(
                many.median / few.median,
                f"{many.median:.2f} s against {few.median:.2f} s; {without_imports:.2f} times "
                "without what imports cost",
            ),
        ),
        details=table(("`intel`", "scans", "CPU time of `slam run`", "peak, MB"), rows)
        + "\n\nOver the relations, which lie in the first third, the long recording scores "
        f"{score['abs_translation_m']['mean']:.4f} m and {score['abs_rotation_deg']['mean']:.3f}"
        f" deg (n = {score['count']}).",
    )


def start_up(session: Session) -> Measured:
    """The commands' start, and what a run imports."""
    help_, imports = measure_often([SLAM, "--help"], session.runs), session.imports
    return Measured(
        tuple(
            Value(used.cpu_s.median, f"wall time {used.wall_s.words('s')}")
            for used in (help_, imports)
        )
    )


def first_run(session: Session) -> Measured:
    """The demo with an empty cache of kernels, against the same with a full one."""
    cache = {"NUMBA_CACHE_DIR": str(session.scratch / "numba-cache")}
    command = [SLAM, "demo", "--force", "-o", str(session.scratch / "demo")]
    cold, warm = measure(command, cache), measure(command, cache)
    return Measured(
        values=(
            Value(
                cold.cpu_s - warm.cpu_s,
                f"`slam demo` {cold.cpu_s:.1f} s, then {warm.cpu_s:.1f} s; wall time "
                f"{cold.wall_s:.1f} s, then {warm.wall_s:.1f} s",
            ),
        )
    )


_logs: Final = tuple(f"{name}.log.gz" for name in LOGS)
PARTS: Final = (
    Part(
        "scans",
        "Scan after scan through the API",
        tuple(Bar(f"`{name}`, a scan through the API, p99 CPU", "ms", 10, 3) for name in LOGS),
        _logs,
        scan_after_scan,
    ),
    Part(
        "growth",
        "Cost as recordings grow",
        (Bar("`intel` forward, reversed, forward, CPU against once", "times", 4, 3),),
        ("intel.log.gz", "intel.relations"),
        growth,
    ),
    Part(
        "start-up",
        "Start-up",
        (Bar("`slam --help`, CPU", "s"), Bar("all imports of `slam run`, CPU", "s")),
        (),
        start_up,
    ),
    Part(
        "first-run",
        "First run",
        (Bar("compiling the kernels, CPU", "s", 60, None, 1),),
        (),
        first_run,
    ),
)
