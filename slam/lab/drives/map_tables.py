"""What is read off the maps and the graph of a drive: corners, corridors, obstacles, closures."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from backend.loop_attempt import ACCEPTED
from datasets.messages import Array
from datasets.se2 import xyyaw
from datasets.simulation.place import Place
from datasets.trajectory import Trajectory
from slam.evaluation.obstacle_score import ObstacleScore, RecallPrecision, score_obstacles
from slam.evaluation.obstacle_truth import ObstacleTruth
from slam.evaluation.restoration import (
    WIDTH_M,
    WINDOW_M,
    Ghosted,
    Restored,
    ends_in_map,
    restoration,
)
from slam.evaluation.trajectory_error import trajectory_error
from slam.lab.drives.constraint_truth import constraint_errors
from slam.lab.drives.footprint import footprint_corner
from slam.lab.drives.map_points import CornerFound, find_corner
from slam.lab.drives.mapping import Mapped
from slam.lab.drives.rows import (
    ClosureRow,
    ObstacleRow,
    PointRow,
    RestorationRow,
    TrajectoryRow,
)
from slam.lab.drives.systems import BAYES
from slam.mapping.layers import bayes_combined
from slam.mapping.occupancy import occupied_cells
from slam.mapping.scan_store import CAMERA, LIDAR
from slam.runs.graph_table import kept_closures


def point_rows(seed: int, place: Place, mapped: Mapped) -> list[PointRow]:
    """The corner of each of the place's named obstacles, in map coordinates as they are."""
    points, walls = mapped.points_map(LIDAR)[0], None
    if CAMERA in mapped.map.layers:
        points, walls = mapped.points_map(CAMERA)[0], points
    rows = []
    for name in place.points:
        corner = footprint_corner(place, name)
        found = find_corner(corner, points, walls_map=walls)
        x_m, y_m = corner.corner_m.tolist()
        row = (seed, mapped.system.name, name, x_m, y_m)
        if isinstance(found, CornerFound):
            at_x_m, at_y_m = found.position_map.tolist()
            rows.append(PointRow(*row, at_x_m, at_y_m, found.error_m, found.how))
        else:
            rows.append(PointRow(*row, None, None, None, f"not found: {found.reason}"))
    return rows


def restoration_rows(
    condition: str, seed: int, place: Place, mapped: Mapped, truth: Trajectory
) -> list[RestorationRow]:
    """Each of the place's structures, in the lidar layer."""
    points, origins = mapped.points_map(LIDAR)
    rows = []
    for structure in place.structures.values():
        ends = ends_in_map(structure, mapped.poses.trajectory, truth)
        # The measure looks no further; a drive has millions of points.
        near = _near(points, ends)
        found = restoration(structure, points[near], origins_map=origins[near], ends_map=ends)
        row = (condition, seed, mapped.system.name, structure.name, structure.length_m)
        if isinstance(found, Restored):
            measured = (found.measured_m, found.gamma_percent, found.std_m)
            rows.append(RestorationRow(*row, *measured, "restored"))
        elif isinstance(found, Ghosted):
            lengths = ", ".join(f"{length_m:.3f} m" for length_m in found.measured_m)
            note = f"ghosted at its {' and '.join(found.ends)}: {lengths}"
            rows.append(RestorationRow(*row, None, None, None, note))
        else:
            rows.append(RestorationRow(*row, None, None, None, f"not found: {found.reason}"))
    return rows


def _near(points: Array, ends_map: tuple[Array, Array]) -> npt.NDArray[np.bool_]:
    """Which points lie where the ends of a structure are looked for, and somewhat further."""
    reach_m = WINDOW_M + WIDTH_M
    near = np.zeros(len(points), dtype=np.bool_)
    for end in ends_map:
        near |= (np.abs(points - end) <= reach_m).all(axis=1)
    return near


def obstacle_rows(
    condition: str, seed: int, mapped: Mapped, truth: ObstacleTruth, *, bayes: bool = False
) -> list[ObstacleRow]:
    """Of the map as a robot uses it; with ``bayes`` also of its layers put together so."""
    drawn = {mapped.system.name: mapped.occupied_map()}
    if bayes:
        config = mapped.slam.config.map
        combined = bayes_combined(mapped.map, config)
        drawn[BAYES] = occupied_cells(combined, combined.classes(config))
    rows = []
    for name, occupied in drawn.items():
        score = score_obstacles(truth, occupied, mapped.poses.trajectory)
        rows += _obstacle_rows(condition, seed, name, score)
    return rows


def _obstacle_rows(
    condition: str, seed: int, system: str, score: ObstacleScore
) -> list[ObstacleRow]:
    missed = [each.name for each in score.objects if each.is_low and not each.found]
    rows = []
    for what, found, objects in (
        ("all", score.structure, score.objects_found),
        ("low", score.low, score.low_objects_found),
    ):
        pair: RecallPrecision = found
        rows.append(
            ObstacleRow(
                condition,
                seed,
                system,
                what,
                pair.recall.hits,
                pair.recall.total,
                pair.precision.hits,
                pair.precision.total,
                pair.recall.value,
                pair.precision.value,
                pair.f1,
                objects.hits,
                objects.total,
                ", ".join(missed),
            )
        )
    return rows


def closure_row(condition: str, seed: int, mapped: Mapped, truth: Trajectory) -> ClosureRow:
    """The closures of a system's own search against the truth, before and after they are judged."""
    slam = mapped.slam
    attempts = slam.global_slam.search.attempts
    accepted = [attempt for attempt in attempts if attempt.result == ACCEPTED]
    kept_by_id = kept_closures(slam)
    kept = np.array([kept_by_id.get(id(attempt), False) for attempt in accepted], dtype=np.bool_)
    errors = constraint_errors(
        np.array([a.submap.anchor.scan.moment_ns for a in accepted], dtype=np.int64),
        np.array([a.query.scan.moment_ns for a in accepted], dtype=np.int64),
        np.array([xyyaw(a.T_anchor_base) for a in accepted]).reshape(-1, 3),
        truth,
    )
    known = kept & np.isfinite(errors.translation_m)
    metres, degrees = errors.translation_m[known], errors.rotation_deg[known]
    return ClosureRow(
        condition,
        seed,
        mapped.system.name,
        len(attempts),
        len(accepted),
        int(kept.sum()),
        int(errors.false.sum()),
        int((errors.false & kept).sum()),
        _mean(metres),
        _mean(degrees),
        float(metres.max()) if metres.size else None,
    )


def trajectory_row(
    condition: str, place: str, seed: int, mapped: Mapped, truth: Trajectory
) -> TrajectoryRow:
    """ATE of the final trajectory."""
    error = trajectory_error(mapped.poses.trajectory, truth)
    local = mapped.slam.local
    return TrajectoryRow(
        condition,
        place,
        seed,
        mapped.system.name,
        error.translation_m.rmse,
        error.rotation_deg.rmse,
        local.unobserved_m,
        len(local.lost_ns),
        mapped.cpu_s,
    )


def _mean(values: Array) -> float | None:
    return float(values.mean()) if values.size else None
