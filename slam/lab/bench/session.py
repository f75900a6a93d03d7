"""The commands that the parts of the benchmark measure, and what a part is."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from slam.lab.bench.measure import SLAM, Usages, measure, measure_often
from slam.lab.page import Bar, Measured

IMPORTS = (
    "import slam.cli, slam.runs.run, "
    "cv2, gtsam, scipy.sparse.csgraph, scipy.sparse.linalg, scipy.spatial"
)
"""What ``slam run`` imports until it is done."""


@dataclass(frozen=True, slots=True)
class MappedRecording:
    """A run folder and what it cost to make."""

    folder: Path
    usages: Usages

    def metrics(self) -> dict[str, Any]:
        """What the run says of itself."""
        text = (self.folder / "metrics.json").read_text(encoding="utf-8")
        metrics: dict[str, Any] = json.loads(text)
        return metrics


@dataclass
class Session:
    """One run of the benchmark.

    recordings : folder of the recordings. scratch : an empty folder for what is written.
    runs       : how often what is timed is run.
    """

    recordings: Path
    scratch: Path
    runs: int
    _mapped: dict[tuple[str, ...], MappedRecording] = field(default_factory=dict)

    def map_timed(self, file: str) -> MappedRecording:
        """``slam run FILE``, warmed up and run several times; once for all parts that ask."""
        return self.map_recording(self.recordings / file, runs=self.runs, warm_up=True)

    def map_recording(
        self, path: Path, *options: str, runs: int = 1, warm_up: bool = False
    ) -> MappedRecording:
        """``slam run PATH OPTIONS``. The same is not done twice."""
        key = (str(path), *options, str(runs))
        if key not in self._mapped:
            folder = self.scratch / f"run-{len(self._mapped):02d}"
            command = [SLAM, "run", str(path), "-o", str(folder), "--force", "--quiet", *options]
            usages = measure_often(command, runs, warm_up=warm_up)
            self._mapped[key] = MappedRecording(folder, usages)
        return self._mapped[key]

    def evaluate(self, run: MappedRecording, *options: str) -> dict[str, Any]:
        """``slam evaluate RUN OPTIONS`` as data."""
        path = self.scratch / "evaluation.json"
        measure([SLAM, "evaluate", str(run.folder), *options, "--json", str(path)])
        data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return data

    @cached_property
    def imports(self) -> Usages:
        """What it costs to import all that a run imports."""
        return measure_often([sys.executable, "-c", IMPORTS], self.runs)


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the benchmark: what it needs, and how it is measured.

    needs : files in the folder of recordings. measure raises CommandFailedError if a command
    fails, InputError if what it left can't be evaluated.
    """

    name: str
    title: str
    bars: tuple[Bar, ...]
    needs: tuple[str, ...]
    measure: Callable[[Session], Measured]
