"""Progress of a run: a moving line on a terminal, one line a stage elsewhere; on stderr."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn


class StageLines:
    """A Watcher that writes each stage to stderr, and on a terminal shows how far it has come.

    duration_s : how much of the recording will be read, where that is known.
    """

    def __init__(self, *, quiet: bool = False, duration_s: float | None = None) -> None:
        self._quiet = quiet
        self._duration_s = duration_s
        self._console = Console(stderr=True, highlight=False, soft_wrap=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[detail]}"),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
            disable=quiet or not self._console.is_terminal,
        )
        self._task = self._progress.add_task("starting", total=None, detail="")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._progress.stop()

    def stage(self, what: str) -> None:
        """See ``slam.runs.run.Watcher``."""
        if not self._quiet:
            self._console.print(what, markup=False)
        self._progress.reset(self._task, description=what, total=None, detail="")

    def progress(self, scans: int, recorded_s: float, closures: int) -> None:
        """See ``slam.runs.run.Watcher``."""
        self._progress.update(
            self._task,
            total=self._duration_s,
            completed=recorded_s if self._duration_s else 0.0,
            detail=f"{scans} scans, {recorded_s:.0f} s, {closures} loops",
        )
