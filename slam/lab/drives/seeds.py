"""All drives of all seeds, two at a time, each in a process of its own; what is done is kept."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from pathlib import Path

from datasets.whole_folder import whole_folder
from slam.lab.drives.drives import Job, run_job
from slam.lab.drives.rows import FailureRow, Rows

THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
"""One thread a process: the processes share the cores already."""

Report = Callable[[Job, Rows], None]


def run_all(jobs: Sequence[Job], workers: int, done: Report) -> list[Rows]:
    """Do all jobs. Returns their rows in the order of the jobs, whatever the number of workers.

    done : is told of each job when it ends. A job that fails is a row that says so. With one
    worker the work is done in this process.
    """
    if workers == 1:
        results = []
        for job in jobs:
            results.append(attempt(job))
            done(job, results[-1])
        return results
    for name in THREAD_LIMITS:
        os.environ.setdefault(name, "1")
    context = multiprocessing.get_context("spawn")
    by_job: dict[int, Rows] = {}
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_leave_to_parent) as pool:
        numbers: dict[Future[Rows], int] = {
            pool.submit(attempt, job): number for number, job in enumerate(jobs)
        }
        try:
            for future in as_completed(numbers):
                number = numbers[future]
                by_job[number] = future.result()
                done(jobs[number], by_job[number])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
    return [by_job[number] for number in range(len(jobs))]


def _leave_to_parent() -> None:
    """Ctrl-C reaches all processes of a terminal: only the first one answers, and ends the rest."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def attempt(job: Job) -> Rows:
    """The rows of a job; if it fails as a whole, one row that says why."""
    try:
        return run_job(job)
    except Exception as error:
        condition = job.condition.name if job.condition else ""
        reason = f"{type(error).__name__}: {error}"
        row = FailureRow(condition, job.place, job.seed, "all systems", "the whole drive", reason)
        return Rows(failures=[row])


def write_csv(folder: Path, rows: Rows) -> None:
    """The rows as CSV files in a folder that appears whole or not at all.

    Raises InputError if there is something else in its place.
    """
    with whole_folder(folder, force=True, replaceable=_holds_only_csv) as staging:
        for name, text in rows.csv_texts().items():
            (staging / name).write_text(text, encoding="utf-8")


def _holds_only_csv(folder: Path) -> bool:
    return all(path.suffix == ".csv" for path in folder.iterdir())
