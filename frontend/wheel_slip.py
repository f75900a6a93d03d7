"""Turns that the wheels don't tell of: a wheel that slips for a second skews all scans of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from datasets.messages import Array
from datasets.se2 import inverse, xyyaw

SKEW_RAD: Final = 0.008
"""So much turn beyond the expected during a scan counts: 4 cm at 10 m at either end of it."""

MOST_RAD_S: Final = 2.0
"""What seems to slip faster than that is odometry that begins anew: it is not carried on."""

TURNS_APART: Final = (0.8, 3.0)
"""Scans nearer than so many turns show the noise of their matches; what a base did on average
between scans farther apart says little of one turn."""

Steps = Callable[[int, int], Array | None]
"""The step (3, 3) of the base between two stamps as it was expected, None if it is not known."""


class WheelSlip:
    """How much faster a base turns than its odometry says, as the matches show it.

    A wheel slips for half a metre or so, over some scans. Two scans of one sensor are compared: the
    mountings of two sensors disagree by as much as slip comes to between them.
    """

    def __init__(self) -> None:
        self.scans = 0
        """During which something slipped."""
        self._turn_rad_s = 0.0
        self._until_ns = 0
        self._matched: dict[str, tuple[int, Array]] = {}

    def turn_rad_s(self, stamp_ns: int) -> float:
        """rad/s to add to the odometry's around a stamp; 0 where nothing slips, or is known."""
        return self._turn_rad_s if stamp_ns <= self._until_ns else 0.0

    def measured(
        self, sensor: str, moment_ns: int, turn_s: float, T_odom_base: Array, expected: Steps
    ) -> float | None:
        """rad/s beyond the expected, since the last scan of a sensor, by a scan's match (3, 3).

        turn_s : from the scan's first beam to its last. 0 for what is too little to skew a scan,
        None where it can't be told.
        """
        if sensor not in self._matched or turn_s <= 0.0:
            return None
        last_ns, T_odom_last = self._matched[sensor]
        elapsed_s = (moment_ns - last_ns) * 1e-9
        if not TURNS_APART[0] <= elapsed_s / turn_s <= TURNS_APART[1]:
            return None
        T_expected = expected(last_ns, moment_ns)
        if T_expected is None:
            return None
        beyond = xyyaw(inverse(T_expected) @ inverse(T_odom_last) @ T_odom_base)[2] / elapsed_s
        return beyond if abs(beyond) * turn_s >= SKEW_RAD else 0.0

    def learn(self, measured_rad_s: float, moment_ns: int, turn_s: float) -> None:
        """Take what was measured of a scan. It holds for as long as the next one should take."""
        if abs(measured_rad_s) > MOST_RAD_S:
            return
        self._turn_rad_s = measured_rad_s
        self._until_ns = moment_ns + int(TURNS_APART[1] * turn_s * 1e9)
        self.scans += measured_rad_s != 0.0

    def remember(self, sensor: str, moment_ns: int, T_odom_base: Array | None) -> None:
        """Where a sensor's scan was matched, (3, 3), or None where it was not."""
        if T_odom_base is None:
            self._matched.pop(sensor, None)
        else:
            self._matched[sensor] = (moment_ns, T_odom_base)
