"""Free space as evidence: a wall of one place within what another place's scans saw to be free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from backend import free_space_kernels
from datasets.messages import Array
from datasets.se2 import xyyaw
from frontend.nodes import Node
from fusion.scan import LIDAR_LAYER

GAP_RAD: Final = 0.04
"""Two beams farther apart than this have nothing known between them."""
MARGIN_M: Final = 0.3
MARGIN_SHARE: Final = 0.02
"""A beam must end this far behind a point, and this share of its distance, to have passed it."""


@dataclass(frozen=True, slots=True)
class Viewers:
    """Scans that can say of a point whether they saw through it, in one frame.

    poses    : (V, 3) sensors: x m, y m, and the yaw of their bases, rad.
    starts, bearings, ranges : see ``free_space_kernels.seen_through``.
    """

    poses: Array
    starts: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    bearings: Array
    ranges: Array

    @classmethod
    def of(cls, nodes: Sequence[Node], T_frame_nodes: Sequence[Array]) -> Viewers:
        """The scans of some nodes at their poses (3, 3) in a frame."""
        poses = np.zeros((len(nodes), 3))
        bearings, ranges, counts = [], [], [0]
        for row, (node, T_frame_base) in enumerate(zip(nodes, T_frame_nodes, strict=True)):
            scan = node.scan
            part = scan.part(LIDAR_LAYER)
            poses[row, :2] = T_frame_base[:2, :2] @ scan.origin_base + T_frame_base[:2, 2]
            poses[row, 2] = xyyaw(T_frame_base)[2]
            rays = scan.points_base[part] - scan.origin_base
            bearings.append(scan.bearings_rad[part])
            ranges.append(np.hypot(rays[:, 0], rays[:, 1]))
            counts.append(len(rays))
        starts = np.cumsum(counts).astype(np.int64)
        return cls(poses, starts, np.concatenate(bearings), np.concatenate(ranges))

    def seen_through(self, points: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
        """(N,) how many of the scans saw free space where each point (N, 2) is."""
        out = np.empty(len(points), dtype=np.int64)
        free_space_kernels.seen_through(
            np.ascontiguousarray(points),
            self.poses,
            self.starts,
            self.bearings,
            self.ranges,
            GAP_RAD,
            MARGIN_M,
            MARGIN_SHARE,
            out,
        )
        return out
