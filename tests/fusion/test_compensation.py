"""Pseudo-scans against lidar scans: what both saw, what is put in, filled and left out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import inverse, se2, transform
from fusion.compensation import Compensation, CompensationConfig
from fusion.lidar_only import BeamLimits
from fusion.placed_points import PlacedView
from fusion.pseudo_scan import PseudoScan
from fusion.scan import BOTH, CAMERA, LIDAR, FusedScan
from fusion.sweep import Sweep
from tests.fusion.views import WALLS, box, cast, clockwise, pseudo_of, stereo_sigma_m, sweep_of

EXACT = CompensationConfig(systematic_share=0.0, placing_m=0.0)
NOISE = BeamLimits(noise_m=0.01, noise_per_m=0.0)
STILL = np.zeros(3)
AHEAD = np.linspace(-0.75, 0.75, 301)
"""300 bins of 5 mrad: a depth camera's view."""


def fuse(sweep: Sweep, pseudo: PseudoScan, config: CompensationConfig | None = None) -> FusedScan:
    view = PlacedView(pseudo, np.eye(3))
    return Compensation(config or CompensationConfig()).fuse(sweep, [view], STILL)


def bearings(scan: FusedScan) -> Array:
    rays = scan.points_base - scan.origin_base
    angles: Array = np.arctan2(rays[:, 1], rays[:, 0])
    return angles


def ranges(scan: FusedScan) -> Array:
    lengths: Array = np.hypot(*(scan.points_base - scan.origin_base).T)
    return lengths


def ring(radius_m: float, count: int = 360) -> Sweep:
    """Beams in the middle of a round room, one a degree."""
    angles = np.radians(np.arange(count) - 180.0)
    return sweep_of(np.full(count, radius_m), angles, limits=NOISE)


def test_what_both_saw_stays_where_the_lidar_has_it() -> None:
    # one point, looking along the beam at 10 deg from the lidar's own place
    sweep = ring(2.0)
    scan = fuse(sweep, pseudo_of(np.radians([10.0]), np.array([2.03]), 0.03, (0.0, 0.0)), EXACT)
    assert np.flatnonzero(scan.source == BOTH).tolist() == [190]
    assert (scan.points_base == sweep.points_base).all()
    assert (scan.variance_m2 == sweep.variance_m2).all()
    assert scan.lidar_range_m[190] == pytest.approx(2.0)
    assert scan.camera_range_m[190] == pytest.approx(2.03)
    assert scan.layer.any() == np.False_
    others = np.delete(np.arange(360), 190)
    assert np.isnan(scan.camera_range_m[others]).all()


@pytest.mark.parametrize(("off_sigmas", "source"), [(1.9, BOTH), (2.0, LIDAR), (-2.0, LIDAR)])
def test_the_gate_is_the_one_of_eq_11(off_sigmas: float, source: int) -> None:
    sigma = math.hypot(0.01, 0.03)
    seen = pseudo_of(np.array([0.0]), np.array([2.0 + off_sigmas * sigma]), 0.03, (0.0, 0.0))
    scan = fuse(ring(2.0), seen, EXACT)
    assert scan.source[180] == source
    assert len(scan.points_base) == 360  # two sigma too near is no second wall


def test_what_is_nearer_is_an_obstacle_what_is_farther_is_left_out() -> None:
    seen = pseudo_of(np.radians([-30.2, 0.0, 20.0]), np.array([1.0, 2.6, 1.2]), 0.02, (0.0, 0.0))
    scan = fuse(ring(2.0), seen)
    assert len(scan.points_base) == 362
    assert scan.layer.tolist() == [0] * 360 + [1] * 2
    assert scan.source[360:].tolist() == [CAMERA, CAMERA]
    assert np.degrees(bearings(scan)[360:]) == pytest.approx([-30.2, 20.0])
    assert ranges(scan)[360:] == pytest.approx([1.0, 1.2])
    assert scan.camera_range_m[360:] == pytest.approx([1.0, 1.2])
    assert scan.lidar_range_m[360:] == pytest.approx(2.0, abs=1e-3)
    # the beams over them stay, and know what the camera has there
    assert ranges(scan)[:360] == pytest.approx(2.0)
    assert scan.camera_range_m[[150, 180, 200]] == pytest.approx([1.0, 2.6, 1.2])


def test_in_one_grid_the_nearer_point_replaces_the_beams_it_hides() -> None:
    seen = pseudo_of(np.radians([-30.2, 0.0, 180.0]), np.array([1.0, 2.6, 1.2]), 0.02, (0.0, 0.0))
    scan = fuse(ring(2.0), seen, CompensationConfig(layers=False))
    assert len(scan.points_base) == 360
    assert not scan.layer.any()
    assert (np.diff(bearings(scan)) > 0.0).all()
    camera = scan.source == CAMERA
    assert np.degrees(bearings(scan)[camera]) == pytest.approx([-30.2, 180.0])
    assert ranges(scan)[~camera] == pytest.approx(2.0)


@pytest.mark.parametrize("nothing", [math.inf, -math.inf, math.nan])
@pytest.mark.parametrize("layers", [True, False])
def test_holes_of_the_lidar_are_filled(nothing: float, layers: bool) -> None:
    angles = np.radians(np.arange(360) - 180.0)
    lengths = np.full(360, 2.0)
    lengths[190:200] = nothing
    seen = pseudo_of(np.radians([12.0, 14.0]), np.array([1.5, 5.0]), 0.02, (0.0, 0.0))
    scan = fuse(sweep_of(lengths, angles), seen, CompensationConfig(layers=layers))
    assert len(scan.points_base) == 352
    filled = scan.source == CAMERA
    assert np.degrees(bearings(scan)[filled]) == pytest.approx([12.0, 14.0])
    assert ranges(scan)[filled] == pytest.approx([1.5, 5.0])
    assert np.isnan(scan.lidar_range_m[filled]).all()
    assert scan.layer[filled].tolist() == ([1, 1] if layers else [0, 0])


def test_beyond_the_lidars_field_of_view_all_is_new() -> None:
    angles = np.linspace(-0.302, 0.302, 61)
    sweep = sweep_of(np.full(61, 2.0), angles)
    scan = fuse(sweep, pseudo_of(AHEAD, np.full(301, 2.0), 0.02, (0.0, 0.0)))
    added = scan.source == CAMERA
    assert (np.abs(bearings(scan)[added]) > 0.3).all()
    assert np.count_nonzero(added) == np.count_nonzero(np.abs(AHEAD) > 0.3121)
    assert np.count_nonzero(scan.source == BOTH) == 61


@pytest.mark.parametrize("bias", [-0.02, -0.01, 0.0, 0.01, 0.02])
@pytest.mark.parametrize("place", [(0.0, 0.0), (-4.0, 0.7), (3.0, -0.9)])
def test_a_corridor_seen_at_grazing_angles_gets_no_second_wall(
    bias: float, place: tuple[float, float]
) -> None:
    """Both sensors with their noise, the camera besides too long or too short as a whole."""
    random = np.random.default_rng(7)
    walls = [
        ((ax - place[0], ay - place[1]), (bx - place[0], by - place[1]))
        for (ax, ay), (bx, by) in WALLS
    ]
    turned = clockwise()
    added = 0
    for _ in range(5):
        lidar = cast(walls, np.zeros(2), turned)
        lidar += (0.01 + 0.003 * lidar) * random.standard_normal(lidar.size)
        true = cast(walls, np.array([0.15, 0.0]), AHEAD)
        true[true > 6.0] = np.nan
        sigma = stereo_sigma_m(true)
        seen = pseudo_of(AHEAD, true * (1.0 + bias) + sigma * random.standard_normal(301), sigma)
        scan = fuse(sweep_of(lidar, turned), seen)
        added += np.count_nonzero(scan.source == CAMERA)
        walls_m = np.abs(scan.points_base[scan.source == BOTH][:, 1] + place[1])
        ends = np.abs(scan.points_base[scan.source == BOTH][:, 0] + place[0]) > 9.5
        assert np.abs(walls_m[~ends] - 1.2).max() < 0.08
    assert added <= 1  # of 1000 to 1500 points


@pytest.mark.parametrize("bias", [-0.015, 0.015])
def test_a_camera_that_is_off_as_a_whole_moves_no_wall(bias: float) -> None:
    """Its ranges all err alike: the more beams took them in, the less a scan could mend it."""
    random = np.random.default_rng(1)
    turned = clockwise()
    true = cast(WALLS, np.array([0.15, 0.0]), AHEAD)
    true[true > 5.0] = np.nan
    sigma = stereo_sigma_m(true)
    off, count = [], 0
    for _ in range(20):
        lidar = cast(WALLS, np.zeros(2), turned)
        lidar += (0.01 + 0.003 * lidar) * random.standard_normal(lidar.size)
        seen = pseudo_of(AHEAD, true * (1.0 + bias) + sigma * random.standard_normal(301), sigma)
        scan = fuse(sweep_of(lidar, turned), seen)
        both = scan.source == BOTH
        count += np.count_nonzero(both)
        off.extend(np.abs(scan.points_base[both & (scan.points_base[:, 0] < 8.0)][:, 1]) - 1.2)
    assert count > 1000
    assert abs(np.mean(off)) < 0.001  # the camera's own: 1.2 m * 1.5 % = 18 mm


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_low_box_at_the_wall_stands_where_it_is(side: float) -> None:
    """0.4 m deep against one wall; the lidar looks over it."""
    low = box(2.0, 0.8 if side > 0 else -1.2, 0.5, 0.4)
    turned = clockwise()
    sweep = sweep_of(cast(WALLS, np.zeros(2), turned), turned)
    true = cast(WALLS + low, np.array([0.15, 0.0]), AHEAD)
    on_box = cast(low, np.array([0.15, 0.0]), AHEAD) == true
    true[true > 5.0] = np.nan
    scan = fuse(sweep, pseudo_of(AHEAD, true, stereo_sigma_m(true)))
    found = scan.points_base[scan.layer == 1]
    assert (np.sign(found[:, 1]) == side).all()
    # the front 2.0 m ahead and the side 0.8 m off, but for what lies within errors of the wall
    off = np.minimum(np.abs(found[:, 0] - 2.0), np.abs(np.abs(found[:, 1]) - 0.8))
    assert off.max() < 1e-6
    assert len(found) > 0.75 * np.count_nonzero(on_box)
    assert np.abs(found[:, 1]).max() > 1.05


def moved(velocity: Array, dt_s: Array | float) -> list[Array]:
    """T_middle_base of a base with a constant twist, by small steps: (N,) of (3, 3)."""
    poses = []
    for dt in np.atleast_1d(dt_s):
        steps = 100
        T = np.eye(3)
        step = se2(*(velocity * dt / steps))
        for _ in range(steps):
            T = T @ step
        poses.append(T)
    return poses


@pytest.mark.parametrize("velocity", [(0.8, 0.0, 0.0), (0.3, 0.0, 1.0), (-0.4, 0.1, -1.2)])
def test_a_moving_base_sees_one_world(velocity: tuple[float, float, float]) -> None:
    """Lidar beams, and an image 60 ms late, from where the base is then: all associated, and a low
    box, brought back from each point's own time, is where it stands."""
    twist = np.array(velocity)
    turned = clockwise(600)
    offsets = np.arange(600) * (1 / 7.0 / 600)
    middle = 0.5 * offsets[-1]
    low = box(1.5, -0.3, 0.4, 0.4)
    lidar = np.empty(600)
    poses = moved(twist, offsets - middle)
    for i, T in enumerate(poses):
        yaw = math.atan2(T[1, 0], T[0, 0])
        lidar[i] = cast(WALLS, T[:2, 2], np.array([turned[i] + yaw]))[0]
    T_base_view = moved(twist, 0.06)[0]
    eye = transform(T_base_view, np.array([[0.15, 0.0]]))[0]
    yaw = math.atan2(T_base_view[1, 0], T_base_view[0, 0])
    true = cast(WALLS + low, eye, AHEAD + yaw)
    true[true > 4.0] = np.nan
    pseudo = pseudo_of(AHEAD, true, stereo_sigma_m(true))
    sweep = sweep_of(lidar, turned, offsets)
    config = CompensationConfig(placing_m=0.005, systematic_share=0.0)
    scan = Compensation(config).fuse(sweep, [PlacedView(pseudo, T_base_view)], twist)
    assert sweep.moment_ns == 1_000_000_000 + round(middle * 1e9)
    both, added = scan.source == BOTH, scan.layer == 1
    assert np.count_nonzero(both) > 60
    back = np.array(
        [
            transform(T, point[None])[0]
            for T, point in zip(
                moved(twist, scan.offsets_s - middle), scan.points_base, strict=True
            )
        ]
    )
    # beams stay on the walls, the box on the box
    wall = np.abs(back[both][:, 0]) < 9.5
    assert np.abs(np.abs(back[both][wall][:, 1]) - 1.2).max() < 0.01
    corners = np.array([[1.5, -0.3], [1.9, -0.3], [1.9, 0.1], [1.5, 0.1]])
    off = np.min(
        [
            np.abs(back[added][:, 0] - 1.5),
            np.abs(back[added][:, 1] - corners[2, 1]),
            np.abs(back[added][:, 1] + 0.3),
        ],
        axis=0,
    )
    assert np.count_nonzero(added) > 20
    assert off.max() < 0.002
    # each at the time of the beam of its bearing
    order = np.argsort(sweep.bearings_rad)
    nearest = np.abs(bearings(scan)[added][:, None] - sweep.bearings_rad[order]).argmin(axis=1)
    assert scan.offsets_s[added] == pytest.approx(sweep.offsets_s[order][nearest], abs=0.0003)


def test_a_camera_that_looks_backwards_is_compared_across_the_seam() -> None:
    behind = np.linspace(math.pi - 0.4, math.pi + 0.4, 160)
    turned = clockwise()
    sweep = sweep_of(cast(WALLS, np.zeros(2), turned), turned, np.arange(1286) / 9000.0)
    true = cast(WALLS, np.array([-0.2, 0.0]), behind)
    scan = fuse(sweep, pseudo_of(behind, true, 0.05, (-0.2, 0.0)))
    assert (scan.source != CAMERA).all()
    both = bearings(scan)[scan.source == BOTH]
    assert both.min() < -3.1
    assert both.max() > 3.1
    assert np.count_nonzero(scan.source == BOTH) > 120


def test_without_views_or_without_beams_the_lidars_own_scan_comes_back() -> None:
    sweep = ring(2.0)
    alone = Compensation(CompensationConfig()).fuse(sweep, [], STILL)
    assert alone.points_base == pytest.approx(sweep.returns().points_base)
    blind = pseudo_of(AHEAD, np.full(301, np.nan), 0.01)
    assert len(fuse(sweep, blind).points_base) == 360
    empty = sweep_of(np.empty(0), np.empty(0))
    assert len(fuse(empty, pseudo_of(AHEAD, np.ones(301), 0.01)).points_base) == 0


def test_several_views_are_taken_together() -> None:
    left = pseudo_of(np.radians([40.0, 41.0]), np.array([1.0, 1.0]), 0.02, (0.0, 0.0))
    behind = pseudo_of(np.radians([-1.0, 0.0]), np.array([1.2, 1.2]), 0.02, (0.0, 0.0))
    views = [PlacedView(left, np.eye(3)), PlacedView(behind, se2(0.0, 0.0, math.pi - 0.1))]
    scan = Compensation(CompensationConfig()).fuse(ring(2.0), views, STILL)
    wanted = np.sort([40.0, 41.0, 179.0 - math.degrees(0.1), 180.0 - math.degrees(0.1)])
    assert np.degrees(bearings(scan)[scan.layer == 1]) == pytest.approx(wanted)


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    beams=st.integers(1, 60),
    points=st.integers(0, 40),
    layers=st.booleans(),
    timed=st.booleans(),
)
def test_any_input_gives_a_scan_in_order(
    seed: int, beams: int, points: int, layers: bool, timed: bool
) -> None:
    random = np.random.default_rng(seed)
    lengths = random.uniform(0.2, 5.0, beams)
    lengths[random.random(beams) < 0.2] = np.inf
    lengths[random.random(beams) < 0.1] = np.nan
    offsets = random.uniform(0.0, 0.14, beams) if timed else None
    sweep = sweep_of(lengths, random.uniform(-math.pi, math.pi, beams), offsets, (0.2, -0.1))
    true = random.uniform(0.0, 5.0, points)
    pseudo = pseudo_of(np.sort(random.uniform(-3.0, 3.0, points)), true, 0.02)
    T = se2(*random.uniform(-0.2, 0.2, 3))
    twist = random.uniform(-1.0, 1.0, 3)
    config = CompensationConfig(layers=layers)
    fused = Compensation(config)
    scan = fused.fuse(sweep, [PlacedView(pseudo, T)], twist)
    for layer in (0, 1):
        assert (np.diff(bearings(scan)[scan.layer == layer]) >= -1e-9).all()
    assert (scan.variance_m2 > 0.0).all()
    assert np.isfinite(scan.camera_range_m[scan.source != LIDAR]).all()
    assert np.isfinite(scan.lidar_range_m[scan.source != CAMERA]).all()
    assert layers or not scan.layer.any()
    again = fused.fuse(sweep, [PlacedView(pseudo, T)], twist)
    assert again.points_base.tobytes() == scan.points_base.tobytes()


def test_turning_the_whole_world_turns_the_result() -> None:
    """What comes out does not depend on where the base's axes point, the seam included."""
    turned = clockwise(720)
    low = box(1.5, 0.2, 0.4, 0.4)
    lidar = cast(WALLS, np.zeros(2), turned)
    ahead = AHEAD + 0.0011  # never half-way between two beams
    true = cast(WALLS + low, np.zeros(2), ahead)
    true[true > 4.0] = np.nan
    pseudo = pseudo_of(ahead, true, 0.02, (0.0, 0.0))
    straight = fuse(sweep_of(lidar, turned), pseudo)
    for yaw in (1.0, 2.9, math.pi, -2.0):
        about = pseudo_of(ahead + yaw, true, 0.02, (0.0, 0.0))
        scan = fuse(sweep_of(lidar, turned + yaw), about)
        assert np.bincount(scan.source, minlength=3).tolist() == (
            np.bincount(straight.source, minlength=3).tolist()
        )
        back = transform(inverse(se2(0.0, 0.0, yaw)), scan.points_base)
        gaps = np.abs(back[:, None] - straight.points_base[None]).sum(axis=2).min(axis=1)
        assert gaps.max() < 1e-9


def test_a_view_without_a_place_is_refused() -> None:
    pseudo = pseudo_of(np.array([0.0]), np.array([1.0]), 0.01)
    with pytest.raises(ValueError, match="T_base_view"):
        PlacedView(pseudo, np.eye(4))
    with pytest.raises(ValueError, match="T_base_view"):
        replace(PlacedView(pseudo, np.eye(3)), T_base_view=np.full((3, 3), np.nan))
