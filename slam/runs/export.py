"""Write the map of a finished run again: other cells, thresholds, one layer, walls on the axes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from datasets.errors import InputError
from datasets.tum import write_tum
from datasets.whole_folder import whole_folder
from slam.mapping.layers import LayeredMap, draw_map
from slam.mapping.map_set import write_map_set
from slam.mapping.occupancy import MapConfig, OccupancyGrid
from slam.mapping.wall_alignment import WallDirection, find_wall_direction, map_points, turned
from slam.runs.run_folder import TRAJECTORY, Run, is_run_folder, read_run


@dataclass(frozen=True, slots=True)
class Export:
    """What was written.

    grid  : the map.
    walls : the direction the walls had before they were turned onto the axes; None if not asked.
    """

    folder: Path
    grid: LayeredMap
    walls: WallDirection | None


def export_run(
    run_folder: Path,
    out: Path,
    *,
    resolution_m: float | None = None,
    occupied_threshold: float | None = None,
    free_threshold: float | None = None,
    max_range_m: float | None = None,
    align_walls: bool = False,
    layer: str | None = None,
    force: bool = False,
) -> Export:
    """Write the maps, their pictures and trajectory.tum of a run into a folder of their own.

    What is None stays as the run had it (``config.map`` in its config.yaml). With a ``layer`` the
    map holds what its sensors saw and nothing else. With ``align_walls`` map and trajectory are
    turned together about the map's origin, by at most 45 degrees. The run folder stays as it is.

    Raises InputError if the run cannot be read or has no such layer, the map would be too large at
    this resolution, or ``out`` exists (unless ``force`` and an export wrote it) or cannot be
    written.
    """
    run = read_run(run_folder)
    asked = {
        "resolution_m": resolution_m,
        "occupied_threshold": occupied_threshold,
        "free_threshold": free_threshold,
        "max_range_m": max_range_m,
    }
    config = _config(run_folder, run, {k: v for k, v in asked.items() if v is not None})
    trajectory, walls = run.trajectory, None
    if align_walls:
        walls = find_wall_direction(map_points(run.scans, trajectory, config.max_range_m))
        if walls is None:
            raise InputError(
                "there are no walls to align to",
                where=str(run_folder),
                remedy="Export without --align-walls.",
            )
        trajectory = turned(trajectory, walls.yaw_rad)
    grid = draw_map(run.scans, trajectory, config)
    if resolution_m is not None and grid.resolution_m != resolution_m:
        raise InputError(
            f"the map would be too large in cells of {resolution_m:g} m",
            where=str(run_folder),
            remedy=f"Ask for {grid.resolution_m:g} m or more, or a shorter --max-range.",
        )
    if layer is not None:
        grid = LayeredMap({layer: _layer(run_folder, grid, layer)})
    with whole_folder(out, force=force, replaceable=_is_export) as staging:
        write_map_set(staging, grid, config, trajectory)
        write_tum(staging / TRAJECTORY, trajectory)
    return Export(out, grid, walls)


def _layer(run_folder: Path, drawn: LayeredMap, layer: str) -> OccupancyGrid:
    if layer not in drawn.layers:
        raise InputError(
            f"this run has no layer '{layer}'",
            where=str(run_folder),
            remedy="It has: " + ", ".join(f"'{name}'" for name in drawn.layers),
        )
    return drawn.layers[layer]


def _config(run_folder: Path, run: Run, asked: dict[str, float]) -> MapConfig:
    section = run.config.get("config", {})
    section = section.get("map", {}) if isinstance(section, dict) else section
    try:
        if not isinstance(section, dict):
            raise TypeError("config.map is no section")
        return MapConfig(**{**section, **asked})
    except (ValidationError, TypeError) as error:
        detail = str(error)
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            detail = ": ".join([*map(str, first["loc"]), first["msg"]])
        raise InputError(
            f"the map cannot be drawn so ({detail})",
            where=str(run_folder),
            remedy="Check the options, and config.map in the run's config.yaml.",
        ) from error


def _is_export(folder: Path) -> bool:
    return (folder / "map.yaml").is_file() and not is_run_folder(folder)
