"""The map in layers: each sees the world at its own height, and frees only what it saw itself.

A lidar at 0.9 m passes over a box of 0.3 m, so in one grid its rays would erase what a camera, or
a lower lidar, saw there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from datasets.recording import Calibration
from datasets.trajectory import Trajectory
from slam.mapping.occupancy import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    Classes,
    Extent,
    MapConfig,
    OccupancyGrid,
    Probabilities,
    blocks_of,
    classes_of,
    draw_grid,
    extent_of,
)
from slam.mapping.scan_store import CAMERA, LIDAR, VAGUE, ScanStore
from slam.mapping.stray_hits import without_strays
from slam.mapping.vague_surfaces import without_explained

SAME_HEIGHT_M = 0.1
"""Lidars nearer to each other in height see the same things, all but a few."""
SUREST = 0.98
"""By Bayes' rule no layer is more certain than this, or it could not be contradicted."""


@dataclass(frozen=True, slots=True)
class LayeredMap:
    """A grid for each layer, all on the same cells; taken together, what a robot drives by.

    layers : at least one, by name, in alphabetical order.

    Raises ValueError if there is none or if their cells differ.
    """

    layers: Mapping[str, OccupancyGrid]

    def __post_init__(self) -> None:
        places = {(g.corner_map_m, g.resolution_m, g.shape) for g in self.layers.values()}
        if len(places) != 1:
            raise ValueError(f"{len(self.layers)} layers lie on {len(places)} rasters, not on one")

    @property
    def _first(self) -> OccupancyGrid:
        return next(iter(self.layers.values()))

    @property
    def corner_map_m(self) -> tuple[float, float]:
        """(x, y), m, map frame, of the lower left corner of cell [0, 0]."""
        return self._first.corner_map_m

    @property
    def resolution_m(self) -> float:
        """The side of a cell."""
        return self._first.resolution_m

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in cells."""
        return self._first.shape

    def classes(self, config: MapConfig) -> Classes:
        """(height, width): OCCUPIED where any layer says so: a robot is as high as all of them.

        Else UNKNOWN where a layer has votes that don't agree, FREE where at least one layer saw
        it free. A layer that knows nothing of a cell is not asked: a camera looks at a part only.
        """
        out = np.empty(self.shape, np.uint8)
        for rows in blocks_of(self.shape[0]):
            out[rows] = self._classes_of_rows(rows, config)
        return out

    def _classes_of_rows(self, rows: slice, config: MapConfig) -> Classes:
        weight = config.hit_weight
        first, *others = (grid.probability(weight, rows) for grid in self.layers.values())
        out = classes_of(first, config)
        torn = (out == UNKNOWN) & ~np.isnan(first)
        for probability in others:
            classes = classes_of(probability, config)
            torn |= (classes == UNKNOWN) & ~np.isnan(probability)
            out[(classes == FREE) & (out == UNKNOWN)] = FREE
            out[classes == OCCUPIED] = OCCUPIED
        out[torn & (out == FREE)] = UNKNOWN
        return out


@dataclass(frozen=True, slots=True)
class ProbabilityGrid:
    """A map known by the probabilities of its cells only: (height, width), NaN where unknown."""

    corner_map_m: tuple[float, float]
    resolution_m: float
    probability: Probabilities

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in cells."""
        height, width = self.probability.shape
        return height, width

    def classes(self, config: MapConfig) -> Classes:
        """(height, width) of UNKNOWN, FREE, OCCUPIED by the thresholds."""
        return classes_of(self.probability, config)


def draw_map(scans: ScanStore, T_map_base: Trajectory, config: MapConfig) -> LayeredMap:
    """Draw each layer's scans at the poses a trajectory gives for their stamps, on common cells.

    The votes of depth cameras have a bounded memory (``config.camera_memory``): what they saw
    stays until they look through the place where it was; what they saw vaguely counts where no
    surer view of any layer explains it. Sensors of one layer, as in the paper's single grid, share
    its votes.

    Raises ValueError if there is no scan.
    """
    extent = extent_of(scans, T_map_base, config)
    vague = scans.roles == VAGUE
    if not vague.any():
        return _drawn(scans, T_map_base, config, extent)
    surer = _drawn(scans.with_points(~vague), T_map_base, config, extent)
    occupied = surer.classes(config) == OCCUPIED
    scans = without_explained(scans, T_map_base, extent, occupied)
    return _drawn(scans, T_map_base, config, extent)


def _drawn(
    scans: ScanStore, T_map_base: Trajectory, config: MapConfig, extent: Extent
) -> LayeredMap:
    """Each layer by itself; what a lidar's noise put behind walls is left out."""
    layers = {}
    for name in scans.layer_names:
        own = scans.of_layer(name)
        memory = config.camera_memory if name == CAMERA else math.inf
        grid = draw_grid(own, T_map_base, config, extent, memory)
        if name != CAMERA:
            grid = without_strays(own, T_map_base, config, grid)
        layers[name] = grid
    return LayeredMap(layers)


def bayes_combined(layers: LayeredMap, config: MapConfig) -> ProbabilityGrid:
    """The layers fused per cell by Bayes' rule: the log odds of their probabilities added.

    For comparison: it takes all layers for independent views of one and the same thing, so that
    a lidar that passes over a box speaks against it. NaN where no layer has a vote.
    """
    total = np.zeros(layers.shape, np.float32)
    seen = np.zeros(layers.shape, np.bool_)
    for grid in layers.layers.values():
        probability = grid.probability(config.hit_weight)
        voted = ~np.isnan(probability)
        bounded = np.clip(probability[voted], 1.0 - SUREST, SUREST)
        total[voted] += np.log(bounded / (1.0 - bounded))
        seen |= voted
    probability = np.full(layers.shape, np.nan, np.float32)
    probability[seen] = 1.0 / (1.0 + np.exp(-total[seen]))
    return ProbabilityGrid(layers.corner_map_m, layers.resolution_m, probability)


def layer_names(calibration: Calibration) -> dict[str, str]:
    """The layer of the map for each lidar and camera, by the sensor's name.

    All cameras share one. So do lidars, if no two that are neighbours in height stand
    ``SAME_HEIGHT_M`` or more apart; otherwise each group is a layer named by its mean height.
    """
    heights = {name: float(c.T_base_lidar[2, 3]) for name, c in calibration.lidars.items()}
    ordered = sorted(heights, key=lambda name: (heights[name], name))
    groups: list[list[str]] = [ordered[:1]] if ordered else []
    for lower, upper in pairwise(ordered):
        if heights[upper] - heights[lower] >= SAME_HEIGHT_M:
            groups.append([])
        groups[-1].append(upper)
    names = dict.fromkeys(calibration.cameras, CAMERA)
    for group in groups:
        mean_m = sum(heights[name] for name in group) / len(group)
        layer = LIDAR if len(groups) == 1 else f"{LIDAR} {mean_m:.2f} m"
        names |= dict.fromkeys(group, layer)
    return names
