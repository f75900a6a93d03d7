"""A run: a recording is read, mapped, finished, drawn and written as a run folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from backend.pose_graph_files import write_pose_graph
from datasets.errors import InputError
from datasets.normalise import MASKED
from datasets.open_recording import open_recording
from datasets.options import ReadOptions
from datasets.recording import Recording
from datasets.trajectory import Trajectory
from slam.config import Config, effective, versions
from slam.mapping.layers import LayeredMap, draw_map
from slam.mapping.occupancy import MapConfig
from slam.mapping.scan_records import Poses
from slam.pipeline import Slam
from slam.runs.cost import timing_of
from slam.runs.graph_table import constraint_table
from slam.runs.interruption import Interrupted, Interruption
from slam.runs.kernel_cache import kernels_are_compiled
from slam.runs.parts import Part, parts_of_run
from slam.runs.run_folder import Run, check_run_target, new_run_folder, write_run
from slam.runs.summary import metrics_of

RESULTS = Path("results")
REPORT_EVERY = 50


@dataclass(frozen=True, slots=True)
class RunRequest:
    """What to map and where to. out : None makes a new folder under ``results/``."""

    recording: tuple[Path, ...]
    reading: ReadOptions = field(default_factory=ReadOptions)
    config: Config = field(default_factory=Config)
    out: Path | None = None
    force: bool = False


class Watcher(Protocol):
    """Somebody who wants to know how far a run has come."""

    def stage(self, what: str) -> None:
        """Something new begins."""

    def progress(self, scans: int, recorded_s: float, closures: int) -> None:
        """So many scans are mapped, which were recorded over so many seconds."""


@dataclass(frozen=True, slots=True)
class RunDone:
    """What came of a run. partial : it was interrupted, the folder holds what was mapped so far."""

    folder: Path
    run: Run
    grid: LayeredMap


def run_recording(request: RunRequest, watch: Watcher, interruption: Interruption) -> RunDone:
    """Map a recording and write its run folder, whole or not at all.

    An interruption while reading ends the reading, one in the final passes leaves these out; both
    give a run folder that says it is partial.

    Raises InputError if no run can come from the recording or the folder cannot be written,
    KeyboardInterrupt if the interruption comes twice or before the first scan.
    """
    clock = _Clock()
    if request.out is not None:
        check_run_target(request.out, force=request.force)
    recording = open_recording(request.recording, _reading(request))
    check_run_target(_folder(request, recording), force=request.force)
    compiled = kernels_are_compiled(views=bool(recording.calibration.cameras))
    if not compiled:
        watch.stage("compiling the kernels: once, it may take a minute")

    watch.stage(f"mapping {recording.name}")
    pipeline = Slam(request.config, recording.calibration)
    with clock.stage("reading and mapping"):
        _map(recording, pipeline, watch, interruption)
    _require_scans(request, recording, pipeline, interruption)

    watch.stage("last scan read, closing loops and matching once more")
    with clock.stage("finishing"):
        poses = _finish(pipeline, interruption)
    is_partial = interruption.asked

    watch.stage("drawing the map")
    with clock.stage("drawing"):
        largest, *others = parts_of_run(pipeline, poses)
        trajectory = largest.poses.trajectory
        grid = draw_map(largest.scans, trajectory, request.config.map)
        beside = [_drawn(part, request.config.map) for part in others]
    with clock.stage("comparing with ground truth"):
        metrics = metrics_of(recording, pipeline, poses.T_map_scans, trajectory, grid)
    run = Run(
        trajectory=trajectory,
        odometry=_odometry(pipeline),
        scans=largest.scans,
        constraints=constraint_table(pipeline, poses.T_map_nodes),
        write_graph=partial(write_pose_graph, graph=pipeline.graph(), form="g2o"),
        metrics=metrics,
        timing=timing_of(metrics, clock.stages_s, pipeline.seconds, kernels_compiled=not compiled),
        config=_provenance(request),
        partial=is_partial,
    )
    folder = _folder(request, recording)
    watch.stage(f"writing {folder}")
    write_run(folder, run, grid, request.config.map, beside, force=request.force)
    return RunDone(folder, run, grid)


def _drawn(part: Part, config: MapConfig) -> tuple[Trajectory, LayeredMap]:
    trajectory = part.poses.trajectory
    return trajectory, draw_map(part.scans, trajectory, config)


def _reading(request: RunRequest) -> ReadOptions:
    """What is read: nothing of sensors that take no part."""
    reading, sensors = request.reading, request.config.sensors
    return replace(
        reading,
        use_cameras=reading.use_cameras and sensors != "lidar",
        use_lidars=reading.use_lidars and sensors != "camera",
    )


def _folder(request: RunRequest, recording: Recording) -> Path:
    return request.out or new_run_folder(RESULTS, recording.name)


def _map(recording: Recording, pipeline: Slam, watch: Watcher, interruption: Interruption) -> None:
    """Feed the pipeline. A scan that it can't take costs itself only."""
    reported = 0
    for message in recording:
        _bearing_bad_scans(pipeline, partial(pipeline.add, message))
        count = len(pipeline.records)
        if count >= reported + REPORT_EVERY:
            reported = count
            recorded_s = (pipeline.records[-1].stamp_ns - pipeline.records[0].stamp_ns) * 1e-9
            watch.progress(count, recorded_s, len(pipeline.global_slam.closures))
        if interruption.asked:
            watch.stage("interrupted: finishing with what was read; once more breaks off")
            break
    while not _bearing_bad_scans(pipeline, pipeline.flush):
        pass


def _bearing_bad_scans(pipeline: Slam, work: Callable[[], object]) -> bool:
    """Do work on scans; False if one of them was bad, which is counted with the reason."""
    try:
        work()
    except ValueError as error:
        pipeline.left_out[f"scan left out: {error}"] += 1
        return False
    return True


def _require_scans(
    request: RunRequest, recording: Recording, pipeline: Slam, interruption: Interruption
) -> None:
    """Raise InputError if nothing can come from what was read."""
    if any(len(record.points_base) for record in pipeline.records):
        return
    if interruption.asked:
        raise KeyboardInterrupt
    what = "no scan in it can be used"
    if pipeline.records:
        what = f"not one beam of its {len(pipeline.records)} scans can be used"
    reasons = (recording.notes + pipeline.left_out).most_common(3)
    if reasons:
        what += " (" + ", ".join(f"{reason}: {count}" for reason, count in reasons) + ")"
    reading = request.reading
    narrowing = {
        "--start": reading.start_s > 0.0,
        "--duration": reading.duration_s is not None,
        f"--lidar {' '.join(reading.lidars)}": bool(reading.lidars),
        f"the masks of {reading.calibration}": recording.notes[MASKED] > 0,
    }
    asked = ", ".join(option for option, used in narrowing.items() if used)
    raise InputError(
        what,
        where=", ".join(map(str, request.recording)),
        remedy=f"Try without {asked}" if asked else "'slam check' says what is in it",
    )


def _finish(pipeline: Slam, interruption: Interruption) -> Poses:
    """The final poses; if the final passes are interrupted, those from before them."""
    so_far = pipeline.poses()
    try:
        with interruption.breaking_off():
            pipeline.finish()
    except Interrupted:
        return so_far
    return pipeline.poses()


def _odometry(pipeline: Slam) -> Trajectory | None:
    """All odometry that was used, at its own stamps; None if there is none."""
    if not pipeline.odometry:
        return None
    return Trajectory.from_matrices(
        [message.stamp_ns for message in pipeline.odometry],
        [message.T_odom_base for message in pipeline.odometry],
    )


def _provenance(request: RunRequest) -> dict[str, Any]:
    """What ``config.yaml`` says: enough to do the run again."""
    return {
        "recording": [str(path) for path in request.recording],
        "reading": asdict(request.reading),
        "versions": versions(),
        "config": effective(request.config),
    }


class _Clock:
    """Wall seconds by stage."""

    def __init__(self) -> None:
        self.stages_s: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.stages_s[name] = time.perf_counter() - started
