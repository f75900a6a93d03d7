"""The final passes: match again what overlaps under the new poses, optimise, until it rests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from backend import _kernels
from backend.constraint import inverted
from backend.global_slam import LOST_SIGMA
from backend.graph import optimise
from backend.graph_arrays import ConstraintArrays, Indices, joined
from backend.mountings import MountingOffset, combined, corrected, mounting_offsets
from backend.overlaps import overlapping_pairs, views_of
from datasets.messages import Array
from datasets.se2 import between, pose_matrices, xyyaw_rows
from datasets.section import Section
from frontend.matching import INFORMATION_PER_POINT, observed
from frontend.nodes import Node
from frontend.prepared import SIGMA_M
from fusion.scan import LIDAR_LAYER

STEP_CAUTION = 2.0
"""The covariance of local SLAM's steps is divided by this here: it is cautious, since it bounds
where loops are looked for. A scan matched to the map of the last metres knows the way along a
corridor far better than pairs of scans do, which see few points that face that way: in a simulated
ring local SLAM errs along by 9 mm over 20 m, and pairs believed more than it made that 35 mm.
From 1 to 25 the ATE there is the same within a tenth."""

STEP_YAW_SIGMA = 0.02
"""rad, added to every step: how the scans are turned the pairs know better, and front ends differ
in how their steps scatter (KISS-ICP's by 3 mrad)."""


class RefineConfig(Section):
    """The final passes over all nodes."""

    mountings: bool = Field(True, description="correct lidars that stand not as they are said to")
    passes: int = Field(3, ge=0, description="at the most so many")
    settled_m: float = Field(0.005, gt=0.0, description="end when nodes move less on average")
    reach_m: float = Field(2.5, gt=0.0, description="nodes nearer than this are matched")
    neighbours: int = Field(5, ge=1, description="nodes of other times that each is matched with")
    min_inlier_ratio: float = Field(0.35, gt=0.0, lt=1.0, description="below: not used")


@dataclass(frozen=True, slots=True)
class Refined:
    """What the final passes came to.

    nodes       : as given, with lidars moved to where they really stand (``offsets``).
    T_map_nodes : (N, 3, 3).
    offsets     : of the lidars that stand elsewhere than their mounting says, corrected here.
    held        : what took part beside the pairs: local SLAM's steps from node to node, and the
                  closures.
    pairs       : the matches of the last pass, as constraints between nodes.
    rms_m       : (M,) of each pair's points against each other's surface.
    tried       : pairs matched in the last pass, accepted or not.
    moved_m     : mean move of the nodes in each pass.
    """

    nodes: tuple[Node, ...]
    T_map_nodes: Array
    offsets: tuple[MountingOffset, ...]
    held: ConstraintArrays
    pairs: ConstraintArrays
    rms_m: Array
    tried: int
    moved_m: tuple[float, ...]


class NodeScans:
    """The scans of all nodes, one after the other, as the kernel takes them: their main layer.

    What a camera alone saw has held local SLAM's steps and the closures, which take part here
    where the pairs leave a direction open, as along a bare corridor with boxes.
    """

    def __init__(self, nodes: Sequence[Node]) -> None:
        scans = [node.scan for node in nodes]
        main = [scan.part(LIDAR_LAYER) for scan in scans]
        counts = [scan.main_count for scan in scans]
        self.starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        pairs = list(zip(scans, main, strict=True))
        self.points = np.concatenate([scan.points_base[part] for scan, part in pairs])
        self.normals = np.concatenate([scan.normals_base[part] for scan, part in pairs])
        self.bearings = np.concatenate([scan.bearings_rad[part] for scan, part in pairs])
        self.origins = np.array([scan.origin_base for scan in scans])
        self.noise = np.array([scan.noise for scan in scans])

    def match(
        self, from_nodes: Indices, to_nodes: Indices, nodes_xyyaw: Array, iterations: int
    ) -> tuple[ConstraintArrays, Array]:
        """Match pairs from the present poses. Returns constraints and (M, 4) statistics: points
        tried, matched, sum of weights, rms m."""
        count = len(from_nodes)
        xyyaw = np.zeros((count, 3))
        information = np.zeros((count, 3, 3))
        stats = np.zeros((count, 4))
        _kernels.match_pairs(
            from_nodes,
            to_nodes,
            nodes_xyyaw,
            self.starts,
            self.points,
            self.normals,
            self.bearings,
            self.origins,
            100,
            0.15,
            0.1,
            0.03,
            SIGMA_M,
            iterations,
            1.0,
            xyyaw,
            information,
            stats,
        )
        noise = np.maximum(self.noise[from_nodes], self.noise[to_nodes])
        information = observed(information, stats[:, 2], noise)
        information *= (INFORMATION_PER_POINT / noise**2)[:, None, None]
        return ConstraintArrays(from_nodes, to_nodes, xyyaw, information), stats


def refine(
    nodes: Sequence[Node], T_map_nodes: Array, closures: ConstraintArrays, config: RefineConfig
) -> Refined:
    """Bring the nodes to where their scans agree best, starting from nearly right poses.

    T_map_nodes : (N, 3, 3), within some decimetres and degrees.
    closures    : loop closures between nodes, which hold places together that no pair does; once a
                  lidar is moved to where it stands they no longer take part.

    In each pass each node's scan is matched to those of its neighbours in space; all matches, the
    closures and the steps of local SLAM are optimised together, outliers weighted down (Huber).
    """
    poses = xyyaw_rows(T_map_nodes)
    nothing = ConstraintArrays.of([])
    if len(nodes) < 2:
        return Refined(tuple(nodes), T_map_nodes, (), nothing, nothing, np.empty(0), 0, ())
    scans = NodeScans(nodes)
    held = joined(steps_between(nodes), closures)
    views = views_of(scans.bearings, scans.starts)
    offsets: dict[str, MountingOffset] = {}
    moved: list[float] = []
    pairs, rms, tried = nothing, np.empty(0), 0
    for turn in range(config.passes):
        from_nodes, to_nodes = overlapping_pairs(poses, views, config.reach_m, config.neighbours)
        every, stats = scans.match(from_nodes, to_nodes, poses, 4 if turn == 0 else 2)
        inliers = stats[:, 2] / np.maximum(stats[:, 0], 1.0)
        kept = (stats[:, 1] > 20) & (inliers > config.min_inlier_ratio)
        pairs, rms, tried = every.pick(kept), stats[kept, 3], len(every)
        found = optimise(
            pose_matrices(poses), joined(held, pairs), loss="huber", loss_scale=2.0, iterations=3
        )
        new = xyyaw_rows(found.T_map_nodes)
        moved.append(float(np.linalg.norm(new[:, :2] - poses[:, :2], axis=1).mean()))
        poses = new
        seen = mounting_offsets(nodes, pose_matrices(poses))
        wrong = [offset for offset in seen if offset.significant]
        if wrong and config.mountings and turn < config.passes - 1:
            nodes, T_map_corrected = corrected(nodes, pose_matrices(poses), wrong)
            scans, poses = NodeScans(nodes), xyyaw_rows(T_map_corrected)
            # the closures were measured with the lidars where they don't stand
            held = steps_between(nodes)
            for offset in wrong:
                before = offsets.get(offset.sensor)
                offsets[offset.sensor] = combined(before, offset) if before else offset
        elif moved[-1] < config.settled_m:
            break
    found_offsets = tuple(offsets[sensor] for sensor in sorted(offsets))
    T_map_refined = pose_matrices(poses)
    return Refined(
        tuple(nodes), T_map_refined, found_offsets, held, pairs, rms, tried, tuple(moved)
    )


def steps_between(nodes: Sequence[Node]) -> ConstraintArrays:
    """Local SLAM's step from each node to the next, as firm as the final passes take it."""
    if len(nodes) < 2:
        return ConstraintArrays.of([])
    poses = xyyaw_rows(np.array([node.T_odom_base for node in nodes]))
    covariances = np.array([node.step_covariance for node in nodes[1:]]) / STEP_CAUTION
    covariances += np.diag([0.0, 0.0, STEP_YAW_SIGMA**2])
    covariances[[node.lost for node in nodes[1:]]] += np.eye(3) * LOST_SIGMA**2
    order = np.arange(len(nodes) - 1)
    return ConstraintArrays(order, order + 1, between(poses[:-1], poses[1:]), inverted(covariances))
