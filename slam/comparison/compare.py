"""A comparison: all runs that a recording allows, one after the other, side by side."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from datasets.errors import InputError
from datasets.open_recording import open_recording
from datasets.options import ReadOptions
from datasets.recording import Recording
from datasets.simulation.place import Place, load_place
from datasets.trajectory import Trajectory
from datasets.whole_folder import check_target, whole_folder
from slam.comparison.measures import (
    MapOfPart,
    camera_truth,
    lacked_by,
    map_figures,
    obstacle_figures,
    restored,
)
from slam.comparison.parts import BAYES_PART, CAMERA_PART, FUSED_PART, LIDAR_PART, Part, parts_of
from slam.comparison.picture import Panel, comparison_picture
from slam.comparison.table import panel_words, table_csv, table_markdown
from slam.config import Config, versions
from slam.evaluation.restoration import WIDTH_M, NotRestored
from slam.evaluation.structures_file import read_structures
from slam.mapping.layers import LayeredMap, bayes_combined
from slam.mapping.map_files import write_map
from slam.mapping.map_set import MAP_PICTURE
from slam.mapping.pictures import write_picture
from slam.runs.interruption import Interruption
from slam.runs.run import RESULTS, RunRequest, Watcher, run_recording
from slam.runs.run_folder import new_run_folder, read_run, write_json
from slam.runs.scores import run_scores
from slam.runs.structures import restoration_dict

PICTURE, MARKDOWN, CSV, JSON = "compare.png", "compare.md", "compare.csv", "compare.json"

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class CompareRequest:
    """What to compare and where to. out : None makes a new folder under ``results/``.

    extra      : PAPER_PART, UNION_PART, BAYES_PART, besides lidar, camera and fused.
    place      : of a simulated recording, a name or a file: for obstacles and structures.
    structures : a YAML file of lengths; their ends lie in the fused map.
    """

    recording: tuple[Path, ...]
    reading: ReadOptions = field(default_factory=ReadOptions)
    config: Config = field(default_factory=Config)
    out: Path | None = None
    force: bool = False
    extra: tuple[str, ...] = ()
    place: str | None = None
    structures: Path | None = None


@dataclass(frozen=True, slots=True)
class Compared:
    """What came of a comparison. rows : one for each map, plain data, as compare.json has it.

    partial : it was interrupted; the folder holds what was mapped so far.
    """

    folder: Path
    rows: tuple[Row, ...]
    partial: bool


def compare_recording(
    request: CompareRequest, watch: Watcher, interruption: Interruption
) -> Compared:
    """Run all that a recording allows and write the runs, a picture and a table, whole or not.

    A part from which no map comes is a row that says why. An interruption ends the part that is
    being mapped, as it ends a run, and leaves out those after it.

    Raises InputError if there is nothing to compare, no part has a map, or the folder cannot be
    written; KeyboardInterrupt as ``run_recording``.
    """
    if request.out is not None:
        check_target(request.out, force=request.force, replaceable=is_comparison)
    where = ", ".join(map(str, request.recording))
    recording = open_recording(request.recording, request.reading)
    if not recording.calibration.lidars and not recording.calibration.cameras:
        list(islice(recording, 1000))  # a log tells of its lidars while it is read
    parts = parts_of(recording.calibration, request.reading, request.config, where, request.extra)
    known = _Known.of(request, recording, where)
    folder = request.out or new_run_folder(RESULTS, f"{recording.name}-compare")
    with whole_folder(folder, force=request.force, replaceable=is_comparison) as staging:
        rows = [_run(request, part, staging, watch, interruption) for part in parts]
        if not any("grid" in row for row in rows):
            reasons = "; ".join(f"{row['name']}: {row['why']}" for row in rows)
            raise InputError(
                f"no map came of any part ({reasons})", where=where, remedy="See 'slam check'"
            )
        if BAYES_PART in request.extra:
            rows.append(_bayes(rows, staging, request.config))
        watch.stage("comparing the maps")
        _measure(rows, staging, known, request.config)
        partial = any(row["status"] in ("partial", "not run") for row in rows)
        watch.stage(f"writing {folder}")
        told = _write(staging, recording.name, rows, request, partial=partial)
    return Compared(folder, tuple(told), partial)


def is_comparison(folder: Path) -> bool:
    """Whether a comparison wrote this folder."""
    return all((folder / name).is_file() for name in (MARKDOWN, CSV, JSON))


@dataclass(frozen=True, slots=True)
class _Known:
    """What the maps can be compared with: a place and the truth in it, measured structures."""

    recording: Recording
    place: Place | None
    truth: Trajectory | None
    structures: tuple[Any, ...]

    @classmethod
    def of(cls, request: CompareRequest, recording: Recording, where: str) -> _Known:
        structures = read_structures(request.structures) if request.structures else ()
        if request.place is None:
            return cls(recording, None, None, structures)
        place, truth = load_place(request.place), recording.ground_truth()
        if truth is None:
            raise InputError(
                "it holds no ground truth, so nothing says where in the place it was",
                where=where,
                remedy="Leave out --place, or name the topic with --ground-truth",
            )
        return cls(recording, place, truth, structures)


class _Named:
    """A Watcher that says which part it is."""

    def __init__(self, watch: Watcher, name: str) -> None:
        self._watch, self._name = watch, name

    def stage(self, what: str) -> None:
        if not what.startswith("writing "):  # into a folder that is to be renamed
            self._watch.stage(f"{self._name}: {what}")

    def progress(self, scans: int, recorded_s: float, closures: int) -> None:
        self._watch.progress(scans, recorded_s, closures)


def _run(
    request: CompareRequest,
    part: Part,
    staging: Path,
    watch: Watcher,
    interruption: Interruption,
) -> Row:
    """One part, mapped, or why it wasn't. Its map stays in memory under ``grid``."""
    row: Row = {"name": part.name, "words": part.words, "why": None}
    if interruption.asked:
        return {**row, "status": "not run", "why": "interrupted before"}
    started, cpu_s = time.perf_counter(), time.process_time()
    wanted = RunRequest(request.recording, part.reading, part.config, staging / part.name)
    try:
        done = run_recording(wanted, _Named(watch, part.name), interruption)
    except (InputError, ValueError, RuntimeError) as error:
        why = error.what if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        watch.stage(f"{part.name}: no map: {why}")
        return {**row, "status": "failed", "why": why}
    metrics = done.run.metrics
    truth = (metrics["ground_truth"] or {}).get("error")
    loops = metrics["loops"]
    return {
        **row,
        "status": "partial" if done.run.partial else "ok",
        "way_m": metrics["way_m"],
        "duration_s": metrics["duration_s"],
        "scans": metrics["scans"],
        "scans_unmatched": sum(metrics["scans_unmatched"].values()),
        "lost": len(metrics["lost"]),
        "unobserved_way_m": metrics["unobserved_way_m"],
        "ate_m": truth["ate_translation_m"]["rmse"] if truth else None,
        "ate_deg": truth["ate_rotation_deg"]["rmse"] if truth else None,
        "loops_searched": loops["searched"],
        "loops_accepted": loops["closed"] + loops["taken_back"],
        "loops_kept": loops["closed"],
        "cpu_s": time.process_time() - cpu_s,
        "wall_s": time.perf_counter() - started,
        "grid": MapOfPart(done.grid, done.run.trajectory),
    }


def _bayes(rows: Sequence[Row], staging: Path, config: Config) -> Row:
    """The fused run's layers combined cell by cell: a map of its own, without a run."""
    row: Row = {"name": BAYES_PART, "words": "the fused map's layers by Bayes' rule", "why": None}
    fused = _row(rows, FUSED_PART)
    if fused is None or len(fused["grid"].grid.layers) < 2:
        return {**row, "status": "failed", "why": "there is no fused map with several layers"}
    own: MapOfPart = fused["grid"]
    assert isinstance(own.grid, LayeredMap)
    grid = bayes_combined(own.grid, config.map)
    (staging / BAYES_PART).mkdir()
    write_map(staging / BAYES_PART, grid, config.map)
    write_picture(staging / BAYES_PART / MAP_PICTURE, grid, config.map, own.trajectory)
    return {**row, "status": fused["status"], "grid": MapOfPart(grid, own.trajectory)}


def _row(rows: Sequence[Row], name: str) -> Row | None:
    return next((row for row in rows if row["name"] == name and "grid" in row), None)


def _measure(rows: Sequence[Row], staging: Path, known: _Known, config: Config) -> None:
    """What can be said of the maps when all are there, into the rows."""
    mapped = [row for row in rows if "grid" in row]
    for row in mapped:
        row["map"] = map_figures(row["grid"].grid, config.map)
        other = _row(rows, FUSED_PART if row["name"] == LIDAR_PART else LIDAR_PART)
        if other is not None:
            groups = lacked_by(row["grid"], other["grid"], config.map)
            row["lacked"] = {"by": other["name"], **groups}
    eyes = _row(rows, FUSED_PART) or _row(rows, CAMERA_PART)
    if known.place is not None and known.truth is not None and eyes is not None:
        scans = read_run(staging / eyes["name"]).scans
        truth = camera_truth(known.place, known.truth, known.recording.calibration, scans)
        for row in mapped:
            if truth is not None:
                row["obstacles"] = obstacle_figures(truth, row["grid"], config.map)
    _measure_runs(mapped, staging, known)


def _measure_runs(mapped: Sequence[Row], staging: Path, known: _Known) -> None:
    """What takes a run's scans: match scores, and structures.

    Those of a file have their ends in the fused map, or in the first there is.
    """
    base = _row(mapped, FUSED_PART) or mapped[0]
    of_file = [(each.structure, each.width_m) for each in known.structures]
    of_place = [] if known.place is None else list(known.place.structures.values())
    for row in mapped:
        if row["name"] == BAYES_PART:
            continue
        run = read_run(staging / row["name"])
        row["match_scores"] = asdict(run_scores(run.constraints, run.scans, run.trajectory))
        found = restored(of_file, run.scans, run.trajectory, base["grid"].trajectory)
        if known.truth is not None:
            wanted = [(each, WIDTH_M) for each in of_place]
            of_truth = restored(wanted, run.scans, run.trajectory, known.truth)
            # A drive through a part of a place does not see the rest.
            found += [each for each in of_truth if not isinstance(each, NotRestored)]
        if found:
            row["structures"] = [restoration_dict(each) for each in found]


def _write(
    staging: Path, name: str, rows: Sequence[Row], request: CompareRequest, *, partial: bool
) -> list[Row]:
    panels = [
        Panel(
            row["name"],
            panel_words(row),
            row["grid"].grid if "grid" in row else None,
            row["grid"].trajectory if "grid" in row else None,
            trusted=row["name"] in (LIDAR_PART, FUSED_PART),
        )
        for row in rows
    ]
    (staging / PICTURE).write_bytes(comparison_picture(panels, request.config.map))
    told = [{key: value for key, value in row.items() if key != "grid"} for row in rows]
    data = {
        "recording": [str(path) for path in request.recording],
        "partial": partial,
        "place": request.place,
        "structures": str(request.structures) if request.structures else None,
        "versions": versions(),
        "maps": told,
    }
    write_json(staging / JSON, data)
    (staging / CSV).write_text(table_csv(told), encoding="utf-8")
    (staging / MARKDOWN).write_text(table_markdown(name, told, partial=partial), encoding="utf-8")
    return told
