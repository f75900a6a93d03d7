"""Wheel odometry over time: interpolated at any stamp, as far as it reaches."""

from __future__ import annotations

from bisect import bisect_right

from datasets.messages import Array, Odometry
from datasets.se2 import interpolate

KEPT = 512


class OdometryTrack:
    """The latest odometry, T_wheel_base by stamp; ``wheel`` is its own drifting frame."""

    def __init__(self, reach_s: float) -> None:
        """reach_s : how far beyond a message, and between two, the odometry still counts."""
        self._reach_ns = int(reach_s * 1e9)
        self._stamps_ns: list[int] = []
        self._poses: list[Array] = []

    def add(self, odometry: Odometry) -> bool:
        """Take a message; False, and it is left out, if it is not newer than the last."""
        if self._stamps_ns and odometry.stamp_ns <= self._stamps_ns[-1]:
            return False
        self._stamps_ns.append(odometry.stamp_ns)
        self._poses.append(odometry.T_odom_base)
        if len(self._stamps_ns) > 2 * KEPT:
            del self._stamps_ns[:KEPT]
            del self._poses[:KEPT]
        return True

    @property
    def last_ns(self) -> int | None:
        """Stamp of the newest message."""
        return self._stamps_ns[-1] if self._stamps_ns else None

    def at(self, stamp_ns: int) -> Array | None:
        """T_wheel_base, (3, 3), at a stamp; None where the odometry does not reach.

        Between messages the pose is interpolated; for a short while after the last (or before
        the first) it goes on as it went.
        """
        stamps, poses = self._stamps_ns, self._poses
        if not stamps:
            return None
        after = bisect_right(stamps, stamp_ns)
        if after and stamps[after - 1] == stamp_ns:
            return poses[after - 1]
        return self._around(after, stamp_ns)

    def _around(self, after: int, stamp_ns: int) -> Array | None:
        """The pose at a stamp that no message has; ``after`` : the place of the next message."""
        stamps, poses, reach_ns = self._stamps_ns, self._poses, self._reach_ns
        if len(stamps) == 1:
            return poses[0] if abs(stamp_ns - stamps[0]) <= reach_ns else None
        after = min(max(after, 1), len(stamps) - 1)
        before_ns, after_ns = stamps[after - 1], stamps[after]
        nearer = after - 1 if stamp_ns - before_ns < after_ns - stamp_ns else after
        if after_ns - before_ns > reach_ns and not before_ns < stamp_ns < after_ns:
            # the speed across a gap is not gone on with
            return poses[nearer] if abs(stamp_ns - stamps[nearer]) <= reach_ns else None
        if min(abs(stamp_ns - before_ns), abs(stamp_ns - after_ns)) > reach_ns:
            return None
        fraction = (stamp_ns - before_ns) / (after_ns - before_ns)
        return interpolate(poses[after - 1], poses[after], fraction)
