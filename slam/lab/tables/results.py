"""The folder that the tables are written to: a page, CSV files, pictures; and each seed's rows."""

from __future__ import annotations

import resource
import shutil
import sys
import time
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path

from datasets.errors import InputError
from datasets.whole_file import write_whole
from slam.config import versions
from slam.lab.drives.constraints import PROTOCOL
from slam.lab.drives.drives import Job
from slam.lab.drives.rows import Rows
from slam.lab.drives.seeds import write_csv
from slam.lab.page import circumstances, commit
from slam.lab.tables.page import page
from slam.runs.cost import peak_memory_mb

ROOT = Path(__file__).resolve().parents[3]


class Results:
    """Where results go. The rows of a seed are kept as soon as all its drives are done."""

    def __init__(self, folder: Path, page_elsewhere: Path | None) -> None:
        self.folder = folder
        self.page = folder / "results.md"
        self.pictures = folder
        self._elsewhere = page_elsewhere
        self._commit = commit(ROOT)
        self._waiting: Counter[tuple[str, int]] = Counter()
        self._rows: dict[tuple[str, int], Rows] = {}
        self._begun_s = self._tables_done_s = time.monotonic()

    def begin(self, jobs: Sequence[Job]) -> None:
        """Be told what will be done. Raises InputError if the folder can't be made."""
        self._waiting = Counter(_group(job) for job in jobs)
        self._begun_s = self._tables_done_s = time.monotonic()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for each in (self._elsewhere,) if self._elsewhere else ():
                each.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"this folder can't be made ({error.strerror or error})",
                where=str(error.filename or self.folder),
                remedy="Give a folder in a place where you may write, with -o or --page",
            ) from error

    def keep(self, job: Job, rows: Rows) -> None:
        """Take the rows of a drive; those of a whole seed are written at once."""
        group = _group(job)
        if job.condition is None:
            self._tables_done_s = time.monotonic()
        self._rows.setdefault(group, Rows()).extend(rows)
        self._waiting[group] -= 1
        if not self._waiting[group]:
            condition, seed = group
            name = f"seed-{seed}" + (f"-{condition.replace(' ', '-')}" if condition else "")
            write_csv(self.folder / "seeds" / name, self._rows.pop(group))

    def finish(self, results: Sequence[Rows], tables: Collection[int], command: str) -> str:
        """Write page and CSV of all that was done. Returns the page."""
        rows = Rows()
        for each in results:
            rows.extend(each)
        write_csv(self.folder / "csv", rows)
        pictures = sorted(path.name for path in self.folder.glob("results-*.png"))
        facts = circumstances(ROOT, command, versions(), self._commit)
        facts["table 5"] = PROTOCOL
        facts["memory"] = (
            f"{_peak_memory_mb():.0f} MB at the most in a process, all systems of a drive"
        )
        minutes = (self._tables_done_s - self._begun_s) / 60.0
        text = page(rows, tables, facts, pictures, minutes)
        write_whole(self.page, text.encode())
        if self._elsewhere is not None:
            for name in pictures:
                shutil.copyfile(self.folder / name, self._elsewhere.parent / name)
            write_whole(self._elsewhere, text.encode())
        return text


def _peak_memory_mb() -> float:
    """Of this process and of those that worked for it, the one that had the most."""
    unit = 1 if sys.platform == "darwin" else 1024
    children_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * unit * 1e-6
    return max(peak_memory_mb(), children_mb)


def _group(job: Job) -> tuple[str, int]:
    return (job.condition.name if job.condition else "", job.seed)
