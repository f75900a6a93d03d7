"""What a run cost: as data for timing.json and in words."""

from __future__ import annotations

import os
import platform
import resource
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def timing_of(
    metrics: Mapping[str, Any],
    stages_s: Mapping[str, float],
    parts_s: Mapping[str, float],
    *,
    kernels_compiled: bool,
) -> dict[str, Any]:
    """What timing.json holds, up to now.

    stages_s : wall time of the stages of the run. parts_s : of the parts of the pipeline in them.
    """
    wall_s = sum(stages_s.values())
    return {
        "cpu_s_of_process": time.process_time(),
        "wall_s": wall_s,
        "times_real_time": metrics["duration_s"] / wall_s if wall_s > 0.0 else None,
        "peak_memory_mb": peak_memory_mb(),
        "stages_wall_s": dict(stages_s),
        "parts_wall_s": dict(parts_s),
        "kernels_compiled": kernels_compiled,
        "machine": f"{platform.machine()}, {os.cpu_count()} CPUs, {platform.system()}",
        "python": platform.python_version(),
    }


def peak_memory_mb() -> float:
    """The most memory that this process had at once, in MB (10^6 bytes).

    Linux tells it of the program alone; rusage also counts what its parent had before.
    """
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        peak = next(line for line in status.splitlines() if line.startswith("VmHWM:"))
        return int(peak.split()[1]) * 1024 * 1e-6
    except (OSError, StopIteration, ValueError):
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit * 1e-6


def cost_lines(timing: Mapping[str, Any]) -> list[str]:
    """The cost of a run in a line."""
    compiled = ", kernels compiled" if timing["kernels_compiled"] else ""
    return [
        f"{timing['cpu_s_of_process']:.1f} s CPU, {timing['wall_s']:.1f} s wall time"
        f"{compiled}; {timing['times_real_time']:.0f} times real time; "
        f"{timing['peak_memory_mb']:.0f} MB at the most"
    ]
