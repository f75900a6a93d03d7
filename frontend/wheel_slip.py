"""Turns that the wheels don't tell of: a wheel that slips for a second skews all scans of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from datasets.messages import Array
from datasets.se2 import inverse, xyyaw

SKEW_RAD: Final = 0.008
"""So much turn beyond the odometry's during a scan counts: 4 cm at 10 m at either end of it."""

TURNS_APART: Final = (0.5, 3.0)
"""Scans nearer than so many turns show the noise of their matches; what a base did on average
between scans farther apart says little of one turn."""

Said = Callable[[int, int], Array | None]
"""The step (3, 3) between two stamps as the odometry has it, or None where it doesn't reach."""


class WheelSlip:
    """How much faster a base turns than its odometry says, as the matches show it.

    A wheel slips for half a metre or so, over some scans. Two scans of one sensor are compared: the
    mountings of two sensors disagree by as much as slip comes to between them.
    """

    def __init__(self) -> None:
        self.turn_rad_s = 0.0
        """Beyond the odometry's, as of the last match; 0 as long as nothing slips."""
        self.scans = 0
        """During which something slipped."""
        self._matched: dict[str, tuple[int, Array]] = {}

    def measured(
        self, sensor: str, moment_ns: int, duration_s: float, T_odom_base: Array, said: Said
    ) -> float:
        """rad/s that a scan matched at a pose (3, 3) shows since the last one of its sensor.

        0 for what is too little to skew a scan, or can't be told.
        """
        if sensor not in self._matched:
            return 0.0
        last_ns, T_odom_last = self._matched[sensor]
        elapsed_s = (moment_ns - last_ns) * 1e-9
        T_said = said(last_ns, moment_ns)
        if T_said is None or duration_s <= 0.0:
            return 0.0
        if not TURNS_APART[0] <= elapsed_s / duration_s <= TURNS_APART[1]:
            return 0.0
        beyond = xyyaw(inverse(T_said) @ inverse(T_odom_last) @ T_odom_base)[2] / elapsed_s
        return beyond if abs(beyond) * duration_s >= SKEW_RAD else 0.0

    def learn(
        self, sensor: str, moment_ns: int, duration_s: float, T_odom_base: Array, said: Said
    ) -> None:
        """Take a matched scan."""
        self.turn_rad_s = self.measured(sensor, moment_ns, duration_s, T_odom_base, said)
        self.scans += self.turn_rad_s != 0.0
        self._matched[sensor] = (moment_ns, T_odom_base)

    def forget(self) -> None:
        """A scan was not matched: nothing is known any more."""
        self.turn_rad_s = 0.0
        self._matched.clear()
