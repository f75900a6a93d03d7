"""Pose fusion by pose increments, the paper's reference [16], as a front end of its own.

A re-implementation from the one sentence that the paper gives on it (Zhang, Liu, Cao et al.,
Journal of Software 31(9), 2020), by this project. In place of a Kalman filter there are a fused
pose and increments: a scan stamped t_s is matched from the fused pose at t_s, the match's
correction times a fixed gain is applied there, and the increments newer than t_s are applied again.

* The buffer of increments is the motion model's track of odometry, which interpolates, so that
  increments end at t_s exactly; multiplied, those between two stamps are inverse(T_a) T_b. The
  fused pose is kept as of t_s: asked for at a later stamp, it is what the correction made of it
  with all newer increments on top.
* Without odometry the increments are the motion model's by velocity.
* Yaw: a message of odometry has one heading. Where a base's driver blends a gyro into it, it
  holds the gyro's already; this project reads no gyro beside it, so nothing is blended here.
* The source gives no gain; see the configuration. The scan itself lies on the map where it was
  matched, as with the front end "scan-matching", of which all the rest is.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from datasets.se2 import interpolate
from datasets.section import Section
from frontend.match import Match
from frontend.matching import match_surface
from frontend.motion import Motion
from frontend.prepared import PreparedScan
from frontend.tracker import SEARCH_PENALTY, Anew, ScanPlacer, Tracked, TrackerConfig, as_it_is


class PoseIncrementConfig(Section):
    """How much of a correction is believed."""

    gain: float = Field(0.5, gt=0.0, le=1.0, description="share of a match's correction applied")


class PoseIncrementTracker:
    """Tracks with a fused pose; see Tracker."""

    def __init__(self, config: PoseIncrementConfig, tracker: TrackerConfig) -> None:
        self._gain = config.gain
        self._placer = ScanPlacer(tracker, match_surface, SEARCH_PENALTY)
        self._T_odom_fused = np.eye(3)

    def track(self, scan: PreparedScan, motion: Motion, anew: Anew = as_it_is) -> Tracked:
        """See Tracker."""
        T_odom_guess = self._T_odom_fused @ motion.T_last_base
        tracked = self._placer.place(scan, T_odom_guess, motion, anew)
        self._T_odom_fused = T_odom_guess
        if isinstance(tracked.outcome, Match):
            self._T_odom_fused = interpolate(T_odom_guess, tracked.T_odom_base, self._gain)
        return tracked
