"""One lidar in the base frame, however it stands there."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array, LaserScan
from datasets.recording import LidarCalibration
from fusion.lidar_only import BeamLimits, LidarProjection

LIMITS = BeamLimits()


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """R_base_lidar as in REP 103: about x, then y, then z, fixed axes."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    turned: Array = about_z @ about_y @ about_x
    return turned


def mounted(
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    roll: float = 0.0,
    pitch: float = 0.0,
    yaw: float = 0.0,
) -> LidarCalibration:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation(roll, pitch, yaw), (x, y, z)
    return LidarCalibration(T)


def laser(
    ranges_m: Array | list[float],
    bearings_rad: Array | list[float],
    offsets_s: Array | None = None,
    range_min_m: float = 0.1,
) -> LaserScan:
    return LaserScan(
        5,
        "front",
        np.asarray(ranges_m, dtype=np.float64),
        np.asarray(bearings_rad, dtype=np.float64),
        np.empty(0) if offsets_s is None else offsets_s,
        range_min_m,
        30.0,
    )


def test_a_level_lidar_is_moved_and_turned() -> None:
    project = LidarProjection(mounted(x=0.3, y=-0.1, z=0.5, yaw=math.pi / 2), LIMITS)
    scan = project(laser([1.0, 2.0, 3.0], [-0.5 * math.pi, 0.0, 0.5 * math.pi]))
    # by bearing in the base: 0, 90 and 180 deg
    assert scan.points_base == pytest.approx(np.array([[1.3, -0.1], [0.3, 1.9], [-2.7, -0.1]]))
    assert scan.origin_base == pytest.approx([0.3, -0.1])
    assert (scan.stamp_ns, scan.sensor) == (5, "front")
    assert scan.source.tolist() == [0, 0, 0]


def test_upside_down_mirrors_and_keeps_each_beam_its_time() -> None:
    bearings = np.radians([-60.0, -10.0, 20.0, 80.0])
    times = np.array([0.0, 0.01, 0.02, 0.03])
    project = LidarProjection(mounted(roll=math.pi), LIMITS)
    scan = project(laser([1.0, 2.0, 3.0, 4.0], bearings, times))
    angles = np.arctan2(scan.points_base[:, 1], scan.points_base[:, 0])
    assert np.degrees(angles) == pytest.approx([-80.0, -20.0, 10.0, 60.0])
    assert np.hypot(*scan.points_base.T) == pytest.approx([4.0, 3.0, 2.0, 1.0])
    assert scan.offsets_s.tolist() == [0.03, 0.02, 0.01, 0.0]


def test_backwards_wraps_where_the_base_does() -> None:
    project = LidarProjection(mounted(x=-0.4, yaw=math.pi), LIMITS)
    scan = project(laser([1.0, 2.0, 3.0], np.radians([-40.0, 1.0, 40.0]), np.arange(3.0)))
    angles = np.arctan2(*(scan.points_base - scan.origin_base).T[::-1])
    assert np.degrees(angles) == pytest.approx([-179.0, -140.0, 140.0])
    assert scan.offsets_s.tolist() == [1.0, 2.0, 0.0]


def test_a_tilted_lidar_shows_the_horizontal_part() -> None:
    project = LidarProjection(mounted(pitch=math.radians(60.0)), LIMITS)
    scan = project(laser([2.0, 2.0], [0.0, math.pi / 2]))
    assert scan.points_base == pytest.approx(np.array([[1.0, 0.0], [0.0, 2.0]]), abs=1e-12)


@settings(deadline=None)
@given(
    pose=st.tuples(*[st.floats(-1.0, 1.0)] * 3, *[st.floats(-3.1, 3.1)] * 3),
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 50),
)
def test_any_mounting_does_what_a_3d_transform_does(
    pose: tuple[float, ...], seed: int, count: int
) -> None:
    random = np.random.default_rng(seed)
    bearings = random.uniform(-math.pi, math.pi, count)
    ranges = random.uniform(0.5, 20.0, count)
    times = random.uniform(0.0, 0.1, count)
    calibration = mounted(*pose)
    scan = LidarProjection(calibration, LIMITS)(laser(ranges, bearings, times))
    rays = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(count)])
    T = calibration.T_base_lidar
    wanted = ((rays * ranges[:, None]) @ T[:3, :3].T + T[:3, 3])[:, :2]
    assert len(scan.points_base) == count
    by_time = np.argsort(scan.offsets_s) if count else np.empty(0, dtype=np.int64)
    assert scan.points_base[by_time] == pytest.approx(wanted[np.argsort(times)], abs=1e-9)
    seen = scan.points_base - scan.origin_base
    far = np.hypot(*seen.T) > 1e-6
    assert (np.diff(np.arctan2(seen[far, 1], seen[far, 0])) >= -1e-9).all()


@pytest.mark.parametrize(("first", "last"), [(-1.5, 1.5), (1.5, -1.5)])
def test_spacing_is_that_of_the_beams_whichever_way_they_turn(first: float, last: float) -> None:
    bearings = np.linspace(first, last, 301)
    for calibration in (mounted(), mounted(roll=math.pi), mounted(yaw=3.0)):
        scan = LidarProjection(calibration, LIMITS)(laser(np.full(301, 2.0), bearings))
        assert scan.beam_spacing_rad == pytest.approx(0.01)
        # counting clockwise or not, the points come counter-clockwise
        angles = np.arctan2(scan.points_base[:, 1], scan.points_base[:, 0])
        assert (np.diff(angles) > 0.0).all()


def test_only_returns_within_the_limits_stay() -> None:
    limits = BeamLimits(min_range_m=0.3, max_range_m=10.0)
    ranges = [10.0, *[5.0] * 5, 0.29, 0.3, -math.inf, math.nan, 0.0, -1.0, 9.8, math.inf, 10.01]
    bearings = np.linspace(-1.0, 1.0, len(ranges))
    project = LidarProjection(mounted(), limits)
    scan = project(laser(ranges, bearings, np.arange(15.0)))
    assert np.hypot(*scan.points_base.T) == pytest.approx([10.0, *[5.0] * 5, 0.3, 9.8])
    assert scan.offsets_s.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 12.0]
    nearer = project(laser(ranges, bearings, np.arange(15.0), range_min_m=0.5))
    assert np.hypot(*nearer.points_base.T) == pytest.approx([10.0, *[5.0] * 5, 9.8])


@pytest.mark.parametrize("at_m", [29.6, 29.8, 29.9, 29.95, 30.0, 30.1, 30.4])
def test_a_wall_at_the_limit_of_the_range_does_not_stand_too_near(at_m: float) -> None:
    """Only readings that noise made short come back from it: 12 cm short, from a wall at 30.1 m."""
    random = np.random.default_rng(1)
    bearings = np.linspace(-0.1, 0.1, 61)
    sigma_m = LIMITS.noise_m + LIMITS.noise_per_m * at_m
    project = LidarProjection(mounted(), LIMITS)
    pull_m, raw_pull_m, count = 0.0, 0.0, 0
    for _ in range(300):
        ranges = at_m + sigma_m * random.standard_normal(bearings.size)
        ranges[ranges > 30.0] = math.inf
        kept = np.hypot(*project(laser(ranges, bearings)).points_base.T)
        count += len(kept)
        pull_m += float((at_m - kept).sum()) / bearings.size / 300
        raw_pull_m += float((at_m - ranges[np.isfinite(ranges)]).sum()) / bearings.size / 300
    assert abs(pull_m) < 0.1 * sigma_m
    if at_m <= 29.6:
        assert count > 0.98 * 300 * bearings.size
    if at_m == 30.0:
        assert raw_pull_m > 0.3 * sigma_m, "or nothing is tested"


def test_a_return_near_the_limit_counts_where_all_beside_it_came_back() -> None:
    project = LidarProjection(mounted(), LIMITS)
    bearings = np.linspace(-0.2, 0.2, 21)
    ranges = np.full(21, 29.9)
    assert len(project(laser(ranges, bearings)).points_base) == 21
    ranges[0] = math.inf
    # the five beside the one that is missing are in doubt; one farther off is not
    assert len(project(laser(ranges, bearings)).points_base) == 15
    near = np.full(21, 25.0)
    near[10] = math.inf
    assert len(project(laser(near, bearings)).points_base) == 20
    invalid = np.full(21, 29.9)
    invalid[10] = math.nan
    assert len(project(laser(invalid, bearings)).points_base) == 20


def test_beams_beside_each_other_are_so_across_the_cut_of_the_circle_but_not_across_a_gap() -> None:
    project = LidarProjection(mounted(), LIMITS)
    around = np.linspace(-math.pi, math.pi, 720, endpoint=False)
    ranges = np.full(720, 20.0)
    ranges[:10], ranges[-3:] = 29.9, math.inf
    # the last of them, behind the cut, is one step from the first
    assert len(project(laser(ranges, around)).points_base) == 720 - 3 - 5
    behind = LidarProjection(mounted(yaw=math.pi), LIMITS)
    half = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 181)
    ranges = np.full(181, 20.0)
    ranges[0], ranges[-1] = 29.9, math.inf
    assert len(behind(laser(ranges, half)).points_base) == 180


def test_what_is_in_doubt_is_neither_an_end_nor_free_space() -> None:
    project = LidarProjection(mounted(), LIMITS)
    sweep = project.sweep(laser([29.9, math.inf, 29.9], [-0.01, 0.0, 0.01]))
    assert np.isnan(sweep.ranges_m).tolist() == [True, False, True]
    assert sweep.ranges_m[1] == math.inf


def test_a_scan_without_any_return_is_a_scan_of_no_points() -> None:
    project = LidarProjection(mounted(), LIMITS)
    assert project(laser([math.inf] * 4, [0.0, 0.1, 0.2, 0.3])).points_base.shape == (0, 2)
    assert project(laser([], [])).points_base.shape == (0, 2)
    assert project(laser([2.0], [0.5])).points_base.shape == (1, 2)


def test_counts_that_vary_from_scan_to_scan_are_aimed_anew() -> None:
    project = LidarProjection(mounted(yaw=0.2), LIMITS)
    for count in (90, 91, 90, 45, 91):
        bearings = np.linspace(-2.0, 2.0, count)
        scan = project(laser(np.full(count, 3.0), bearings))
        angles = np.arctan2(scan.points_base[:, 1], scan.points_base[:, 0])
        assert angles == pytest.approx(bearings + 0.2)
        assert scan.beam_spacing_rad == pytest.approx(4.0 / (count - 1))


def test_the_same_bearings_give_the_same_scan_again() -> None:
    bearings = np.linspace(-3.0, 3.0, 50)
    project = LidarProjection(mounted(roll=math.pi, yaw=1.0), LIMITS)
    first, second = (project(laser(np.full(50, r), bearings)) for r in (1.0, 2.0))
    assert second.points_base == pytest.approx(2.0 * first.points_base)
