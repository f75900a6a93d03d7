"""Nodes (scans kept for the graph) and submaps (stretches of nodes that are matched as one)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from datasets.messages import Array
from datasets.se2 import inverse, se2, xyyaw
from datasets.section import Section
from frontend.candidates import GOOD_INLIER_RATIO
from frontend.local_map import LocalMap
from frontend.match import UNOBSERVED_SIGMA_M, Match, Rejected
from frontend.motion import Motion
from frontend.prepared import PreparedScan
from frontend.tracker import LOST, Tracked

WAY_STEP_M = 0.05
"""Moves smaller than this may be the noise of two matches, or of two lidars' mountings."""


class NodeConfig(Section):
    """How densely the graph is laid, and how long a submap is."""

    step_m: float = Field(0.2, gt=0.0, description="way between two nodes")
    step_rad: float = Field(0.2, gt=0.0, description="turn between two nodes")
    submap_way_m: float = Field(4.0, gt=0.0, description="a submap ends after this way")
    submap_min_nodes: int = Field(10, ge=1, description="but not before so many nodes")
    submap_max_nodes: int = Field(30, ge=2, description="and at the latest after so many")


@dataclass(frozen=True, slots=True)
class Node:
    """A scan that the graph knows.

    index       : counts from 0 over the recording.
    T_odom_base : (3, 3), from local SLAM; never changed.
    way_m       : driven from the start to here.
    step_covariance : (3, 3) of the pose in the previous node's frame, in this node's base axes.
    lost        : local SLAM lost the thread between the previous node and this one.
    """

    index: int
    scan: PreparedScan
    T_odom_base: Array
    way_m: float
    step_covariance: Array
    lost: bool


@dataclass(frozen=True, slots=True)
class Submap:
    """A stretch of consecutive nodes, rigid, in the frame of its middle node, the anchor."""

    index: int
    nodes: tuple[Node, ...]

    @property
    def anchor(self) -> Node:
        """The node whose pose is the submap's pose."""
        return self.nodes[len(self.nodes) // 2]

    def T_anchor_base(self, node: Node) -> Array:
        """The pose of a node in the submap, by local SLAM."""
        return inverse(self.anchor.T_odom_base) @ node.T_odom_base

    def draw(self, neighbours: Sequence[Node]) -> LocalMap:
        """The submap to match against, in the anchor's frame, with some nodes before and after."""
        nodes = sorted((*self.nodes, *neighbours), key=lambda node: node.index)
        return LocalMap.around([(node.scan, self.T_anchor_base(node)) for node in nodes])


class NodeKeeper:
    """Decides which tracked scans become nodes, and where one submap ends and the next begins."""

    def __init__(self, config: NodeConfig) -> None:
        self._config = config
        self._latest: dict[str, Tracked] = {}
        self._T_odom_last = np.eye(3)
        self._T_odom_way = np.eye(3)
        self._unobserved = np.zeros((3, 3))
        self._unmatched = np.zeros((3, 3))
        self._lost = False
        self._way_m = 0.0
        self._open: list[Node] = []
        self.nodes: list[Node] = []
        self.submaps: list[Submap] = []

    @property
    def way_m(self) -> float:
        """Driven so far."""
        return self._way_m

    def add(self, tracked: Tracked) -> tuple[Node | None, Submap | None]:
        """Take a tracked scan. Returns the node it became, and the submap that it completed."""
        matched = isinstance(tracked.outcome, Match)
        self._lost |= isinstance(tracked.outcome, Rejected) and tracked.outcome.reason == LOST
        first = not self.nodes
        if first:
            self._T_odom_last = self._T_odom_way = tracked.T_odom_base
        self._drive(tracked.T_odom_base)
        self._doubt(tracked)
        if not (first or matched or self._lost) or not self._far(tracked):
            return None, None
        self._drive(tracked.T_odom_base, least_m=0.0)
        node = Node(
            len(self.nodes),
            tracked.scan,
            tracked.T_odom_base,
            self._way_m,
            np.zeros((3, 3)) if first else self._step_covariance(tracked),
            self._lost and not first,
        )
        done = self._close_submap(node)
        self.nodes.append(node)
        self._open.append(node)
        self._latest[tracked.scan.sensor] = tracked
        self._unobserved, self._unmatched = np.zeros((3, 3)), np.zeros((3, 3))
        self._lost = False
        return node, done

    def _drive(self, T_odom_base: Array, least_m: float = WAY_STEP_M) -> None:
        """Add to the way, in steps that no noise of a standing base makes."""
        step_m = float(np.linalg.norm(T_odom_base[:2, 2] - self._T_odom_way[:2, 2]))
        if step_m > least_m:
            self._way_m += step_m
            self._T_odom_way = T_odom_base

    def _doubt(self, tracked: Tracked) -> None:
        """Keep account of what the matches since the last node left open.

        A match in a map that goes on makes good for scans before it that had none.
        """
        step = inverse(self._T_odom_last) @ tracked.T_odom_base
        self._T_odom_last = tracked.T_odom_base
        outcome, motion = tracked.outcome, tracked.motion
        if isinstance(outcome, Rejected):
            # the yaw of steps that nothing corrects turns those after them
            self._unmatched = carried(self._unmatched, step) + predicted_covariance(motion)
            return
        if not self._lost:
            self._unmatched = np.zeros((3, 3))
        if outcome.weak_sigma_m > UNOBSERVED_SIGMA_M:
            # without odometry nothing holds that direction but a guess
            held_m = motion.sigma_m if motion.odometry else 1.0
            weak_m = min(outcome.weak_sigma_m, held_m)
            along = np.outer(outcome.weak_base, outcome.weak_base)
            self._unobserved[:2, :2] += weak_m**2 * along

    def _step_covariance(self, tracked: Tracked) -> Array:
        """How well the step from the last node is known, (3, 3) in base axes."""
        step = inverse(self.nodes[-1].T_odom_base) @ tracked.T_odom_base
        outcome = tracked.outcome
        inlier_ratio = outcome.inlier_ratio if isinstance(outcome, Match) else 1.0
        return matched_covariance(step, inlier_ratio) + self._unobserved + self._unmatched

    def finish(self) -> Submap | None:
        """End the open submap, if there is one. Call once, at the end."""
        if not self._open:
            return None
        done = Submap(len(self.submaps), tuple(self._open))
        self.submaps.append(done)
        self._open = []
        return done

    def _far(self, tracked: Tracked) -> bool:
        latest = self._latest.get(tracked.scan.sensor)
        if latest is None or self._lost:
            return True
        x, y, yaw = xyyaw(inverse(latest.T_odom_base) @ tracked.T_odom_base)
        return math.hypot(x, y) > self._config.step_m or abs(yaw) > self._config.step_rad

    def _close_submap(self, node: Node) -> Submap | None:
        config, count = self._config, len(self._open)
        if not count:
            return None
        long = self._way_m - self._open[0].way_m >= config.submap_way_m
        if (
            (long and count >= config.submap_min_nodes)
            or count >= config.submap_max_nodes
            or node.lost
        ):
            return self.finish()
        return None


def carried(covariance: Array, T_a_b: Array) -> Array:
    """The covariance of a pose, given in the axes of a, after a step T_a_b: in those of b.

    First order: the adjoint of the inverse step, for the tangent (x, y, yaw) of a body.
    """
    x, y, yaw = xyyaw(T_a_b)
    R = se2(0.0, 0.0, yaw)[:2, :2].T
    J = np.eye(3)
    J[:2, :2] = R
    J[:2, 2] = R @ np.array([-y, x])
    moved: Array = J @ covariance @ J.T
    return moved


def matched_covariance(T_last_base: Array, inlier_ratio: float = 1.0) -> Array:
    """How well scan matching knows a step: its drift against a map that was itself matched.

    inlier_ratio : of the match. Where less than ``GOOD_INLIER_RATIO`` of a scan lies on the map its
        errors grow: measured on thinned logs, to twice as much at 0.4.
    """
    x, y, yaw = xyyaw(T_last_base)
    way_m = math.hypot(x, y)
    little = max(1.0, GOOD_INLIER_RATIO / max(inlier_ratio, 0.1)) ** 2
    xy = (little * (0.005 + 0.01 * way_m)) ** 2
    yaw_sigma = little * (0.0015 + 0.002 * way_m + 0.004 * abs(yaw))
    return np.diag([xy, xy, yaw_sigma**2])


def predicted_covariance(motion: Motion) -> Array:
    """How well a step is known that only the prediction tells; next to nothing without odometry."""
    loose_m, loose_rad = (0.0, 0.0) if motion.odometry else (0.5, 0.5)
    xy = (motion.sigma_m + loose_m) ** 2
    return np.diag([xy, xy, (motion.sigma_rad + loose_rad) ** 2])
