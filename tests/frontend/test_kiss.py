"""KISS-ICP as a front end: known motions recovered, and what it must not pretend to know."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from datasets.errors import InputError
from datasets.messages import Array
from datasets.se2 import inverse, se2, transform, xyyaw
from frontend.kiss import KissConfig, KissTracker
from frontend.match import UNOBSERVED_SIGMA_M, Match, Rejected
from frontend.motion import Motion
from frontend.prepared import PreparedScan, prepare
from frontend.tracker import LOST, Tracked
from fusion.scan import FusedScan
from slam.config import load_config

# No two sides alike, so that a mirrored or turned match shows.
ROOM = ((0.0, 0.0), (7.0, 0.0), (7.0, 3.0), (5.0, 3.0), (5.0, 6.0), (2.0, 6.5), (0.0, 4.0))
CORRIDOR = ((-50.0, -1.0), (50.0, -1.0), (50.0, 1.0), (-50.0, 1.0))
BEAMS = 360


def scan_of(
    corners: tuple[tuple[float, float], ...],
    T_world_base: Array,
    *,
    seed: int = 0,
    noise_m: float = 0.0,
    range_max_m: float = 12.0,
    sensor: str = "front",
    field_rad: tuple[float, float] = (-math.pi, math.pi),
) -> PreparedScan:
    """What a lidar on the base's origin sees of walls between corners."""
    bearings = np.linspace(*field_rad, BEAMS, endpoint=False)
    rays = np.column_stack([np.cos(bearings), np.sin(bearings)])
    rays_world = rays @ T_world_base[:2, :2].T
    ranges = np.full(BEAMS, np.inf)
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        start, side = np.array(a) - T_world_base[:2, 2], np.subtract(b, a)
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = rays_world[:, 0] * side[1] - rays_world[:, 1] * side[0]
            r = (start[0] * side[1] - start[1] * side[0]) / cross
            u = (start[0] * rays_world[:, 1] - start[1] * rays_world[:, 0]) / cross
            ranges = np.where((r > 0.0) & (u >= 0.0) & (u <= 1.0), np.minimum(ranges, r), ranges)
    seen = ranges < range_max_m
    ranges = ranges + np.random.default_rng(seed).normal(0.0, noise_m or 1e-12, BEAMS)
    points = rays[seen] * ranges[seen, None]
    spacing = (field_rad[1] - field_rad[0]) / BEAMS
    variance = np.full(len(points), 1e-4)
    fused = FusedScan.of_lidar(0, sensor, np.zeros(2), points, np.empty(0), spacing, variance)
    return prepare(fused, np.zeros(3))


def motion_of(T_last_base: Array, sigma_m: float = 0.05, sigma_rad: float = 0.05) -> Motion:
    return Motion(T_last_base, sigma_m, sigma_rad, np.zeros(3), 0.2, True)


def drive(count: int) -> list[Array]:
    """An arc through the room, 8 cm and 2.3 deg a scan."""
    poses = [se2(1.5, 1.2, 0.2)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se2(0.08, 0.0, 0.04))
    return poses


def test_low_things_take_no_part_beside_the_lidar_s_points() -> None:
    low = np.array([[1.0 + 0.01 * k, 0.3] for k in range(40)])
    poses: list[list[Array]] = []
    for with_low in (False, True):
        tracker, found = KissTracker(KissConfig()), []
        for k, T in enumerate(drive(8)):
            scan = scan_of(ROOM, T, seed=k, noise_m=0.01)
            if with_low:
                scan = replace(
                    scan,
                    points_base=np.concatenate([scan.points_base, low]),
                    normals_base=np.concatenate([scan.normals_base, np.full((40, 2), 0.5**0.5)]),
                    bearings_rad=np.concatenate([scan.bearings_rad, np.zeros(40)]),
                    layer=np.concatenate([scan.layer, np.ones(40, dtype=np.uint8)]),
                    weights=np.concatenate([scan.weights, np.ones(40)]),
                )
            found.append(tracker.track(scan, motion_of(se2(0.08, 0.0, 0.04))).T_odom_base)
        poses.append(found)
    assert np.array_equal(poses[0], poses[1])


def track_drive(tracker: KissTracker, *, odometry_error: Array, noise_m: float) -> list[Tracked]:
    poses = drive(30)
    tracked, before = [], poses[0]
    for k, T in enumerate(poses):
        scan = scan_of(ROOM, T, seed=k, noise_m=noise_m)
        step = inverse(before) @ T @ odometry_error if k else np.eye(3)
        tracked.append(tracker.track(scan, motion_of(step)))
        before = T
    return tracked


def error(T_a: Array, T_b: Array) -> tuple[float, float]:
    x, y, yaw = xyyaw(inverse(T_a) @ T_b)
    return math.hypot(x, y), abs(yaw)


@pytest.mark.parametrize(
    "odometry_error", [np.eye(3), se2(0.05, -0.04, 0.05), se2(-0.08, 0.0, -0.03)]
)
def test_a_drive_is_recovered_whatever_the_odometry_is_off_by(odometry_error: Array) -> None:
    tracked = track_drive(KissTracker(KissConfig()), odometry_error=odometry_error, noise_m=0.01)

    poses = drive(30)
    assert all(isinstance(t.outcome, Match) for t in tracked[1:])
    away_m, turned = error(inverse(poses[0]) @ poses[-1], tracked[-1].T_odom_base)
    assert away_m < 0.04
    assert turned < 0.02


def test_the_same_drive_gives_the_same_bits() -> None:
    runs = [
        track_drive(KissTracker(KissConfig()), odometry_error=se2(0.03, 0.0, 0.02), noise_m=0.01)
        for _ in range(2)
    ]
    first, second = ([t.T_odom_base.tobytes() for t in run] for run in runs)
    assert first == second


def test_the_result_of_the_library_is_planar() -> None:
    """What the planar pose is read from: no height, no tilt."""
    tracker = KissTracker(KissConfig())
    track_drive(tracker, odometry_error=se2(0.05, 0.0, 0.05), noise_m=0.01)
    points = np.asarray(tracker._map._point_cloud())
    scan = scan_of(ROOM, drive(30)[-1] @ se2(0.1, 0.1, 0.1))
    T = tracker._fine._align_points_to_map(
        tracker._vector(scan.points_base), tracker._map, np.eye(4), 0.5, 0.2
    )

    assert len(points) > 200
    assert (points[:, 2] == 0.0).all()
    assert T[2].tolist() == [0.0, 0.0, 1.0, 0.0]
    assert T[:2, 2].tolist() == [0.0, 0.0]


def test_points_of_the_map_are_as_far_apart_as_asked_and_partners_are_found_at_reach() -> None:
    """The library couples both through its voxel: the config promises them one by one."""
    config = KissConfig(voxel_m=0.05, reach_m=0.5)
    tracker = KissTracker(config)
    tracker.track(scan_of(ROOM, se2(2.0, 2.0, 0.0)), motion_of(np.eye(3)))
    points = np.asarray(tracker._map._point_cloud())[:, :2]
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2) + 9.0 * np.eye(len(points))
    # voxels are filled one by one, so two points on either side of a border may be nearer
    assert np.median(gaps.min(axis=0)) > 0.8 * config.voxel_m

    away = tracker.track(scan_of(ROOM, se2(2.0, 2.0, 0.0)), motion_of(se2(0.3, 0.2, 0.05), 0.2))
    assert isinstance(away.outcome, Match)
    assert error(np.eye(3), away.T_odom_base)[0] < 0.02


def test_a_corridor_leaves_the_way_along_to_the_prediction() -> None:
    tracker = KissTracker(KissConfig())
    T_odom_base = np.eye(3)
    for k in range(20):
        T_world_base = se2(0.1 * k, 0.1, 0.3)
        step = inverse(se2(0.1 * (k - 1), 0.1, 0.3)) @ T_world_base if k else np.eye(3)
        scan = scan_of(CORRIDOR, T_world_base, seed=k, noise_m=0.01, range_max_m=8.0)
        tracked = tracker.track(scan, motion_of(step, 0.01, 0.03))
        T_odom_base = tracked.T_odom_base
    outcome = tracked.outcome
    assert isinstance(outcome, Match)
    assert outcome.weak_sigma_m > UNOBSERVED_SIGMA_M
    # along the corridor, which lies 0.3 rad to the right of the base
    assert abs(outcome.weak_base @ [math.cos(-0.3), math.sin(-0.3)]) > 0.99
    assert error(inverse(se2(0.0, 0.1, 0.3)) @ T_world_base, T_odom_base)[0] < 0.05


def test_a_room_is_seen_as_observed_in_every_direction() -> None:
    tracked = track_drive(KissTracker(KissConfig()), odometry_error=np.eye(3), noise_m=0.01)
    outcome = tracked[-1].outcome
    assert isinstance(outcome, Match)
    assert outcome.weak_sigma_m < UNOBSERVED_SIGMA_M
    assert np.linalg.eigvalsh(outcome.information)[0] > 0.0
    np.testing.assert_allclose(outcome.information, outcome.information.T)


def test_information_is_that_of_the_distances_to_the_walls_in_base_axes() -> None:
    """A corridor along the base's y: x is known, y is not."""
    tracker = KissTracker(KissConfig())
    scan = scan_of(CORRIDOR, se2(0.0, 0.0, math.pi / 2), range_max_m=8.0)
    tracker.track(scan, motion_of(np.eye(3)))
    outcome = tracker.track(scan, motion_of(np.eye(3))).outcome
    assert isinstance(outcome, Match)
    assert outcome.information[0, 0] > 1000.0 * outcome.information[1, 1]


@pytest.mark.parametrize("turn_rad", [0.7, -0.6])
def test_a_turn_that_the_odometry_missed_is_found(turn_rad: float) -> None:
    tracker = KissTracker(KissConfig())
    T_world_first = se2(2.0, 2.0, 0.0)
    tracker.track(scan_of(ROOM, T_world_first), motion_of(np.eye(3)))
    turned = T_world_first @ se2(0.05, 0.0, turn_rad)
    tracked = tracker.track(scan_of(ROOM, turned), motion_of(np.eye(3), 0.01, 0.03))
    assert isinstance(tracked.outcome, Match)
    away_m, off_rad = error(inverse(T_world_first) @ turned, tracked.T_odom_base)
    assert away_m < 0.05
    assert off_rad < 0.03


def test_a_scan_without_points_is_rejected_and_keeps_the_prediction() -> None:
    tracker = KissTracker(KissConfig())
    tracker.track(scan_of(ROOM, se2(2.0, 2.0, 0.0)), motion_of(np.eye(3)))
    empty = scan_of(ROOM, se2(2.0, 2.0, 0.0), range_max_m=0.1)
    tracked = tracker.track(empty, motion_of(se2(0.1, 0.0, 0.2)))
    assert not len(empty.points_base)
    assert tracked.outcome == Rejected("too few points")
    np.testing.assert_allclose(tracked.T_odom_base, se2(0.1, 0.0, 0.2))


def test_a_stream_may_begin_with_empty_scans() -> None:
    tracker = KissTracker(KissConfig())
    empty = scan_of(ROOM, se2(2.0, 2.0, 0.0), range_max_m=0.1)
    full = scan_of(ROOM, se2(2.0, 2.0, 0.0))
    reasons = [tracker.track(empty, motion_of(np.eye(3))).outcome for _ in range(10)]
    assert reasons == [Rejected("too few points")] * 10
    assert tracker.track(full, motion_of(np.eye(3))).outcome == Rejected("first scan")
    assert isinstance(tracker.track(full, motion_of(np.eye(3))).outcome, Match)


def test_another_place_is_rejected_and_after_some_scans_begun_anew() -> None:
    config = KissConfig(lost_after_scans=3)
    tracker = KissTracker(config)
    tracker.track(scan_of(CORRIDOR, se2(0.0, 0.0, 0.0), range_max_m=4.0), motion_of(np.eye(3)))
    crowd = tuple(
        (2.0 * math.cos(a) * (1 + k % 2), 2.0 * math.sin(a) * (1 + k % 2))
        for k, a in enumerate(np.linspace(0.0, 2.0 * math.pi, 9)[:-1].tolist())
    )
    elsewhere = scan_of(crowd, np.eye(3))
    outcomes = [tracker.track(elsewhere, motion_of(np.eye(3))).outcome for _ in range(4)]
    assert all(isinstance(outcome, Rejected) for outcome in outcomes[:3])
    assert outcomes[2] == Rejected(LOST)
    assert isinstance(outcomes[3], Match)


def test_a_second_lidar_that_looks_elsewhere_joins_in() -> None:
    """Its first scan is not in the map of the other; its second must be."""
    tracker = KissTracker(KissConfig())
    outcomes = []
    for k in range(6):
        T_world_base = se2(2.0 + 0.05 * k, 2.0, 0.0)
        step = se2(0.05 if k else 0.0, 0.0, 0.0)
        front = scan_of(ROOM, T_world_base, field_rad=(-1.2, 1.2))
        back = scan_of(ROOM, T_world_base, sensor="back", field_rad=(2.0, 4.3))
        tracker.track(front, motion_of(step))
        outcomes.append(tracker.track(back, motion_of(np.eye(3), 0.01, 0.03)))
    assert isinstance(outcomes[0].outcome, Rejected)
    assert all(isinstance(t.outcome, Match) for t in outcomes[1:])
    assert error(se2(0.25, 0.0, 0.0), outcomes[-1].T_odom_base)[0] < 0.03


def test_standing_still_neither_grows_nor_drifts() -> None:
    tracker = KissTracker(KissConfig())
    poses = [
        tracker.track(
            scan_of(ROOM, se2(2.0, 2.0, 0.5), seed=k, noise_m=0.01),
            motion_of(np.eye(3), 0.01, 0.03),
        ).T_odom_base
        for k in range(100)
    ]
    assert max(error(np.eye(3), T)[0] for T in poses) < 0.03
    assert len(np.asarray(tracker._map._point_cloud())) < 600


@pytest.mark.parametrize("setting", ["kiss.voxel=0.1", "kiss.mapping.voxel_size=0.1"])
def test_a_misspelt_key_is_an_error(setting: str) -> None:
    with pytest.raises(InputError, match="kiss"):
        load_config(None, [setting])


@pytest.mark.parametrize("values", [{"voxel_m": 0.0}, {"min_inlier_ratio": 1.5}, {"voxels": 0.1}])
def test_values_out_of_range_are_errors(values: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        KissConfig(**values)  # type: ignore[arg-type]


def test_the_scan_generator_sees_the_walls_where_they_are() -> None:
    T_world_base = se2(2.0, 2.0, 0.7)
    points = transform(T_world_base, scan_of(ROOM, T_world_base).points_base)
    on_wall = np.abs(points[:, 1]) < 1e-6
    assert on_wall.sum() > 50
    assert (points[on_wall, 0] >= 0.0).all()
    assert (points[on_wall, 0] <= 7.0).all()
