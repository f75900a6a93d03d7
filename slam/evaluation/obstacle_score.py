"""How much of the obstacles a map shows, and how much of what it shows is there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from datasets.se2 import between, compose
from datasets.tf_tree import standing
from datasets.trajectory import Stamps, Trajectory
from slam.evaluation.obstacle_truth import (
    BESIDE_M,
    WITHIN_M,
    CameraView,
    ObstacleTruth,
    Sightings,
    by_visit,
)
from slam.evaluation.surfaces import Mask

TOLERANCE_M = 0.10
FOUND_SHARE = 0.5
VIEW_STEP_M, VIEW_STEP_RAD = 0.1, 0.1


@dataclass(frozen=True, slots=True)
class Share:
    """So many of so many."""

    hits: int
    total: int

    @property
    def value(self) -> float | None:
        """0 to 1; None of nothing."""
        return self.hits / self.total if self.total else None


@dataclass(frozen=True, slots=True)
class RecallPrecision:
    """recall : of the true cells of 5 cm x 5 cm. precision : of the map's cells."""

    recall: Share
    precision: Share

    @property
    def f1(self) -> float | None:
        """Their harmonic mean; 0 where nothing true is in the map; None if nothing is to find."""
        recall, precision = self.recall.value, self.precision.value
        if recall is None:
            return None
        if not precision or not recall:
            return 0.0
        return 2.0 * recall * precision / (recall + precision)


@dataclass(frozen=True, slots=True)
class ObjectScore:
    """One solid of the place: how many of its seen cells are in the map; of its low ones."""

    name: str
    cells: Share
    low_cells: Share

    @property
    def is_low(self) -> bool:
        """Whether it is an obstacle that the lidar passes over, all that was seen of it."""
        return self.low_cells.total == self.cells.total

    @property
    def found(self) -> bool:
        """Whether at least half of it is in the map."""
        return (self.cells.value or 0.0) >= FOUND_SHARE


@dataclass(frozen=True, slots=True)
class ObstacleScore:
    """Recall and precision of a map against the obstacles that the cameras could have seen.

    structure : all between 0.05 and 1.0 m.
    low       : what lies below the lidars' planes, as ``ObstacleTruth.low`` has it; its precision
                is that of the map's cells with nothing in the lidars' planes within 10 cm.
    objects   : every solid that was seen, by name.
    hit       : (C,) of the truth's cells, whether each is in the map.
    true_cell : (N,) of the map's cells, whether each shows something; ``judged`` says which were
                in a camera's view within 3.5 m; the others count nowhere.
    """

    structure: RecallPrecision
    low: RecallPrecision
    objects: tuple[ObjectScore, ...]
    hit: Mask
    true_cell: Mask
    judged: Mask

    @property
    def objects_found(self) -> Share:
        return Share(sum(item.found for item in self.objects), len(self.objects))

    @property
    def low_objects_found(self) -> Share:
        low = [item for item in self.objects if item.is_low]
        return Share(sum(item.found for item in low), len(low))


def score_obstacles(
    truth: ObstacleTruth, occupied_map: Array, T_map_base: Trajectory
) -> ObstacleScore:
    """Compare the occupied cells of a map or layer with the truth.

    occupied_map : (N, 2) m, centres of the occupied cells, in the frame of ``T_map_base``, the
                   estimated trajectory.

    The trajectory's error is taken out where it was made: what was seen from a pose is moved by
    T_map_base * inverse(true T_map_base) of that moment, once for each visit, and it is enough if
    one visit fits. A hit has an occupied cell's centre within 10 cm; an occupied cell is true
    if it lies within 10 cm of any static surface between 0.05 and 1.0 m or in a lidar's plane.
    Raises ValueError if the cells are not finite and (N, 2).
    """
    if occupied_map.ndim != 2 or occupied_map.shape[1] != 2 or not np.isfinite(occupied_map).all():
        raise ValueError(f"occupied cells {occupied_map.shape} must be finite and (N, 2)")
    seen = truth.sightings
    moved = _moved(
        truth.cells_map[seen.thing], seen.stamps_ns, source=truth.T_map_base, target=T_map_base
    )
    hit = np.zeros(len(truth.cells_map), dtype=np.bool_)
    hit[seen.thing[_distances_m(occupied_map, moved) <= TOLERANCE_M]] = True

    views = _cells_in_view(truth.views, occupied_map, T_map_base)
    back = _moved(
        occupied_map[views.thing], views.stamps_ns, source=T_map_base, target=truth.T_map_base
    )
    judged, true_cell, beneath = (np.zeros(len(occupied_map), dtype=np.bool_) for _ in range(3))
    judged[views.thing] = True
    true_cell[views.thing[_distances_m(truth.surfaces_map, back) <= TOLERANCE_M]] = True
    beneath[views.thing[_distances_m(truth.section_map, back) <= BESIDE_M]] = True
    claimed = judged & ~beneath
    return ObstacleScore(
        structure=RecallPrecision(
            Share(int(hit.sum()), hit.size),
            Share(int((true_cell & judged).sum()), int(judged.sum())),
        ),
        low=RecallPrecision(
            Share(int((hit & truth.low).sum()), int(truth.low.sum())),
            Share(int((true_cell & claimed).sum()), int(claimed.sum())),
        ),
        objects=_objects(truth, hit),
        hit=hit,
        true_cell=true_cell,
        judged=judged,
    )


def _objects(truth: ObstacleTruth, hit: Mask) -> tuple[ObjectScore, ...]:
    items = []
    for index in np.unique(truth.solid).tolist():
        own = truth.solid == index
        low = own & truth.low
        items.append(
            ObjectScore(
                truth.names[index],
                Share(int(hit[own].sum()), int(own.sum())),
                Share(int(hit[low].sum()), int(low.sum())),
            )
        )
    return tuple(sorted(items, key=lambda item: item.name))


def _moved(points: Array, stamps_ns: Stamps, *, source: Trajectory, target: Trajectory) -> Array:
    """Points seen at some stamps along one trajectory, as the other trajectory would place them."""
    flat = np.column_stack([points, np.zeros(len(points))])
    points_base = between(source.at(stamps_ns), flat)
    placed: Array = compose(target.at(stamps_ns), points_base)[:, :2]
    return placed


def _distances_m(to_points: Array, points: Array) -> Array:
    from scipy.spatial import cKDTree  # noqa: PLC0415

    if not len(to_points) or not len(points):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(to_points).query(points)[0])


def _cells_in_view(
    views: tuple[CameraView, ...], occupied_map: Array, T_map_base: Trajectory
) -> Sightings:
    """The nearest image of each visit that has a cell in its view, walls or not between them."""
    from scipy.spatial import cKDTree  # noqa: PLC0415

    found: list[tuple[Array, Array, Array]] = []
    tree = cKDTree(occupied_map)
    for view in views:
        rows = T_map_base.at(view.stamps_ns)
        for k in _apart(rows):
            T = standing(rows[k]) @ view.T_base_camera
            index = np.array(tree.query_ball_point(T[:2, 3], WITHIN_M), dtype=np.int64)
            offset = occupied_map[index] - T[:2, 3]
            ahead, aside = offset @ T[:2, 2], offset @ np.array([-T[1, 2], T[0, 2]])
            inside = np.abs(np.arctan2(aside, ahead)) <= view.half_view_rad
            distance_m = np.hypot(*offset[inside].T)
            found.append((index[inside], np.full(distance_m.size, view.stamps_ns[k]), distance_m))
    things, stamps_ns, distances_m = (
        np.concatenate([np.empty(0), *(row[k] for row in found)]) for k in range(3)
    )
    stamps_ns = np.concatenate([np.empty(0, np.int64), *(row[1] for row in found)])
    return by_visit(things.astype(np.int64), stamps_ns, distances_m)


def _apart(rows: Array) -> list[int]:
    """Indices of poses that differ from the last one taken by 10 cm or 0.1 rad."""
    taken: list[int] = []
    for k, row in enumerate(rows.tolist()):
        if taken:
            last = rows[taken[-1]]
            turn = abs(np.arctan2(np.sin(row[2] - last[2]), np.cos(row[2] - last[2])))
            near = np.hypot(row[0] - last[0], row[1] - last[1]) < VIEW_STEP_M
            if near and turn < VIEW_STEP_RAD:
                continue
        taken.append(k)
    return taken
