"""Drives keep their limits, pass their way points, and are the integral of their velocity."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.simulation.drive import CREEP_M_S, Drive, DriveLimits, plan_drive

LIMITS = DriveLimits()
RING_M = [(0.0, 0.0), (40.0, 0.0), (40.0, 48.0), (0.0, 48.0)]

# A grid of 5 cm gives legs of all lengths, reversals, straight-on points and repeated places.
coordinate = st.integers(-100, 100).map(lambda n: n * 0.05)
limits_of_bases = st.builds(
    DriveLimits,
    speed_m_s=st.floats(0.1, 2.0),
    turn_rate_rad_s=st.floats(0.1, 3.0),
    acceleration_m_s2=st.floats(0.1, 3.0),
    turn_acceleration_rad_s2=st.floats(0.1, 5.0),
    corner_miss_m=st.floats(0.0, 1.0),
)


@st.composite
def way_points(draw: st.DrawFn) -> Array:
    points = draw(st.lists(st.tuples(coordinate, coordinate), min_size=2, max_size=7))
    kept = [a for a, b in pairwise(points) if math.dist(a, b) > 0.01]
    kept.append(points[-1])
    return np.array(kept)


def distance_to_legs_m(places: Array, points: Array) -> Array:
    """How far (N, 2) places are from the polyline through (K, 2) points."""
    best = np.hypot(*(places - points[0]).T)
    for start, end in pairwise(points):
        leg = end - start
        share = np.clip((places - start) @ leg / (leg @ leg), 0.0, 1.0)
        best = np.minimum(best, np.hypot(*(places - start - share[:, None] * leg).T))
    return best


def passing_distances_m(drive: Drive, points: Array, margin_m: float) -> list[float]:
    """How near each point is passed, in their order: the first time it is within the margin."""
    times_s = np.linspace(0.0, drive.duration_s, 20_000)
    places = drive.pose(times_s)[:, :2]
    since, passed = 0, []
    for point in points:
        apart_m = np.hypot(*(places[since:] - point).T)
        near = np.flatnonzero(apart_m <= margin_m)
        if not near.size:
            return [*passed, float(apart_m.min())]
        since += int(near[0])
        passed.append(float(apart_m[near[0]]))
    return passed


@settings(max_examples=60, deadline=None)
@given(points=way_points(), limits=limits_of_bases, yaw=st.floats(-4.0, 4.0))
@example(  # the last corner becomes a stop, and then the one before it is too fast
    points=np.array([(0.36, 0.0), (-0.05, 0.23), (-0.11, -0.19), (-0.12, -0.24)]),
    limits=DriveLimits(
        speed_m_s=2.0,
        turn_rate_rad_s=3.0,
        acceleration_m_s2=0.1,
        turn_acceleration_rad_s2=5.0,
        corner_miss_m=1.0,
    ),
    yaw=2.6,
)
def test_bounds_hold_and_every_point_is_passed(
    points: Array, limits: DriveLimits, yaw: float
) -> None:
    drive = plan_drive(points, limits, start_yaw_rad=yaw)
    times_s = np.unique(np.concatenate([np.linspace(0, drive.duration_s, 4001), drive.starts_s]))
    v, omega = drive.velocity(times_s).T
    assert v.min() >= -1e-9
    assert v.max() <= limits.speed_m_s + 1e-9
    assert np.abs(omega).max() <= limits.turn_rate_rad_s + 1e-9
    # Differences over any two times bound the accelerations, and show every jump.
    steps_s = np.diff(times_s)
    assert (np.abs(np.diff(v)) <= limits.acceleration_m_s2 * steps_s + 1e-7).all()
    assert (np.abs(np.diff(omega)) <= limits.turn_acceleration_rad_s2 * steps_s + 1e-7).all()

    start, end = drive.pose([0.0, drive.duration_s])
    np.testing.assert_allclose(start, [*points[0], yaw], atol=1e-12)
    np.testing.assert_allclose(end[:2], points[-1], atol=1e-9)
    np.testing.assert_allclose(drive.velocity([0.0, drive.duration_s]), 0.0, atol=1e-9)
    sampling_m = limits.speed_m_s * drive.duration_s / 20_000
    margin_m = limits.corner_miss_m + sampling_m + 1e-9
    assert max(passing_distances_m(drive, points, margin_m)) <= margin_m
    assert distance_to_legs_m(drive.pose(times_s)[:, :2], points).max() <= (
        limits.corner_miss_m + 1e-9
    )


@settings(max_examples=25, deadline=None)
@given(points=way_points(), limits=limits_of_bases)
def test_poses_are_the_integral_of_the_velocity(points: Array, limits: DriveLimits) -> None:
    drive = plan_drive(points, limits)
    # An integration of its own: composite Simpson within each stretch, 400 panels.
    total = np.array([*drive.pose([0.0])[0], 0.0])
    for start_s, end_s in zip(drive.starts_s[:-1], drive.starts_s[1:], strict=True):
        times_s = np.linspace(start_s, end_s, 801)
        weights = np.ones(801)
        weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
        weights *= (end_s - start_s) / 800 / 3.0
        # Half-open stretches: the last velocity is read just before the next one begins.
        inner_s = np.minimum(times_s, np.nextafter(end_s, start_s))
        v, omega = drive.velocity(inner_s).T
        yaw = drive.pose(inner_s)[:, 2]
        total += [
            weights @ (v * np.cos(yaw)),
            weights @ (v * np.sin(yaw)),
            weights @ omega,
            weights @ np.abs(v),
        ]
        reached = [*drive.pose([end_s])[0], drive.travelled([end_s])[0, 0]]
        np.testing.assert_allclose(reached, total, atol=1e-9)
    assert drive.length_m == pytest.approx(total[3], abs=1e-9)


def test_the_quadrature_is_exact_on_the_strongest_turn() -> None:
    # Nearly half a turn with a slow ramp: the largest angle one stretch of a corner can sweep.
    limits = DriveLimits(turn_acceleration_rad_s2=0.2, turn_rate_rad_s=5.0, corner_miss_m=5.0)
    turned = math.radians(150)
    points = [(0, 0), (40, 0), (40 + 40 * math.cos(turned), 40 * math.sin(turned))]
    drive = plan_drive(points, limits)
    times_s = np.linspace(0.0, drive.duration_s, 200)
    fine_s = np.linspace(0.0, 1.0, 400_001)
    first = int(np.argmax(drive.motions[:, 3] != 0.0))
    start_s, end_s = drive.starts_s[first], drive.starts_s[first + 1]
    assert drive.motions[first, 0] > CREEP_M_S
    at_s = fine_s * (end_s - start_s)
    v, alpha = drive.motions[first, 0], drive.motions[first, 3]
    along = v * np.cos(drive.starts[first, 2] + alpha * at_s**2 / 2)
    exact = drive.starts[first, 0] + np.trapezoid(along, at_s)
    assert drive.pose([end_s])[0, 0] == pytest.approx(exact, abs=1e-9)
    assert np.isfinite(drive.pose(times_s)).all()


def test_a_straight_leg_is_a_trapezoid_of_speed() -> None:
    drive = plan_drive([(1.0, 2.0), (1.0, 7.0)], LIMITS)
    ramp_s = 0.5 / 0.4
    assert drive.duration_s == pytest.approx(2 * ramp_s + (5.0 - 0.5 * ramp_s) / 0.5)
    middle = drive.pose([drive.duration_s / 2])[0]
    np.testing.assert_allclose(middle, [1.0, 4.5, math.pi / 2], atol=1e-12)
    np.testing.assert_allclose(drive.velocity([ramp_s / 2, ramp_s, 4.0])[:, 0], [0.25, 0.5, 0.5])


def test_the_base_stands_before_and_after() -> None:
    drive = plan_drive([(0, 0), (2, 0)], LIMITS)
    outside_s = [-3.0, drive.duration_s + 5.0]
    np.testing.assert_allclose(drive.pose(outside_s), [[0, 0, 0], [2, 0, 0]], atol=1e-12)
    np.testing.assert_array_equal(drive.velocity(outside_s), 0.0)


def test_a_corner_with_room_is_rounded_without_a_stop() -> None:
    drive = plan_drive([(0, 0), (6, 0), (6, 6)], LIMITS)
    times_s = np.linspace(2.0, drive.duration_s - 2.0, 5000)
    assert drive.velocity(times_s)[:, 0].min() > 0.3
    apart_m = np.hypot(*(drive.pose(times_s)[:, :2] - [6, 0]).T).min()
    assert apart_m == pytest.approx(LIMITS.corner_miss_m, abs=1e-3)  # as wide as it may
    assert drive.velocity(times_s)[:, 1].max() == pytest.approx(LIMITS.turn_rate_rad_s)


@pytest.mark.parametrize(
    ("points", "way_m"),
    [
        ([(0, 0), (5, 0), (0, 0)], 10.0),  # a reversal
        ([(0, 0), (0.05, 0), (0.05, 0.05)], 0.1),  # no room
    ],
)
def test_without_room_the_base_turns_on_the_spot(
    points: list[tuple[float, float]], way_m: float
) -> None:
    drive = plan_drive(points, LIMITS)
    times_s = np.linspace(0.0, drive.duration_s, 20_001)
    v, omega = drive.velocity(times_s).T
    assert (v[omega != 0.0] == 0.0).all()
    assert np.abs(omega).max() > 0.5
    assert drive.length_m == pytest.approx(way_m, abs=1e-12)
    assert distance_to_legs_m(drive.pose(times_s)[:, :2], np.array(points)).max() < 1e-12


def test_a_point_on_a_straight_way_does_not_slow_the_base() -> None:
    whole = plan_drive([(0, 0), (9, 0)], LIMITS)
    split = plan_drive([(0, 0), (2, 0), (5, 0), (9, 0)], LIMITS)
    assert split.duration_s == pytest.approx(whole.duration_s, abs=1e-9)


def test_the_start_yaw_is_turned_from_the_shorter_way() -> None:
    drive = plan_drive([(0, 0), (0, 3)], LIMITS, start_yaw_rad=math.pi)
    assert drive.travelled([drive.duration_s])[0, 1] == pytest.approx(math.pi / 2)
    assert drive.pose([drive.duration_s])[0, 2] == pytest.approx(math.pi / 2)
    assert drive.velocity(np.linspace(0, 1, 50))[:, 0].max() == 0.0


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_closed_drive_ends_in_the_pose_of_its_start(clockwise: bool) -> None:
    points = [RING_M[0], *RING_M[:0:-1]] if clockwise else RING_M
    drive = plan_drive(points, LIMITS, start_yaw_rad=0.3, closed=True)
    start, end = drive.pose([0.0, drive.duration_s])
    np.testing.assert_allclose(end[:2], start[:2], atol=1e-9)
    assert end[2] - start[2] == pytest.approx(-2 * math.pi if clockwise else 2 * math.pi)
    assert 172.0 < drive.length_m < 176.0


def test_waits_stand_still_for_their_time() -> None:
    points = [(0, 0), (3, 0), (6, 0)]
    plain = plan_drive([(0, 0), (3, 0)], LIMITS).duration_s
    drive = plan_drive(points, LIMITS, waits_s={0: 2.0, 1: 5.0, 2: 1.5})
    assert drive.duration_s == pytest.approx(2.0 + plain + 5.0 + plain + 1.5)
    standing_s = np.linspace(2.0 + plain + 1e-6, 2.0 + plain + 5.0 - 1e-6, 20)
    np.testing.assert_allclose(drive.velocity(standing_s), 0.0, atol=1e-12)
    np.testing.assert_allclose(drive.pose(standing_s)[:, 0], 3.0, atol=1e-12)


def test_one_point_with_a_wait_is_a_standing_base() -> None:
    drive = plan_drive([(1.0, -2.0)], LIMITS, start_yaw_rad=0.7, waits_s={0: 30.0})
    assert drive.duration_s == 30.0
    np.testing.assert_array_equal(drive.pose([0.0, 12.0, 40.0]), [[1.0, -2.0, 0.7]] * 3)


def test_a_plan_does_not_depend_on_where_the_map_begins() -> None:
    turned, shift = 1.1, np.array([30.0, -7.0])
    c, s = math.cos(turned), math.sin(turned)
    points = np.array([(0, 0), (4, 0), (4, 1.0), (6.5, 3.0), (2.0, 3.1)])
    here = plan_drive(points, LIMITS)
    there = plan_drive(points @ np.array([[c, s], [-s, c]]) + shift, LIMITS)
    times_s = np.linspace(0.0, here.duration_s, 300)
    moved = here.pose(times_s)[:, :2] @ np.array([[c, s], [-s, c]]) + shift
    np.testing.assert_allclose(there.pose(times_s)[:, :2], moved, atol=1e-9)


@pytest.mark.parametrize(
    ("points", "waits_s", "words"),
    [
        ([(0, 0), (0, 0), (1, 0)], {}, "0 and 1 are the same place"),
        ([(0, 0), (math.nan, 0)], {}, "finite"),
        ([(0, 0, 1), (1, 0, 1)], {}, r"\(2, 3\)"),
        ([], {}, "finite"),
        ([(0, 0), (1, 0)], {2: 1.0}, "way point 2 of 2"),
        ([(0, 0), (1, 0)], {1: -1.0}, "-1.0 s"),
    ],
)
def test_what_is_no_way_is_refused(
    points: list[tuple[float, ...]], waits_s: dict[int, float], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        plan_drive(points, LIMITS, waits_s=waits_s)


def test_a_closed_way_of_one_point_is_refused() -> None:
    with pytest.raises(ValueError, match="same place"):
        plan_drive([(0, 0)], LIMITS, closed=True)
