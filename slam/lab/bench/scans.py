"""How long each scan takes when messages are fed one by one, as on a robot.

``python -m slam.lab.bench.scans RECORDING`` prints it as JSON. It is a program of its own so that
each recording is measured in a fresh process.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from datasets.messages import Message
from datasets.open_recording import open_recording
from datasets.options import ReadOptions
from datasets.recording import Calibration
from slam.config import Config
from slam.pipeline import Slam

PASSES = ("first", "warm")
"""In the first pass through the recording each kernel is loaded from Numba's cache when it is
first needed; in the second all are there."""


def time_scans(messages: Sequence[Message], calibration: Calibration) -> dict[str, list[float]]:
    """Milliseconds for each scan, as ``wall_ms`` and ``cpu_ms`` (all threads).

    A scan's time is that of all calls of ``Slam.add`` since the scan before, those that took the
    odometry between them included. The final passes are not: they come after the last scan.
    """
    slam = Slam(Config(), calibration)
    wall_ms, cpu_ms = [], []
    wall_ns = cpu_ns = 0
    for message in messages:
        wall_start_ns, cpu_start_ns = time.perf_counter_ns(), time.process_time_ns()
        scans = slam.add(message)
        cpu_ns += time.process_time_ns() - cpu_start_ns
        wall_ns += time.perf_counter_ns() - wall_start_ns
        if scans:
            wall_ms += [wall_ns * 1e-6 / len(scans)] * len(scans)
            cpu_ms += [cpu_ns * 1e-6 / len(scans)] * len(scans)
            wall_ns = cpu_ns = 0
    return {"wall_ms": wall_ms, "cpu_ms": cpu_ms}


def summary(times_ms: Sequence[float]) -> dict[str, float]:
    """What is said of the times of all scans."""
    p50, p99 = np.percentile(times_ms, [50.0, 99.0]).tolist()
    return {"p50": p50, "p99": p99, "max": max(times_ms), "scans": len(times_ms)}


def main(path: Path) -> None:
    """Measure a recording and print the summaries by pass and clock."""
    recording = open_recording([path], ReadOptions())
    messages = list(recording)
    passes = {name: time_scans(messages, recording.calibration) for name in PASSES}
    print(
        json.dumps(
            {
                name: {clock: summary(times_ms) for clock, times_ms in clocks.items()}
                for name, clocks in passes.items()
            }
        )
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
