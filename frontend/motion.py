"""Where the base should be at the next scan: by odometry, corrected, or constant velocity."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from datasets.messages import Array, Odometry
from datasets.se2 import inverse, se2, xyyaw
from datasets.section import Section
from frontend.match import UNOBSERVED_SIGMA_M
from frontend.odometry import OdometryTrack
from frontend.odometry_errors import SPREAD_STEP_RAD, OdometryErrors
from frontend.wheel_slip import SKEW_RAD, Steps, WheelSlip

FAR_M = 1.5
"""A base is not taken to go straight on for more than this between two scans."""
UNSEEN_M = 15.0
"""Nor, without odometry, for more than this along a bare corridor, where no match tells if it
stopped: a longer one comes out too short."""
BARE_SIGMA_M = 0.3
"""A match less sure of the way along than this tells nothing of it."""
VELOCITY_OVER_S = 0.3
"""A velocity over less time is the noise of two matches, or of two stamps."""
ACCELERATION_M_S2 = 2.0
ACCELERATION_RAD_S2 = 4.0
"""Bounds of a base's, where no odometry tells of it."""


class MotionConfig(Section):
    """How far the prediction is trusted (one standard deviation)."""

    odometry_reach_s: float = Field(
        1.0, gt=0.0, description="beyond this gap odometry does not count"
    )
    slip_per_m: float = Field(0.06, ge=0.0, description="m for each metre driven")
    slip_per_rad: float = Field(0.02, ge=0.0, description="m for each radian turned")
    turn_per_m: float = Field(0.08, ge=0.0, description="rad for each metre driven")
    turn_per_rad: float = Field(0.1, ge=0.0, description="rad for each radian turned")
    speed_m_s: float = Field(1.5, gt=0.0, description="bound without odometry")
    speed_rad_s: float = Field(1.5, gt=0.0, description="bound without odometry")
    speed_limit_m_s: float = Field(8.0, gt=0.0, description="faster odometry is not believed")


@dataclass(frozen=True, slots=True)
class Motion:
    """A prediction, before a scan is matched.

    T_last_base   : (3, 3), the base at the scan in the base at the last tracked scan.
    sigma_m, sigma_rad : its standard deviation.
    velocity_base : (3,) m/s, m/s, rad/s during the scan, for de-skewing.
    elapsed_s     : since the last tracked scan.
    odometry      : whether it comes from odometry.
    slip_rad_s    : what of the velocity is slip (``wheel_slip``).
    usual_share   : how much of (sigma_m, sigma_rad) the matches of this drive show to be usual.
    """

    T_last_base: Array
    sigma_m: float
    sigma_rad: float
    velocity_base: Array
    elapsed_s: float
    odometry: bool
    slip_rad_s: float = 0.0
    usual_share: tuple[float, float] = (1.0, 1.0)

    @property
    def usual_sigma(self) -> tuple[float, float]:
        """(m, rad) by which this drive's predictions are usually off; outliers are not in it."""
        return self.usual_share[0] * self.sigma_m, self.usual_share[1] * self.sigma_rad


def twist(T_a_b: Array) -> Array:
    """(3,) the constant velocity, in the body's own axes, that leads from a to b in unit time.

    First order in the shortness of the chord: the chord of an arc lies at half its turn.
    """
    x, y, yaw = xyyaw(T_a_b)
    c, s = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return np.array([c * x + s * y, -s * x + c * y, yaw])


class MotionModel:
    """Predicts from odometry, whose steady errors and slip the matches tell (``errors``, ``slip``).

    Slip counts for what a scan, or a view, is moved by within it, not for where the next one is
    expected: a bout ends as suddenly as it begins.
    """

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._track = OdometryTrack(config.odometry_reach_s)
        self._last_ns: int | None = None
        self._T_wheel_last: Array | None = None
        self._velocity_base = np.zeros(3)
        self._unmatched_s = 0.0
        self._unseen_m = 0.0
        self.errors = OdometryErrors()
        self.slip = WheelSlip()
        self.implausible = 0

    @property
    def odometry_ns(self) -> int | None:
        """Stamp of the newest odometry."""
        return self._track.last_ns

    def add_odometry(self, odometry: Odometry) -> bool:
        """Take a message; False if it is not newer than the last."""
        return self._track.add(odometry)

    def predict(self, stamp_ns: int, duration_s: float) -> Motion:
        """The motion from the last tracked scan to one whose middle is at stamp_ns."""
        if self._last_ns is None:
            return Motion(np.eye(3), 0.01, 0.01, np.zeros(3), 0.0, False)
        elapsed_s = (stamp_ns - self._last_ns) * 1e-9
        T_wheel_base = self._track.at(stamp_ns)
        if T_wheel_base is not None and self._T_wheel_last is not None:
            T_last_base = inverse(self._T_wheel_last) @ T_wheel_base
            way_m = float(np.hypot(*T_last_base[:2, 2]))
            if way_m <= 0.1 + self._config.speed_limit_m_s * abs(elapsed_s):
                return self._from_odometry(T_last_base, stamp_ns, duration_s, elapsed_s)
            self.implausible += 1
        return self._from_velocity(elapsed_s)

    def between(self, from_ns: int, to_ns: int) -> Array:
        """The base at one stamp in the base at another, (3, 3): odometry, slip; else velocity.

        For stamps near the newest scan: two sensors look at different moments.
        """
        return self._step(from_ns, to_ns)[0]

    def _step(self, from_ns: int, to_ns: int) -> tuple[Array, float]:
        """See ``between``; and the slip that is in it, rad/s."""
        T_said = self._said(from_ns, to_ns)
        if T_said is None:
            return self._going_on(from_ns, to_ns), 0.0
        slip_rad_s = self.slip.turn_rad_s(max(from_ns, to_ns))
        return T_said @ se2(0.0, 0.0, slip_rad_s * ((to_ns - from_ns) * 1e-9)), slip_rad_s

    def _going_on(self, from_ns: int, to_ns: int) -> Array:
        return se2(*(self._velocity_base * ((to_ns - from_ns) * 1e-9)))

    def _said(self, from_ns: int, to_ns: int) -> Array | None:
        """The step (3, 3) as the odometry has it, but for its steady errors; None out of reach."""
        T_wheel_from, T_wheel_to = self._track.at(from_ns), self._track.at(to_ns)
        if T_wheel_from is None or T_wheel_to is None:
            return None
        return self.errors.corrected(inverse(T_wheel_from) @ T_wheel_to)

    def velocity(self, stamp_ns: int, duration_s: float) -> Array:
        """(3,) m/s, m/s, rad/s of the base in its own axes, around a stamp; slip included."""
        return self._velocity(stamp_ns, duration_s)[0]

    def _velocity(self, stamp_ns: int, duration_s: float) -> tuple[Array, float]:
        """See ``velocity``; and the slip that is in it, rad/s."""
        half_ns = int(0.5e9 * duration_s)
        if half_ns <= 0:
            return np.zeros(3), 0.0
        T_begin_end, slip_rad_s = self._step(stamp_ns - half_ns, stamp_ns + half_ns)
        return twist(T_begin_end) * (1e9 / (2 * half_ns)), slip_rad_s

    def _from_odometry(
        self, T_last_wheel: Array, stamp_ns: int, duration_s: float, elapsed_s: float
    ) -> Motion:
        x, y, yaw = xyyaw(T_last_wheel)
        config = self._config
        way_m = math.hypot(x, y)
        velocity, slip_rad_s = self._velocity(stamp_ns, duration_s)
        return Motion(
            self.errors.corrected(T_last_wheel),
            0.01 + config.slip_per_m * way_m + config.slip_per_rad * abs(yaw),
            0.03 + config.turn_per_m * way_m + config.turn_per_rad * abs(yaw),
            velocity,
            elapsed_s,
            True,
            slip_rad_s,
            self.errors.usual_share,
        )

    def _from_velocity(self, elapsed_s: float) -> Motion:
        # a base goes straight on for seconds, but seldom turns on; in a long gap it may do anything
        step = self._velocity_base * elapsed_s
        step[2] /= 1.0 + elapsed_s**2
        far_m = float(np.hypot(step[0], step[1]))
        step[:2] *= min(1.0, FAR_M / max(far_m, FAR_M))
        if self._unseen_m > UNSEEN_M:
            step[:2] = 0.0
        # it may as well have stopped right away: that lies within the window of the search
        stop_m = 0.4 * min(far_m, FAR_M)
        unsure_s = elapsed_s + self._unmatched_s
        reach_m = 0.5 * ACCELERATION_M_S2 * unsure_s**2
        reach_rad = 0.5 * ACCELERATION_RAD_S2 * unsure_s**2
        return Motion(
            se2(*step),
            max(stop_m, min(0.4 + 0.1 * self._unmatched_s, 0.04 + reach_m / 3.0, 1.0)),
            min(0.3 + 0.1 * self._unmatched_s, 0.05 + reach_rad / 3.0, 0.6),
            self._velocity_base,
            elapsed_s,
            False,
        )

    def tracked(
        self,
        stamp_ns: int,
        T_last_base: Array,
        motion: Motion,
        *,
        reliable: bool,
        forward_sigma_m: float = math.inf,
    ) -> None:
        """Learn from the step that was tracked; a step that is not reliable teaches nothing.

        forward_sigma_m : how well the match, by itself, knows the way along.
        """
        T_wheel_base = self._track.at(stamp_ns)
        x, y, yaw = xyyaw(T_last_base)
        self._unmatched_s = 0.0 if reliable else self._unmatched_s + max(motion.elapsed_s, 0.0)
        seen = forward_sigma_m < BARE_SIGMA_M
        self._unseen_m = 0.0 if seen else self._unseen_m + math.hypot(x, y)
        if reliable and motion.elapsed_s > 0.0:
            if motion.odometry and T_wheel_base is not None and self._T_wheel_last is not None:
                T_wheel_step = inverse(self._T_wheel_last) @ T_wheel_base
                surely = forward_sigma_m <= UNOBSERVED_SIGMA_M
                self.errors.learn(T_wheel_step, T_last_base, forward_seen=surely)
                if surely and motion.sigma_rad > SPREAD_STEP_RAD:
                    T_predicted_matched = inverse(motion.T_last_base) @ T_last_base
                    self.errors.learn_spread(T_predicted_matched, motion.sigma_m, motion.sigma_rad)
            else:
                self.errors.pause()
            share = min(1.0, motion.elapsed_s / VELOCITY_OVER_S)
            newest = self._plausible(np.array([x, y, yaw]) / motion.elapsed_s)
            self._velocity_base = self._velocity_base + share * (newest - self._velocity_base)
        elif not reliable:
            self._velocity_base = np.zeros(3)
            self.errors.pause()
        self._last_ns, self._T_wheel_last = stamp_ns, T_wheel_base

    def contradicted(
        self, motion: Motion, sensor: str, stamp_ns: int, turn_s: float, T_odom_base: Array
    ) -> Array | None:
        """The velocity during a scan by its match, or None if it is as good as the predicted one.

        turn_s      : from the scan's first beam to its last.
        T_odom_base : (3, 3), where the scan was matched.

        Returns (3,) m/s, m/s, rad/s, in the base's axes. Without odometry a base is taken to go on
        as it went: a bend that begins shows in the same way.
        """
        expected: Steps = self._said if motion.odometry else self._going_on
        beyond_rad_s = self.slip.measured(sensor, stamp_ns, turn_s, T_odom_base, expected)
        if beyond_rad_s is None:
            return None
        if motion.odometry:
            beyond_rad_s -= motion.slip_rad_s
        if abs(beyond_rad_s) * turn_s < SKEW_RAD:
            return None
        velocity = motion.velocity_base.copy()
        velocity[2] += beyond_rad_s
        return velocity

    def matched(
        self,
        motion: Motion,
        sensor: str,
        stamp_ns: int,
        turn_s: float,
        T_odom_base: Array | None,
        *,
        believed: bool,
    ) -> None:
        """Learn of slip from where a scan was matched, (3, 3), or None where it was not.

        believed : the map did not speak against what the match says of the turn.
        """
        if believed and motion.odometry and T_odom_base is not None:
            rad_s = self.slip.measured(sensor, stamp_ns, turn_s, T_odom_base, self._said)
            if rad_s is not None:
                self.slip.learn(rad_s, stamp_ns, turn_s)
        self.slip.remember(sensor, stamp_ns, T_odom_base)

    def _plausible(self, velocity_base: Array) -> Array:
        """Two scans a few milliseconds apart tell nothing but the noise of their matches."""
        fast_m_s = float(np.hypot(velocity_base[0], velocity_base[1]))
        fast = max(
            fast_m_s / self._config.speed_m_s, abs(velocity_base[2]) / self._config.speed_rad_s
        )
        return velocity_base / max(fast, 1.0)
