"""Nodes and submaps of drives that were tracked well but for a steady drift."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from backend.global_slam import GlobalSlam
from backend.loop_search import LoopConfig
from datasets.messages import Array
from datasets.se2 import inverse, se2
from frontend.match import Match, Rejected
from frontend.motion import Motion
from frontend.nodes import Node, NodeConfig, NodeKeeper, Submap
from frontend.prepared import prepare
from frontend.tracker import LOST, Tracked
from tests.frontend.low_things import with_low
from tests.frontend.rooms import Line, fused, way_through

ROUND_THE_RING: Line = ((1.0, 1.0), (11.0, 1.0), (11.0, 8.0), (1.0, 8.0), (1.0, 1.0))
TWICE_ROUND = (*ROUND_THE_RING, *ROUND_THE_RING[1:])
OUT_AND_BACK: Line = ((0.0, 0.1), (14.0, 0.1), (0.0, -0.1))


@dataclass
class Laps:
    """T_world_nodes : (N, 3, 3), the truth. parts : (N,) which part of the drive a node is of."""

    nodes: list[Node]
    submaps: list[Submap]
    T_world_nodes: Array
    parts: list[int]

    def T_world_anchors(self) -> Array:
        return self.T_world_nodes[[submap.anchor.index for submap in self.submaps]]

    def T_odom_nodes(self) -> Array:
        return np.array([node.T_odom_base for node in self.nodes])


def laps(
    *parts: tuple[Array, Line],
    seed: int = 0,
    drift_rad_per_m: float = 0.0015,
    scale: float = 1.005,
    max_range_m: float = 8.0,
    lost: bool = False,
    lost_turn_rad: float = 0.0,
    low: Array | tuple[Array, ...] | None = None,
) -> Laps:
    """A drive along corners in each part's walls, one after the other.

    For the robot each part begins where the last ended, wherever it is in truth.
    lost : whether local SLAM notices that it lost the thread between the parts; then its odom
        frame goes on turned by lost_turn_rad.
    low : (S, 4) low walls that a camera sees; a tuple: those of each part.
    """
    random = np.random.default_rng(seed)
    keeper = NodeKeeper(NodeConfig())
    T_world: list[Array] = []
    part_of: list[int] = []
    T_odom = np.eye(3)
    for number, (walls, corners) in enumerate(parts):
        poses = way_through(corners, 0.25)
        for k, T in enumerate(poses):
            step = inverse(poses[k - 1]) @ T if k else np.eye(3)
            way, turn = float(step[0, 2]), math.atan2(step[1, 0], step[0, 0])
            T_odom = T_odom @ se2(scale * way, 0.0, turn + drift_rad_per_m * way)
            seen = fused(walls, T, beams=240, noise_m=0.01, random=random, max_range_m=max_range_m)
            things = low[number] if isinstance(low, tuple) else low
            scan = prepare(seen if things is None else with_low(seen, things, T), np.zeros(3))
            motion = Motion(step, 0.02, 0.03, np.zeros(3), 0.25, True)
            outcome: Match | Rejected = Match(
                T_odom, np.eye(3), 0.9, 0.9, 0.01, 0.01, np.array([1.0, 0.0])
            )
            if lost and number and not k:
                T_odom = T_odom @ se2(0.0, 0.0, lost_turn_rad)
                outcome = Rejected(LOST)
            node, _ = keeper.add(Tracked(scan, T_odom, outcome, motion))
            if node is not None:
                T_world.append(T)
                part_of.append(number)
    keeper.finish()
    return Laps(keeper.nodes, keeper.submaps, np.array(T_world), part_of)


def searched(drive: Laps, config: LoopConfig | None = None) -> GlobalSlam:
    """Global SLAM over all submaps, every search done before the next submap comes."""
    slam = GlobalSlam(config or LoopConfig(), drive.nodes, drive.submaps)
    for submap in drive.submaps:
        slam.add_submap(submap)
        while slam.search.waiting:
            slam.step()
    return slam


def errors(T_world: Array, T_map: Array) -> Array:
    """(N, 2) m and rad between poses, the first ones laid on each other."""
    aligned = T_world[0] @ np.linalg.inv(T_map[0]) @ T_map
    off = np.linalg.inv(T_world) @ aligned
    return np.column_stack(
        [np.hypot(off[:, 0, 2], off[:, 1, 2]), np.abs(np.arctan2(off[:, 1, 0], off[:, 0, 0]))]
    )
