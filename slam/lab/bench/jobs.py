"""Work of the benchmark in fresh processes of its own, as many at once as there are cores."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

J = TypeVar("J")
R = TypeVar("R")


def side_by_side(work: Callable[[J], R], jobs: Iterable[J]) -> list[R]:
    """What comes of each job, in their order. ``work`` is a function of a module."""
    with _fresh(os.cpu_count() or 1) as pool:
        return list(pool.map(work, jobs))


def alone(work: Callable[[J], R], job: J) -> R:
    """What comes of one job while nothing else of the benchmark runs."""
    with _fresh(1) as pool:
        return pool.submit(work, job).result()


def keep_to(cores: int) -> None:
    """Let this process use so many cores only; call it before libraries start their threads."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])


def _fresh(processes: int) -> ProcessPoolExecutor:
    # Not forked: a copy of this process would begin with all that it holds in memory.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(processes, mp_context=context, max_tasks_per_child=1)
