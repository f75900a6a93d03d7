"""What the wheels and a gyro say of a drive: dead reckoning with the errors of such a base.

The wheels' errors, for a step in which the base goes s m forward and turns by phi rad, and its
wheels, `track` apart, roll l = s - phi track / 2 and r = s + phi track / 2:

    l' = l (1 + scale - bend track / 2 + slip_l)       unequal wheels bend straight lines
    r' = r (1 + scale + bend track / 2 + slip_r)
    s'   = (l' + r') / 2    + N(0, way_noise^2 |s|)
    phi' = (r' - l') / track + N(0, turn_noise_per_way^2 |s| + turn_noise^2 |phi|)

scale and bend are drawn once for a drive. Slip is 0 but in bouts, in which each wheel turns a share
of its way in vain. The variances add up over steps: how finely a drive is sampled makes no
difference. A base that stands measures nothing.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, Field

from datasets.messages import Array
from datasets.section import Section
from datasets.simulation.drive import Drive
from datasets.simulation.trouble import HandledDrive

# Streams of random numbers: one seed may serve all sensors of a drive, and none repeats another's.
_CONSTANTS, _BOUTS, _STEPS, _GYRO = range(1, 5)


def _rising(span: tuple[float, float]) -> tuple[float, float]:
    if not 0.0 <= span[0] <= span[1]:
        raise ValueError("must be two sizes, the smaller first")
    return span


Span = Annotated[tuple[float, float], AfterValidator(_rising)]
"""A size that is drawn evenly between two, and then given either sign."""


class WheelErrors(Section):
    """Errors of wheel odometry, of the size a small base on indoor floors has."""

    scale: Span = Field((0.01, 0.02), description="share of the way")
    bend_rad_per_m: Span = Field((0.004, 0.014), description="turned on a straight line")
    way_noise_m: float = Field(0.01, ge=0.0, description="one sigma after 1 m")
    turn_noise_per_way_rad: float = Field(0.006, ge=0.0, description="one sigma after 1 m")
    turn_noise_rad: float = Field(0.02, ge=0.0, description="one sigma after turning 1 rad")
    track_m: float = Field(0.34, gt=0.0, description="between the wheels")
    slip_bouts_per_m: float = Field(0.03, ge=0.0, description="of way without slip")
    slip_bout_m: float = Field(0.5, gt=0.0, description="mean length of a bout")
    slip_share: float = Field(0.1, ge=0.0, lt=1.0, description="at most, of a wheel's way")


NO_WHEEL_ERRORS = WheelErrors(
    scale=(0.0, 0.0),
    bend_rad_per_m=(0.0, 0.0),
    way_noise_m=0.0,
    turn_noise_per_way_rad=0.0,
    turn_noise_rad=0.0,
    slip_bouts_per_m=0.0,
)


class GyroErrors(Section):
    """Errors of a cheap MEMS gyro about the vertical axis."""

    noise_rad_s: float = Field(0.001, ge=0.0, description="white, one sigma of a reading")
    bias_rad_s: float = Field(0.002, ge=0.0, description="one sigma, at the start")
    bias_walk_rad_s: float = Field(0.0001, ge=0.0, description="one sigma after 1 s, then sqrt(t)")


def wheel_odometry(drive: Drive, times_s: npt.ArrayLike, errors: WheelErrors, seed: int) -> Array:
    """T_odom_base at times (N,) s, as (N, 3) x m, y m, yaw rad (not wrapped); it begins at zero.

    The same seed gives the same odometry, and more times after the given ones change nothing.
    Raises ValueError if the times do not increase.
    """
    return WheelOdometry(drive, errors, seed).advance(times_s)


class WheelOdometry:
    """``wheel_odometry`` in pieces, for long drives: the parts change nothing but rounding."""

    def __init__(self, drive: Drive, errors: WheelErrors, seed: int) -> None:
        self._drive, self._errors, self._seed = drive, errors, seed
        self._noise = _generator(seed, _STEPS)
        self._last_s = np.empty(0)
        self._place, self._yaw = 0j, 0.0

    def advance(self, times_s: npt.ArrayLike) -> Array:
        """(N, 3) at the next times. Raises ValueError if they do not increase."""
        errors, times = self._errors, _increasing(times_s)
        known = np.concatenate([self._last_s, times])
        if self._last_s.size and known[0] >= known[1]:
            raise ValueError("times must increase from piece to piece")
        poses, totals = self._drive.pose(known), self._drive.travelled(known)
        turn, (way, turned) = np.diff(poses[:, 2]), np.diff(totals, axis=0).T

        seen_way, seen_turn = _by_the_wheels(way, turn, totals, errors, self._seed)
        noise = self._noise.standard_normal((way.size, 3))
        seen_way += errors.way_noise_m * np.sqrt(way) * noise[:, 0]
        seen_turn += errors.turn_noise_per_way_rad * np.sqrt(way) * noise[:, 1]
        seen_turn += errors.turn_noise_rad * np.sqrt(turned) * noise[:, 2]

        # The true chord of each step, longer by the error of the way and turned by half of the
        # turn's: without errors the odometry is the drive, whatever its curvature.
        seen_yaw = np.cumsum(np.concatenate([[self._yaw], seen_turn]))
        chord = np.diff(poses[:, 0] + 1j * poses[:, 1]) * np.exp(-1j * poses[:-1, 2])
        chord += (seen_way - way) * np.exp(0.5j * turn)
        steps = chord * np.exp(1j * (seen_yaw[:-1] + 0.5 * (seen_turn - turn)))
        place = np.cumsum(np.concatenate([[self._place], steps]))
        self._last_s, self._place, self._yaw = known[-1:], place[-1], float(seen_yaw[-1])
        return np.column_stack([place.real, place.imag, seen_yaw])[-times.size :]


def gyro(
    drive: Drive | HandledDrive, times_s: npt.ArrayLike, errors: GyroErrors, seed: int
) -> Array:
    """Readings (N,) rad/s at times (N,) s: omega + bias + white noise, the bias a random walk.

    The same seed gives the same readings. Raises ValueError if the times do not increase.
    """
    return Gyro(drive, errors, seed).advance(times_s)


class Gyro:
    """``gyro`` in pieces, for long drives: the parts change nothing but rounding."""

    def __init__(self, drive: Drive | HandledDrive, errors: GyroErrors, seed: int) -> None:
        self._drive, self._errors = drive, errors
        self._noise = _generator(seed, _GYRO)
        self._last_s = np.empty(0)
        self._bias_rad_s = 0.0

    def advance(self, times_s: npt.ArrayLike) -> Array:
        """(N,) at the next times. Raises ValueError if they do not increase."""
        errors, times = self._errors, _increasing(times_s)
        first = self._last_s.size == 0
        since_s = np.diff(times, prepend=times[:1] if first else self._last_s)
        if since_s[0] < 0.0 or (since_s[0] == 0.0 and not first):
            raise ValueError("times must increase from piece to piece")
        noise = self._noise.standard_normal((times.size, 2))
        steps = errors.bias_walk_rad_s * np.sqrt(since_s) * noise[:, 0]
        if first:
            # The walk's first step has no length; its number is free for the bias at the start.
            steps[0] = errors.bias_rad_s * noise[0, 0]
        bias = np.cumsum(np.concatenate([[self._bias_rad_s], steps]))[1:]
        self._last_s, self._bias_rad_s = times[-1:], float(bias[-1])
        readings: Array = self._drive.velocity(times)[:, 1] + bias
        return readings + errors.noise_rad_s * noise[:, 1]


def _by_the_wheels(
    way: Array, turn: Array, totals: Array, errors: WheelErrors, seed: int
) -> tuple[Array, Array]:
    """Way m and turn rad, (N - 1,) each, as wheels that are too large, unequal, and slip see them.

    totals : (N, 2) way m and turn rad driven before each time.
    """
    random, half_track = _generator(seed, _CONSTANTS), errors.track_m / 2.0
    scale, bend = _drawn(errors.scale, random), _drawn(errors.bend_rad_per_m, random)
    # Bouts lie along what the wheels roll: a base that turns on the spot may slip as well.
    rolled = totals[:, 0] + half_track * totals[:, 1]
    slip = _slip(rolled, errors, _generator(seed, _BOUTS))
    left = (way - half_track * turn) * (1.0 + scale - bend * half_track + slip[0])
    right = (way + half_track * turn) * (1.0 + scale + bend * half_track + slip[1])
    return (left + right) / 2.0, (right - left) / errors.track_m


def _slip(rolled_m: Array, errors: WheelErrors, random: np.random.Generator) -> Array:
    """(2, N - 1): the share of its way that each wheel turns in vain, between places (N,) m.

    Grip and bouts follow each other, their lengths exponential.
    """
    edges_m, in_vain_m = [0.0], [np.zeros(2)]
    while errors.slip_bouts_per_m > 0.0 and edges_m[-1] < rolled_m[-1]:
        grip_m = random.exponential(1.0 / errors.slip_bouts_per_m)
        bout_m = random.exponential(errors.slip_bout_m)
        shares = random.uniform(0.0, errors.slip_share, size=2)
        edges_m += [edges_m[-1] + grip_m, edges_m[-1] + grip_m + bout_m]
        in_vain_m += [in_vain_m[-1], in_vain_m[-1] + shares * bout_m]
    step_m = np.diff(rolled_m)
    both = [np.diff(np.interp(rolled_m, edges_m, wheel)) for wheel in np.array(in_vain_m).T]
    return np.array(both) / np.where(step_m > 0.0, step_m, 1.0)


def _drawn(span: tuple[float, float], random: np.random.Generator) -> float:
    return float(random.uniform(*span) * random.choice([-1.0, 1.0]))


def _generator(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,)))


def _increasing(times_s: npt.ArrayLike) -> Array:
    times = np.asarray(times_s, dtype=np.float64)
    if times.ndim != 1 or not times.size or not (np.diff(times) > 0.0).all():
        raise ValueError("times must be (N,), at least one, and increase")
    return times
