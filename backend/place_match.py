"""A place looked for in one submap: searched, aligned, and tested against what both saw."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from backend.free_space import Viewers
from backend.loop_attempt import (
    ACCEPTED,
    AMBIGUOUS,
    CONTRADICTED,
    NEAR_M,
    SLIDING,
    LoopAttempt,
    PlaceTask,
    attempted,
)
from backend.submap_maps import SubmapMaps
from datasets.messages import Array
from datasets.se2 import inverse, se2, transform, xyyaw
from frontend.local_map import FACING_BINS, LocalMap, facing_of
from frontend.match import Match, Rejected
from frontend.matching import APART_M, APART_RAD, match_surface, thinned, yaw_step_rad
from frontend.nodes import Node, Submap
from frontend.place_search_kernels import agreement
from frontend.prepared import PreparedScan
from fusion.scan import LIDAR_LAYER

SEARCH_BUDGET_BOXES: Final = 200_000
"""Boxes that a search of a window of 2 m and half a radian may score."""
QUERY_NEIGHBOURS: Final = 4
"""Nodes before and after a place that take part in its query."""
FACING_WINDOW_RAD: Final = 0.25
"""A window of yaws larger than this is first cut down by the way that surfaces face."""
FACING_SHARE: Final = 0.8
"""Yaws under which surfaces face the map's by less than this share of the best are left out."""
SEARCH_POINTS: Final = 120
"""Points of a place that the search lays on the field."""
SEARCH_REACH_M: Final = 15.0
"""Points farther away show a place only if it was driven through without any error of yaw."""
MAX_CONTRADICTION: Final = 0.15
"""Share of points that the other scans saw through; 0.13 is the 95th percentile of right ones."""
SLIDING_SIGMA_M: Final = 0.1
"""In windows above NEAR_M a match must show the position better than this in each direction."""
ENOUGH_NEAR: Final = (0.35, 0.25)
ENOUGH_FAR: Final = (0.5, 0.4)
"""Least score and inlier ratio, in windows below NEAR_M and in larger ones. Over the recordings
with a reference right closures had inlier ratios of 0.25 to 0.9, wrong ones up to 0.5."""
LAYER_CELLS: Final = 1 << 50
"""More than there are numbers of cells in a layer."""


class PlaceMatcher:
    """Searches submaps for places, and says of each search what it found or why nothing."""

    def __init__(self, maps: SubmapMaps, ambiguous_ratio: float) -> None:
        """ambiguous_ratio : a second place that scores this share of the best is a rival."""
        self._maps = maps
        self._ambiguous_ratio = ambiguous_ratio
        self._scan: tuple[int, PreparedScan] | None = None

    def search(self, task: PlaceTask) -> LoopAttempt:
        """Find the pose that lays the place best on the submap, and test it."""
        scan = self.query_scan(task.query, task.own)
        if scan.surface_count < 30:
            return attempted(task, "too few points on surfaces")
        local_map = self._maps.get(task.submap)
        points = thinned(_nearest(scan.points_base[scan.part(LIDAR_LAYER)]), SEARCH_POINTS)
        yaws = _yaws(local_map, scan, task.T_anchor_guess, task.window_rad, yaw_step_rad(points))
        min_score, _ = ENOUGH_NEAR if task.window_m < NEAR_M else ENOUGH_FAR
        found, x, y, yaw, score, _ = local_map.search_places(
            points,
            xyyaw(task.T_anchor_guess)[:2],
            yaws,
            task.window_m,
            min_score,
            _budget(task.window_m, task.window_rad),
        )
        if not found:
            return attempted(task, f"score below {min_score:g}")
        # the prior holds next to nothing
        match = match_surface(scan, local_map, se2(x, y, yaw), se2(x, y, yaw), (1.0, 1.0))
        if isinstance(match, Rejected):
            return attempted(task, match.reason, score)
        share = self._contradicted_share(task, scan, match)
        reason = _against(task, match, share)
        if reason is not None:
            return attempted(task, reason, score, 0.0, match, share)
        second = self._second_peak(task, points, yaws, (x, y, yaw, score))
        is_ambiguous = second >= self._ambiguous_ratio * score
        result = AMBIGUOUS if is_ambiguous else ACCEPTED
        return attempted(task, result, score, second, match, share)

    def _contradicted_share(self, task: PlaceTask, scan: PreparedScan, match: Match) -> float:
        """The share of the place's points that the submap's scans saw through, among those that
        they saw at all."""
        submap = task.submap
        points = scan.points_base[scan.part(LIDAR_LAYER)][::2]
        points = transform(match.T_frame_base, points)
        near = self._maps.get(submap).near(points)
        poses = [submap.T_anchor_base(node) for node in submap.nodes]
        through = ~near & (Viewers.of(submap.nodes, poses).seen_through(points) > 0)
        seen = int(np.count_nonzero(near)) + int(np.count_nonzero(through))
        return float(np.count_nonzero(through)) / max(seen, 1)

    def _second_peak(
        self, task: PlaceTask, points: Array, yaws: Array, best: tuple[float, float, float, float]
    ) -> float:
        """Score of the best pose but the best one; 0 where the window has no room for it."""
        if task.window_m < 1.0:
            return 0.0
        x, y, yaw, score = best
        budget = _budget(task.window_m, task.window_rad)
        found, _, _, _, second, boxes = self._maps.get(task.submap).search_places(
            points,
            xyyaw(task.T_anchor_guess)[:2],
            yaws,
            task.window_m,
            self._ambiguous_ratio * score,
            budget,
            (x, y, yaw, APART_M, APART_RAD),
        )
        if boxes > budget:
            return score  # not searched to the end: nobody knows
        return second if found else 0.0

    def query_scan(self, query: Node, own: Submap) -> PreparedScan:
        """The query's scan with those around it, about one point of each layer in each 10 cm."""
        if self._scan is not None and self._scan[0] == query.index:
            return self._scan[1]
        reach = QUERY_NEIGHBOURS
        near, points, normals = [], [], []
        T_base_anchor = inverse(own.T_anchor_base(query))
        for node in own.nodes:
            if abs(node.index - query.index) <= reach:
                T = T_base_anchor @ own.T_anchor_base(node)
                near.append(node.scan)
                points.append(transform(T, node.scan.points_base))
                normals.append(node.scan.normals_base @ T[:2, :2].T)
        all_points, all_normals = np.concatenate(points), np.concatenate(normals)
        layer = np.concatenate([scan.layer for scan in near])
        cells = np.floor(all_points / 0.1).astype(np.int64)
        # the cells of layer 0 come first, and so do its points
        keys = layer.astype(np.int64) * LAYER_CELLS + cells[:, 0] * 1_000_003 + cells[:, 1]
        _, kept = np.unique(keys, return_index=True)
        scan = PreparedScan(
            query.scan.stamp_ns,
            query.scan.moment_ns,
            query.scan.sensor,
            query.scan.origin_base,
            np.ascontiguousarray(all_points[kept]),
            np.ascontiguousarray(all_normals[kept]),
            np.zeros(len(kept)),
            layer[kept],
            np.concatenate([scan.weights for scan in near])[kept],
        )
        self._scan = (query.index, scan)
        return scan


def _against(task: PlaceTask, match: Match, contradicted_share: float) -> str | None:
    """What speaks against a match by itself."""
    _, min_inlier_ratio = ENOUGH_NEAR if task.window_m < NEAR_M else ENOUGH_FAR
    if match.inlier_ratio < min_inlier_ratio:
        return f"inlier ratio below {min_inlier_ratio:g}"
    if contradicted_share > MAX_CONTRADICTION:
        return CONTRADICTED
    if (task.window_m > NEAR_M or task.of is not None) and match.weak_sigma_m > SLIDING_SIGMA_M:
        return SLIDING
    return None


def _yaws(
    local_map: LocalMap, scan: PreparedScan, T_guess: Array, window_rad: float, step_rad: float
) -> Array:
    """(K,) the yaws of a window under which the scan's surfaces face as those of the map do."""
    steps = math.ceil(min(window_rad, math.pi) / step_rad)
    yaws: Array = xyyaw(T_guess)[2] + step_rad * np.arange(-steps, steps + 1, dtype=np.float64)
    if window_rad < FACING_WINDOW_RAD:
        return yaws
    fits = np.empty(FACING_BINS)
    agreement(local_map.facing, facing_of(scan.normals_base[scan.part(LIDAR_LAYER)]), fits)
    near = np.maximum(fits, np.maximum(np.roll(fits, 1), np.roll(fits, -1)))
    at = np.round(yaws / (2.0 * math.pi) * FACING_BINS).astype(np.int64) % FACING_BINS
    kept: Array = yaws[near[at] >= FACING_SHARE * near[at].max()]
    return kept


def _nearest(points_base: Array) -> Array:
    """The points within SEARCH_REACH_M, or the SEARCH_POINTS nearest where there are fewer.

    Farther ones are of the same place only if it was driven through without any error of yaw.
    """
    away_m = np.hypot(points_base[:, 0], points_base[:, 1])
    enough = min(SEARCH_POINTS, len(away_m)) - 1
    reach_m = max(SEARCH_REACH_M, float(np.partition(away_m, enough)[enough]))
    near: Array = points_base[away_m <= reach_m]
    return near


def _budget(window_m: float, window_rad: float) -> int:
    """How many boxes a search may score: enough for its window, so that it seldom runs out."""
    return int(SEARCH_BUDGET_BOXES * max(1.0, (window_m / 2.0) ** 2 * (window_rad / 0.5)))
