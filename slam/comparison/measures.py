"""What is measured of each map of a comparison: what it has that another lacks, what is true."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.recording import Calibration
from datasets.se2 import between, compose
from datasets.simulation.place import Place, Structure
from datasets.trajectory import Trajectory
from slam.evaluation.obstacle_score import ObstacleScore, score_obstacles
from slam.evaluation.obstacle_truth import CameraView, ObstacleTruth, obstacle_truth
from slam.evaluation.restoration import Restoration, ends_in_map
from slam.mapping.occupancy import FREE, OCCUPIED, UNKNOWN, MapConfig, Raster, occupied_cells
from slam.mapping.scan_store import ScanStore
from slam.runs.structures import measured

APART_M = 0.15
"""An occupied cell farther than this from all of another map's is not in that map."""
ROUNDING_M = 1e-6
LEAST_CELLS = 2
"""Smaller groups of cells are not counted: a single one may be the noise of a range."""

Figures = dict[str, Any]


@dataclass(frozen=True, slots=True)
class MapOfPart:
    """A map with the trajectory that it was drawn along."""

    grid: Raster
    trajectory: Trajectory


def map_figures(grid: Raster, config: MapConfig) -> Figures:
    """How large the known part of a map is, what of it is free and what occupied."""
    classes = grid.classes(config)
    known = classes != UNKNOWN
    side_m = grid.resolution_m

    def extent_m(axis: int) -> float:
        at = np.flatnonzero(known.any(axis=axis))
        return float(at[-1] + 1 - at[0]) * side_m if at.size else 0.0

    return {
        "width_m": extent_m(0),
        "height_m": extent_m(1),
        "resolution_m": side_m,
        "free_m2": float(np.count_nonzero(classes == FREE)) * side_m**2,
        "occupied_cells": int(np.count_nonzero(classes == OCCUPIED)),
    }


def lacked_by(own: MapOfPart, other: MapOfPart, config: MapConfig) -> Figures:
    """What stands in one map and not in the other: connected groups of occupied cells.

    A cell counts if no occupied cell of the other map lies within APART_M of it, after it was
    moved by how the two trajectories differ at the pose of its own that is nearest to it: where
    they drift apart walls are no obstacles. Cells that touch, corners included, are one group;
    groups of fewer than LEAST_CELLS are left out.

    groups, area_m2 : how many, and the area of their cells. free_groups : those of which the
    other map calls half or more free, rather than unknown: a robot would drive into them.
    """
    from scipy import ndimage  # noqa: PLC0415
    from scipy.spatial import cKDTree  # noqa: PLC0415

    grid = own.grid
    classes = grid.classes(config)
    centres = occupied_cells(grid, classes)
    moved = _moved(centres, own.trajectory, other.trajectory)
    theirs = occupied_cells(other.grid, other.grid.classes(config))
    away_m = np.full(len(centres), np.inf)
    if len(theirs) and len(centres):
        away_m = np.asarray(cKDTree(theirs).query(moved)[0])
    new = away_m > APART_M + ROUNDING_M
    mask = np.zeros(grid.shape, np.bool_)
    rows, columns = np.nonzero(classes == OCCUPIED)
    mask[rows[new], columns[new]] = True
    numbers, count = ndimage.label(mask, np.ones((3, 3)))
    of_cell = numbers[rows[new], columns[new]]
    sizes = np.bincount(of_cell, minlength=count + 1)
    free = np.bincount(
        of_cell, _class_at(other.grid, moved[new], config) == FREE, minlength=count + 1
    )
    large = sizes >= LEAST_CELLS
    return {
        "groups": int(large.sum()),
        "area_m2": float(sizes[large].sum()) * grid.resolution_m**2,
        "free_groups": int((large & (free >= 0.5 * sizes)).sum()),
    }


def _moved(points_map: Array, own: Trajectory, other: Trajectory) -> Array:
    """Points of one map, where the other one should have them."""
    from scipy.spatial import cKDTree  # noqa: PLC0415

    if not len(points_map):
        return points_map
    nearest = np.asarray(cKDTree(own.xyyaw[:, :2]).query(points_map)[1])
    flat = np.column_stack([points_map, np.zeros(len(points_map))])
    points_base = between(own.xyyaw[nearest], flat)
    return compose(other.at(own.stamps_ns[nearest]), points_base)[:, :2]


def _class_at(grid: Raster, points_map: Array, config: MapConfig) -> npt.NDArray[np.int64]:
    """(N,) the class of the cell of each point; -1 beyond the map."""
    height, width = grid.shape
    cells = np.floor((points_map - grid.corner_map_m) / grid.resolution_m).astype(np.int64)
    inside = ((cells >= 0) & (cells < [width, height])).all(axis=1)
    found = np.full(len(points_map), -1, np.int64)
    found[inside] = grid.classes(config)[cells[inside, 1], cells[inside, 0]]
    return found


def camera_truth(
    place: Place, truth: Trajectory, calibration: Calibration, scans: ScanStore
) -> ObstacleTruth | None:
    """The obstacles of a place that the cameras could have seen; None without a camera.

    truth : of the simulated drive, in the frame of the place, from the drive's first moment on.
    scans : of a run that took the cameras' images in, for their stamps.
    """
    views = []
    for name, camera in sorted(calibration.cameras.items()):
        if camera.T_base_camera is None or camera.intrinsics is None or name not in scans.sensors:
            continue
        stamps_ns = scans.stamps_ns[scans.sensor_index == scans.sensors.index(name)]
        views.append(CameraView(camera.T_base_camera, camera.intrinsics, stamps_ns))
    if not any(view.stamps_ns.size for view in views):
        return None
    heights_m = sorted(float(each.T_base_lidar[2, 3]) for each in calibration.lidars.values())
    return obstacle_truth(place, truth, views, heights_m, int(truth.stamps_ns[0]))


def obstacle_figures(truth: ObstacleTruth, own: MapOfPart, config: MapConfig) -> Figures:
    """Recall, precision and F1, of all that stands and of what is low, and the objects."""
    occupied = occupied_cells(own.grid, own.grid.classes(config))
    score: ObstacleScore = score_obstacles(truth, occupied, own.trajectory)
    figures: Figures = {}
    for name, of in (("all", score.structure), ("low", score.low)):
        figures[name] = {
            "recall": of.recall.value,
            "precision": of.precision.value,
            "f1": of.f1,
            "true_cells": of.recall.total,
        }
    low = score.low_objects_found
    return {**figures, "low_objects_found": low.hits, "low_objects": low.total}


def restored(
    structures: Sequence[tuple[Structure, float]],
    scans: ScanStore,
    trajectory: Trajectory,
    reference: Trajectory,
) -> list[Restoration]:
    """The structures in a run's map.

    structures : with their widths, m; their ends lie in the frame of ``reference``: the truth for
    those of a place, another run's trajectory for those of a file.
    """
    return measured(
        [
            (structure, ends_in_map(structure, trajectory, reference), width_m)
            for structure, width_m in structures
        ],
        scans,
        trajectory,
    )
