"""Scans as drivers write them, turned into scans as REP 117 and REP 103 want them.

What is changed or left out is counted in ``notes``, in the words of the report. Stamps are dealt
with in ``time_order.py``, since they concern the stream and not one scan.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from datasets.bounds import LARGEST_RAD, LONGEST_RANGE_M, within
from datasets.messages import Array, LaserScan

ASSUMED_RANGE_MAX_M = 30.0
"""Reach of a lidar that doesn't tell; indoors nothing useful lies further away."""

LONGEST_TURN_S = 2.0
"""Beam times that make one turn last longer than this are no beam times."""

ZERO = "range of 0 taken as no return"
NEGATIVE = "negative range taken as invalid"
INVALID = "range NaN kept as invalid"
NEAR = "range below range_min taken as too near"
FAR = "range at or beyond range_max taken as no return"
MASKED = "beam left out: masked, it sees the robot"
NO_LIMITS = f"scan without a usable range_max: {ASSUMED_RANGE_MAX_M:g} m assumed"
SPREAD = "scan's angles disagree with its beam count: beams spread from angle_min to angle_max"
INCREMENT = "scan's angle_max disagrees with its beam count: the increment is trusted"
NO_BEAMS = "scan left out: no ranges"
NO_ANGLES = "scan left out: angles are not finite"
FAR_ANGLES = "scan left out: angles are out of range"


def laser_scan(
    *,
    stamp_ns: int,
    lidar: str,
    ranges: npt.ArrayLike,
    angle_min_rad: float,
    angle_max_rad: float,
    angle_increment_rad: float,
    time_increment_s: float,
    range_min_m: float,
    range_max_m: float,
    masks_rad: Sequence[tuple[float, float]],
    notes: Counter[str],
) -> LaserScan | None:
    """A scan from the fields of a ROS LaserScan, or None (and a note why) if it is no scan.

    ranges           : (N,) m, as the driver gives them; not changed.
    time_increment_s : 0 or nonsense means that beam times are unknown.
    masks_rad        : see ``LidarCalibration.masks_rad``.
    """
    raw = np.array(ranges, dtype=np.float64).reshape(-1)
    if raw.size == 0:
        notes[NO_BEAMS] += 1
        return None
    if not all(map(math.isfinite, (angle_min_rad, angle_increment_rad))):
        notes[NO_ANGLES] += 1
        return None
    if not within((angle_min_rad, angle_min_rad + angle_increment_rad * raw.size), LARGEST_RAD):
        notes[FAR_ANGLES] += 1
        return None
    if not math.isfinite(range_min_m) or range_min_m < 0.0:
        range_min_m = 0.0
    if not range_min_m < range_max_m <= LONGEST_RANGE_M:
        range_max_m = ASSUMED_RANGE_MAX_M
        notes[NO_LIMITS] += 1
    bearings, note = beam_bearings(angle_min_rad, angle_max_rad, angle_increment_rad, raw.size)
    if note is not None:
        notes[note] += 1
    normalise_ranges(raw, range_min_m, range_max_m, notes)
    if masks_rad:
        mask_beams(raw, bearings, masks_rad, notes)
    return LaserScan(
        stamp_ns=stamp_ns,
        lidar=lidar,
        ranges_m=raw,
        bearings_rad=bearings,
        beam_offsets_s=beam_offsets(time_increment_s, raw.size),
        range_min_m=range_min_m,
        range_max_m=range_max_m,
    )


def normalise_ranges(
    ranges_m: Array, range_min_m: float, range_max_m: float, notes: Counter[str]
) -> None:
    """Make ranges mean what REP 117 says, in place.

    0 is "no return" in the drivers that write it (YDLIDAR, many Hokuyo), and becomes +inf, as does
    anything from range_max on. Below range_min is -inf; negative values and NaN are invalid, NaN.
    """
    # float32 fields: 5.6 as a range and 5.6 as range_max may differ in the last digit.
    limit_m = range_max_m * (1.0 - 1e-6)
    if not ranges_m.max() < limit_m:  # also where the maximum is NaN
        far = ranges_m >= limit_m
        count = int(np.count_nonzero(far & (ranges_m != np.inf)))
        ranges_m[far] = np.inf
        if count:
            notes[FAR] += count
    shortest_m = ranges_m.min()
    if shortest_m > 0.0 and shortest_m >= range_min_m:
        return
    zero = ranges_m == 0.0
    negative = (ranges_m < 0.0) & (ranges_m != -np.inf)
    near = (ranges_m > 0.0) & (ranges_m < range_min_m * (1.0 - 1e-6))
    invalid = np.isnan(ranges_m)
    for note, beams in ((ZERO, zero), (NEGATIVE, negative), (NEAR, near), (INVALID, invalid)):
        count = int(np.count_nonzero(beams))
        if count:
            notes[note] += count
    ranges_m[zero] = np.inf
    ranges_m[negative] = np.nan
    ranges_m[near] = -np.inf


@lru_cache(maxsize=256)
def beam_bearings(
    angle_min_rad: float, angle_max_rad: float, angle_increment_rad: float, count: int
) -> tuple[Array, str | None]:
    """Bearings (count,) of a scan's beams, and the note where its fields contradict each other.

    Clockwise scans (a negative increment) give falling bearings. The increment decides, since
    angle_max is often one beam off, or left alone by drivers whose count varies; only where the
    increment is 0, or passes a full turn that angle_max doesn't, are the beams spread between
    angle_min and angle_max. The same arguments give the same array: don't write to it.
    """
    steps = np.arange(count, dtype=np.float64)
    turn_rad = angle_increment_rad * (count - 1)
    span_rad = angle_max_rad - angle_min_rad
    agrees = abs(turn_rad - span_rad) <= 1.5 * abs(angle_increment_rad)
    if count == 1 or (agrees and angle_increment_rad != 0.0):
        return angle_min_rad + angle_increment_rad * steps, None
    overturns = abs(turn_rad) > 2.0 * math.pi + 1.5 * abs(angle_increment_rad)
    span_usable = math.isfinite(span_rad) and 0.0 < abs(span_rad) <= 2.0 * math.pi + 1e-3
    if (overturns or angle_increment_rad == 0.0) and span_usable:
        return angle_min_rad + span_rad / (count - 1) * steps, SPREAD
    return angle_min_rad + angle_increment_rad * steps, INCREMENT


@lru_cache(maxsize=256)
def beam_offsets(time_increment_s: float, count: int) -> Array:
    """Seconds from the first beam to each, (count,); (0,) where the increment tells nothing."""
    turn_s = time_increment_s * count
    if not math.isfinite(turn_s) or not 0.0 < turn_s <= LONGEST_TURN_S:
        return np.empty(0)
    offsets: Array = time_increment_s * np.arange(count, dtype=np.float64)
    return offsets


def mask_beams(
    ranges_m: Array,
    bearings_rad: Array,
    masks_rad: Sequence[tuple[float, float]],
    notes: Counter[str],
) -> None:
    """Make NaN, in place, of every range whose bearing lies in a mask.

    masks_rad : (from, to), counter-clockwise from ``from`` to ``to``, ends included; an interval
                may pass pi, as (3.0, -3.0) does.
    """
    masked = np.zeros(ranges_m.shape, dtype=np.bool_)
    for start_rad, end_rad in masks_rad:
        width_rad = (end_rad - start_rad) % (2.0 * math.pi)
        # The shift by 1e-9 keeps a beam on the very edge inside, whatever its rounding.
        masked |= (bearings_rad - start_rad + 1e-9) % (2.0 * math.pi) <= width_rad + 2e-9
    count = int(np.count_nonzero(masked))
    if count:
        ranges_m[masked] = np.nan
        notes[MASKED] += count
