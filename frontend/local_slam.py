"""Local SLAM: one scan at a time to a pose in the odom frame, nodes and submaps."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from datasets.messages import Array, Odometry
from datasets.se2 import inverse
from frontend.match import UNOBSERVED_SIGMA_M, Match, Rejected
from frontend.motion import Motion, MotionModel
from frontend.nodes import Node, NodeKeeper, Submap
from frontend.prepared import PreparedScan, moment_ns, prepare
from frontend.tracker import LOST, Tracked, Tracker
from fusion.scan import FusedScan


@dataclass(frozen=True, slots=True)
class LocalResult:
    """What local SLAM made of a scan: its pose, and the node and the submap it led to, if any."""

    tracked: Tracked
    node: Node | None
    submap: Submap | None


class LocalSlam:
    """Predict, de-skew, match, insert: everything that is done in the drifting odom frame."""

    def __init__(self, motion: MotionModel, tracker: Tracker, keeper: NodeKeeper) -> None:
        self.motion = motion
        self.keeper = keeper
        self._tracker = tracker
        self._T_odom_last: Array | None = None
        self.unmatched: Counter[str] = Counter()
        self.lost_ns: list[int] = []
        """Stamps of the scans where the thread was lost and a new map begun."""
        self.unobserved_m = 0.0
        """Metres driven where the way along was not observed by the matches."""

    def add_odometry(self, odometry: Odometry) -> bool:
        """Take a message; False if it is not newer than the last."""
        return self.motion.add_odometry(odometry)

    def add_scan(self, scan: FusedScan) -> LocalResult:
        """Take a scan; scans come in the order of their stamps."""
        moment = moment_ns(scan)
        motion = self.motion.predict(moment, 2e-9 * (moment - scan.stamp_ns))
        tracked = self._track(scan, moment, motion)
        matched = isinstance(tracked.outcome, Match)
        if self._T_odom_last is None:
            self.motion.tracked(moment, np.eye(3), motion, reliable=False)
        else:
            step = inverse(self._T_odom_last) @ tracked.T_odom_base
            sigma_m = _forward_sigma_m(tracked.outcome)
            self.motion.tracked(moment, step, motion, reliable=matched, forward_sigma_m=sigma_m)
        way_m = self.keeper.way_m
        node, submap = self.keeper.add(tracked)
        if self._T_odom_last is not None:
            self._count(tracked, self.keeper.way_m - way_m)
        self._T_odom_last = tracked.T_odom_base
        return LocalResult(tracked, node, submap)

    def _track(self, scan: FusedScan, moment: int, motion: Motion) -> Tracked:
        """Match a scan, de-skewed anew if its match says that the base turned otherwise."""
        turn_s = float(np.ptp(scan.offsets_s)) if scan.offsets_s.size else 0.0
        tried: list[PreparedScan | None] = []

        def anew(match: Match) -> PreparedScan | None:
            where = (scan.sensor, moment, turn_s, match.T_frame_base)
            velocity = self.motion.contradicted(motion, *where)
            # points of views were brought to their beams' times by about the predicted velocity
            again = None if velocity is None else prepare(scan, velocity, motion.velocity_base)
            tried.append(again)
            return again

        tracked = self._tracker.track(prepare(scan, motion.velocity_base), motion, anew)
        believed = bool(tried) and (tried[0] is None or tried[0] is tracked.scan)
        T_odom_base = tracked.T_odom_base if isinstance(tracked.outcome, Match) else None
        self.motion.matched(motion, scan.sensor, moment, turn_s, T_odom_base, believed=believed)
        return tracked

    def _count(self, tracked: Tracked, way_m: float) -> None:
        outcome = tracked.outcome
        if isinstance(outcome, Match):
            if outcome.weak_sigma_m > UNOBSERVED_SIGMA_M:
                self.unobserved_m += way_m
        else:
            self.unmatched[outcome.reason] += 1
            self.unobserved_m += way_m
            if outcome.reason == LOST:
                self.lost_ns.append(tracked.scan.stamp_ns)


def _forward_sigma_m(outcome: Match | Rejected) -> float:
    """How well a match knows the way along by itself, going by its weakest direction."""
    if isinstance(outcome, Rejected):
        return math.inf
    return outcome.weak_sigma_m * abs(float(outcome.weak_base[0]))
