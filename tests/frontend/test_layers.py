"""What a camera alone saw: it helps where the lidar sees too little, and never does harm."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import se2
from frontend import match_kernels
from frontend.local_map import LocalMap
from frontend.match import Match, Rejected
from frontend.matching import LOW_COMMON_INFORMATION, SIGMA_M, match_surface, sharing
from frontend.prepared import LIDAR_SIGMA_M, PreparedScan, point_weights, prepare
from fusion.scan import BOTH, CAMERA, CAMERA_LAYER, LIDAR, LIDAR_LAYER, FusedScan
from tests.frontend.drives import ROUND_THE_ROOM, Drive, drive, errors, local_slam, poses_of, run
from tests.frontend.low_things import along_errors, drive_past, with_low
from tests.frontend.rooms import CORRIDOR, ROOM, box, fused, off_by, walls

STILL = np.zeros(3)
BOXES = walls(*[box(2.0 + 2.2 * k, -0.95 if k % 2 else 0.55, 0.4, 0.4) for k in range(6)])
"""Along both walls of CORRIDOR, 10 cm and less from them."""
LOW_IN_ROOM = walls(*[box(x, y, 0.4, 0.4) for x, y in ((3, 0.3), (5.5, 3), (7, 0.2), (9, 3.5))])
PRIOR = (0.03, 0.03)


def seen(T: Array, low: Array = BOXES, room: Array = CORRIDOR) -> FusedScan:
    return with_low(fused(room, T, max_range_m=6.0), low, T)


def with_variance(scan: FusedScan, low_variance_m2: float) -> FusedScan:
    low = scan.layer == CAMERA_LAYER
    return replace(scan, variance_m2=np.where(low, low_variance_m2, scan.variance_m2))


def matched(scan: FusedScan, local_map: LocalMap, T: Array, T_guess: Array) -> Match:
    found = match_surface(prepare(scan, STILL), local_map, T_guess, T_guess, PRIOR)
    assert isinstance(found, Match)
    assert off_by(T, found.T_frame_base)[1] < 0.01
    return found


@cache
def corridor_map(low: bool) -> LocalMap:
    poses = [se2(0.2 * k, 0.0, 0.0) for k in range(10)]
    scans = [seen(T) if low else fused(CORRIDOR, T, max_range_m=6.0) for T in poses]
    return LocalMap.around([(prepare(s, STILL), T) for s, T in zip(scans, poses, strict=True)])


@pytest.fixture(scope="module")
def down_the_corridor() -> Drive:
    return drive(CORRIDOR, ((0.0, 0.0), (10.0, 0.0)), max_range_m=6.0, wheel_scale=1.02)


def test_each_layer_has_the_normals_it_would_have_alone() -> None:
    """The boxes stand before the walls: neighbours by bearing are of both."""
    T = se2(1.0, 0.1, 0.2)
    scan, alone = prepare(seen(T), STILL), prepare(fused(CORRIDOR, T, max_range_m=6.0), STILL)
    main, low = scan.part(LIDAR_LAYER), scan.part(CAMERA_LAYER)
    assert scan.main_count == len(alone.points_base)
    assert low.stop - low.start > 50
    for name in ("points_base", "normals_base", "bearings_rad", "weights"):
        assert np.array_equal(getattr(scan, name)[main], getattr(alone, name))
    known = scan.normals_base[low].any(axis=1)
    assert known.mean() > 0.5  # some stand at the corners, or are seen at too flat an angle
    upright = np.abs(scan.normals_base[low][known] @ T[:2, :2].T).max(axis=1)
    assert (upright > 0.99).mean() > 0.8
    assert scan.surface_count == alone.surface_count


@settings(deadline=None, max_examples=30)
@given(turn_rad_s=st.floats(-3.0, 3.0), speed_m_s=st.floats(-2.0, 2.0))
def test_after_deskewing_bearings_ascend_in_each_layer(turn_rad_s: float, speed_m_s: float) -> None:
    lidar = fused(ROOM, se2(4.5, 3.0, 0.5), turn_s=0.1, stamp_ns=5)
    raw = with_low(lidar, LOW_IN_ROOM, se2(4.5, 2.0, 0.5))
    scan = prepare(raw, np.array([speed_m_s, 0.0, turn_rad_s]))
    assert np.array_equal(scan.layer, raw.layer)
    for layer in (LIDAR_LAYER, CAMERA_LAYER):
        assert (np.diff(scan.bearings_rad[scan.part(layer)]) >= 0.0).all()
    assert sorted(scan.weights) == pytest.approx(sorted(point_weights(raw)))


def test_weights_are_the_lidar_s_variance_over_the_point_s() -> None:
    raw = fused(CORRIDOR, np.eye(3), beams=8, first_rad=0.5, fov_rad=1.0)
    assert len(raw.source) == 8
    source = np.array([LIDAR, LIDAR, BOTH, BOTH, CAMERA, CAMERA, LIDAR, CAMERA], dtype=np.uint8)
    variance = np.array([0.0, 9.0, 10e-4, 10e-4, 10e-4, 28e-4, 1.0, 1e-4])
    # in paper mode a beam that both saw keeps the smaller range, which may be the camera's
    longer = raw.lidar_range_m + np.array([0, 0, 0, 0.02, 0, 0, 0, 0])
    assert pytest.approx(1e-4) == LIDAR_SIGMA_M**2
    assert pytest.approx(9e-4) == SIGMA_M**2
    scan = replace(raw, source=source, variance_m2=variance, lidar_range_m=longer)
    assert scan.at_lidar_range.tolist() == [True, True, True, False, False, False, True, False]
    assert point_weights(scan).tolist() == pytest.approx([1, 1, 1, 0.5, 0.5, 0.25, 1, 1])


def test_a_low_surface_is_made_when_something_low_is_seen_and_leaves_the_fields_alone() -> None:
    T = se2(1.0, 0.1, 0.2)
    bare, scan = prepare(fused(CORRIDOR, T, max_range_m=6.0), STILL), prepare(seen(T), STILL)
    low, high = np.array([-6.0, -2.0]), np.array([8.0, 2.0])
    without, both = LocalMap(low, high), LocalMap(low, high)
    empty_bytes = both.memory_bytes
    without.insert(bare, T)
    assert without.memory_bytes == empty_bytes
    both.insert(scan, T)
    assert both.memory_bytes > empty_bytes
    places = np.random.default_rng(0).uniform([-5.0, -1.2], [7.0, 1.2], (400, 2))
    for place in places:
        assert both.score(place[None], np.eye(3)) == without.score(place[None], np.eye(3))


@pytest.mark.parametrize("seed", [0, 1])
def test_boxes_show_the_way_along_a_bare_corridor(down_the_corridor: Drive, seed: int) -> None:
    past = drive_past(down_the_corridor, BOXES, seed=seed)
    alone, helped = local_slam(), local_slam()
    without = along_errors(past.T_world_base, poses_of(run(alone, down_the_corridor)))
    results = run(helped, past)
    along = along_errors(past.T_world_base, poses_of(results))
    assert np.abs(without).max() > 0.15
    assert np.abs(along).max() < 0.02
    assert alone.unobserved_m > 9.0
    assert helped.unobserved_m < 0.1
    weak_m = [r.tracked.outcome.weak_sigma_m for r in results[1:]]  # type: ignore[union-attr]
    assert max(weak_m) < 0.05


@pytest.mark.parametrize("away_m", [0.02, 0.05, 0.1, 0.15])
def test_a_box_before_a_wall_does_not_pull(away_m: float) -> None:
    """The map knows the wall only, as where the camera sees the box for the first time."""
    T = se2(1.0, 0.3, 0.9)
    low = walls(((1.4, 1.0 - away_m), (2.4, 1.0 - away_m)))
    T_guess = T @ se2(0.01, 0.02, 0.01)
    plain = matched(fused(CORRIDOR, T, max_range_m=6.0), corridor_map(False), T, T_guess)
    for known in (False, True):
        found = matched(seen(T, low), corridor_map(known), T, T_guess)
        if known:  # other boxes, none of them where this one stands
            assert off_by(plain.T_frame_base, found.T_frame_base)[0] < 0.003
        else:
            assert np.array_equal(plain.T_frame_base, found.T_frame_base)
            assert np.array_equal(plain.information, found.information)
        assert found.inlier_ratio == pytest.approx(plain.inlier_ratio, abs=1e-3)


def test_what_is_measured_worse_counts_less() -> None:
    T = se2(1.0, 0.05, 0.02)
    found = [
        matched(with_variance(seen(T), variance), corridor_map(True), T, T @ se2(0.02, 0, 0))
        for variance in (1e-4, 10e-4, 100e-4)
    ]
    bare = matched(fused(CORRIDOR, T, max_range_m=6.0), corridor_map(True), T, T)
    along = [match.information[0, 0] for match in found]
    assert along[0] > 1.3 * along[1] > 1.69 * along[2] > 0.0
    assert bare.information[0, 0] < 0.1 * along[2]
    off = [abs(match.T_frame_base[0, 2] - 1.0) for match in found]
    assert off[0] < off[1] < off[2] < 0.02
    # as many lidar points on the same boxes know more than the camera's ever can
    raw = seen(T)
    as_lidar = replace(raw, layer=np.zeros_like(raw.layer), source=np.zeros_like(raw.source))
    poses = [se2(0.2 * k, 0.0, 0.0) for k in range(10)]
    flat = []
    for T_each in poses:
        each = seen(T_each)
        flat.append((prepare(replace(each, layer=np.zeros_like(each.layer)), STILL), T_each))
    lidar = matched(as_lidar, LocalMap.around(flat), T, T @ se2(0.02, 0, 0))
    assert lidar.information[0, 0] > along[0]
    assert along[0] < LOW_COMMON_INFORMATION[0]


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), size=st.floats(1e-3, 1e8), rank=st.integers(0, 5))
def test_a_shared_error_is_eliminated_exactly(seed: int, size: float, rank: int) -> None:
    """Twin: the joint system of pose and displacement, solved as one."""
    random = np.random.default_rng(seed)
    J = np.sqrt(size) * random.standard_normal((rank, 3))
    common = np.array([2500.0, 2500.0, 1e4])
    H, g = J.T @ J, J.T @ random.standard_normal(rank)
    joint = np.block([[H, H], [H, H + np.diag(common)]])
    # eliminate the last three unknowns
    gain = joint[:3, 3:] @ np.linalg.inv(joint[3:, 3:])
    expected_H, expected_g = H - gain @ H, g - gain @ g
    scale = max(1e-9, min(size, 1e4)) * 1e-5
    assert sharing(H, common) == pytest.approx(expected_H, rel=1e-5, abs=scale)
    assert np.linalg.eigvalsh(np.diag(common) - sharing(H, common)).min() > -1e-6
    found_H, found_g = H.copy(), g.copy()
    assert match_kernels.share_error(common, found_H, found_g)
    assert found_H == pytest.approx(sharing(H, common), rel=1e-5, abs=scale)
    assert found_g == pytest.approx(expected_g, rel=1e-4, abs=1e-4 * np.sqrt(size))


@pytest.mark.parametrize("range_scale", [0.98, 1.0, 1.02])
def test_a_camera_with_a_wrong_scale_moves_little_where_the_lidar_sees_all(
    range_scale: float,
) -> None:
    plain = drive(ROOM, ROUND_THE_ROOM, seed=3)
    off_plain = errors(plain.T_world_base, poses_of(run(local_slam(), plain)))[:, 0]
    past = drive_past(plain, LOW_IN_ROOM, range_scale=range_scale)
    off = errors(past.T_world_base, poses_of(run(local_slam(), past)))[:, 0]
    assert off.mean() < off_plain.mean() + 0.002
    assert off.max() < off_plain.max() + 0.004


@pytest.mark.parametrize("cart_m_s", [0.5, 0.9, 1.3])
def test_a_low_cart_that_drives_ahead_does_not_take_the_robot_along(
    down_the_corridor: Drive, cart_m_s: float
) -> None:
    random = np.random.default_rng(1)
    scans = [
        with_low(scan, walls(box(2.0 + 0.1 * cart_m_s * k, -0.2, 0.5, 0.4)), T, random=random)
        for k, (scan, T) in enumerate(
            zip(down_the_corridor.scans, down_the_corridor.T_world_base, strict=True)
        )
    ]
    results = run(local_slam(), replace(down_the_corridor, scans=scans))
    along = along_errors(down_the_corridor.T_world_base, poses_of(results))
    without = along_errors(
        down_the_corridor.T_world_base, poses_of(run(local_slam(), down_the_corridor))
    )
    assert np.abs(along).max() < np.abs(without).max() + 0.1


def test_a_scan_of_low_points_only_is_blind() -> None:
    """They are not laid on what the lidar saw: the prediction holds."""
    T = se2(1.0, 0.05, 0.02)
    raw = seen(T)
    low = raw.layer == CAMERA_LAYER
    names = ("points_base", "source", "layer", "variance_m2", "lidar_range_m", "camera_range_m")
    only = replace(raw, **{name: getattr(raw, name)[low] for name in names})
    scan: PreparedScan = prepare(only, STILL)
    assert scan.main_count == scan.surface_count == 0
    assert isinstance(match_surface(scan, corridor_map(True), T, T, PRIOR), Rejected)
    results = run(
        local_slam(), Drive([T, T], [raw, only], drive(ROOM, ((0, 0), (1, 0))).odometry[:2])
    )
    assert isinstance(results[1].tracked.outcome, Rejected)
