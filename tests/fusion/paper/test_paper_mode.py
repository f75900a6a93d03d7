"""The paper's method: equation by equation, and nothing mirrored."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array, DepthImage, Float32s
from datasets.recording import CameraCalibration, Intrinsics
from fusion.paper.mode import PaperConfig, PaperProjection, paper_fuse
from fusion.paper.paper_kernels import column_minimum
from fusion.pseudo_scan import PseudoScan
from fusion.scan import BOTH, CAMERA, LIDAR
from fusion.sweep import Sweep
from tests.fusion.views import pseudo_of, sweep_of

OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""R_base_camera of a level camera that looks ahead: z forward, x right, y down."""

WIDTH, HEIGHT, FOCAL_PX = 640, 480, 384.0


def camera(
    x: float = 0.15, y: float = 0.0, z: float = 0.25, rotation: Array = OPTICAL
) -> CameraCalibration:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, (x, y, z)
    K = np.array([[FOCAL_PX, 0.0, 319.5], [0.0, FOCAL_PX, 239.5], [0.0, 0.0, 1.0]])
    return CameraCalibration(T, Intrinsics(K, WIDTH, HEIGHT))


def image(depth_m: Float32s) -> DepthImage:
    return DepthImage(7, "camera", depth_m)


def empty() -> Float32s:
    return np.full((HEIGHT, WIDTH), np.nan, dtype=np.float32)


def turning(count: int, range_m: float) -> Sweep:
    """Clockwise, the first beam backwards, as (16) counts."""
    bearings = math.pi - np.arange(count) * 2.0 * math.pi / count
    return sweep_of(np.full(count, range_m), bearings)


def algorithm_1(lidar: Array, sense: Array, omega: Array, dist: float) -> Array:
    """Algorithm 1 as printed, (13) to (16); i counts clockwise, N/2 looks forward."""
    fused, N = lidar.copy(), lidar.size
    for k in range(sense.size):
        theta = math.pi - abs(omega[k])  # (13)
        s1 = math.sqrt(dist**2 + sense[k] ** 2 - 2 * dist * sense[k] * math.cos(theta))  # (14)
        phi = math.asin(sense[k] * math.sin(theta) / s1)  # (15)
        turned = math.pi - phi if omega[k] < 0 else math.pi + phi
        i = round(turned / (2 * math.pi) * N) % N  # (16)
        fused[i] = min(fused[i], s1)
    return fused


def clockwise_ranges(sweep: Sweep, points: Array) -> Array:
    """Ranges in the order of (16), inf where there is no point."""
    count = sweep.ranges_m.size
    rays = points - sweep.origin_base
    turned = (math.pi - np.arctan2(rays[:, 1], rays[:, 0])) / (2 * math.pi) * count
    lengths = np.full(count, np.inf)
    lengths[np.rint(turned).astype(int) % count] = np.hypot(*rays.T)
    return lengths


@pytest.mark.parametrize("dist", [0.0, 0.15, 0.6])
@pytest.mark.parametrize("count", [720, 1286])
def test_the_transform_for_any_mounting_is_that_of_13_to_16(dist: float, count: int) -> None:
    random = np.random.default_rng(3)
    alpha = math.radians(43.0)
    omega = alpha * (np.arange(1280) - 639.5) / 640.0  # k < 640: the image's left
    sense = random.uniform(0.4, 5.0, 1280)
    lidar = np.where(random.random(count) < 0.1, np.inf, random.uniform(1.0, 6.0, count))
    bearings = math.pi - np.arange(count) * 2.0 * math.pi / count
    sweep = sweep_of(lidar, bearings)
    pseudo = pseudo_of(-omega[::-1], sense[::-1], 0.02, (dist, 0.0))
    scan = paper_fuse(sweep, [pseudo])
    wanted = algorithm_1(lidar, sense, omega, dist)
    assert clockwise_ranges(sweep, scan.points_base) == pytest.approx(wanted, abs=1e-9)
    assert np.count_nonzero(wanted != lidar) > 100


@pytest.mark.parametrize("side", [-1, 1])
def test_nothing_is_mirrored(side: int) -> None:
    """An obstacle in the image's left half stands left of the robot, at positive y."""
    depth = empty()
    columns = slice(100, 140) if side > 0 else slice(500, 540)
    depth[:, columns] = 2.0
    pseudo = PaperProjection(camera(), PaperConfig())(image(depth))
    scan = paper_fuse(turning(1286, 4.0), [pseudo])
    found = scan.points_base[scan.source == CAMERA]
    first, last = ((319.5 - column) / FOCAL_PX * 2.0 for column in (columns.start, columns.stop))
    assert len(found) > 15
    assert (np.sign(found[:, 1]) == side).all()
    assert found[:, 0] == pytest.approx(2.15, abs=0.02)
    assert min(first, last) - 0.02 < found[:, 1].min() < found[:, 1].max() < max(first, last) + 0.02


@settings(deadline=None, max_examples=30)
@given(
    angles=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-3.0, 3.0)),
    place=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    pixel=st.tuples(st.integers(20, WIDTH - 21), st.integers(236, 243)),
    depth_m=st.floats(0.5, 4.0),
)
def test_any_mounting_puts_a_pixel_where_its_3d_point_is(
    angles: tuple[float, float, float],
    place: tuple[float, float],
    pixel: tuple[int, int],
    depth_m: float,
) -> None:
    pitch, roll, yaw = angles
    cp, sp, cr, sr = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
    cy, sy = math.cos(yaw), math.sin(yaw)
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    calibration = camera(*place, rotation=about_z @ about_y @ about_x @ OPTICAL)
    depth = empty()
    column, row = pixel
    depth[row, column] = depth_m
    pseudo = PaperProjection(calibration, PaperConfig())(image(depth))
    x, y = (column - 319.5) / FOCAL_PX, (row - 239.5) / FOCAL_PX
    T = calibration.T_base_camera
    assert T is not None
    wanted = (T @ np.array([x, y, 1.0, 1.0 / depth_m]))[:2] * depth_m
    assert pseudo.points_base == pytest.approx(wanted[None], abs=1e-5)
    assert pseudo.surfaces_base == pytest.approx(wanted[None], abs=1e-5)


def test_only_the_middle_rows_count() -> None:
    for height in (1, 10, 11):
        for row in range(220, 260):
            depth = empty()
            depth[row, 300:310] = 2.0
            pseudo = PaperProjection(camera(), PaperConfig(scan_height_px=height))(image(depth))
            inside = abs(row - 239.5) <= height / 2 and row != 239.5 + height / 2
            assert bool(np.isfinite(pseudo.ranges_m).any()) == inside, (height, row)


def test_a_bin_keeps_the_smallest_range_of_its_pixels() -> None:
    depth = np.full((HEIGHT, WIDTH), 3.0, dtype=np.float32)
    depth[240:, :] = 2.0
    pseudo = PaperProjection(camera(), PaperConfig(bins=100))(image(depth))
    # 2 m of depth, (3): longer beside than ahead, and a bin's smallest is its most inward pixel
    beside = np.abs(pseudo.points_base[:, 1])
    assert pseudo.points_base[:, 0] == pytest.approx(2.15, abs=1e-5)
    assert len(pseudo.ranges_m) == 100
    assert pseudo.ranges_m == pytest.approx(np.hypot(2.0, beside), abs=1e-5)
    assert (np.diff(beside[:50]) < 0.0).all()


def test_the_filter_smooths_noise_keeps_edges_and_leaves_holes() -> None:
    random = np.random.default_rng(0)
    depth = np.full((HEIGHT, WIDTH), 2.0, dtype=np.float32)
    depth[:, :320] = 1.0
    noisy = depth + 0.01 * random.standard_normal(depth.shape).astype(np.float32)
    noisy[:, 400:420] = np.nan
    config = PaperConfig(scan_height_px=1)
    scan = PaperProjection(camera(x=0.0), config)(image(noisy))
    x, y = scan.points_base.T
    near = y > 0.0
    # of pixels 40 mm apart in range one in 49 is left of the noise, were they all alike
    assert np.std(x[near] - 1.0) < 0.004
    assert np.std(x[~near] - 2.0) < 0.004
    assert np.abs(x[near] - 1.0).max() < 0.02
    assert np.abs(x[~near] - 2.0).max() < 0.02
    bearing = np.arctan2(319.5 - 410.0, FOCAL_PX)
    assert np.isnan(scan.ranges_m[np.abs(scan.bearings_rad - bearing).argmin()])


def weighted_mean(depth: Float32s, row: int, column: int) -> float:
    """(5) to (8) at one pixel, over the round neighbourhood 7 px wide."""
    total = weights = 0.0
    for k in range(-3, 4):
        for j in range(-3, 4):
            if math.hypot(k, j) > 3:
                continue
            value = float(depth[row + k, column + j])
            d = math.exp(-(k**2 + j**2) / (2 * 4.5**2))  # (5)
            r = math.exp(-((float(depth[row, column]) - value) ** 2) / (2 * 0.04**2))  # (6)
            total += value * d * r  # (7), (8)
            weights += d * r
    return total / weights


def test_the_filter_is_that_of_5_to_8() -> None:
    random = np.random.default_rng(5)
    depth = (2.0 + 0.05 * random.standard_normal((HEIGHT, WIDTH))).astype(np.float32)
    projection = PaperProjection(camera(), PaperConfig())
    smooth = projection._filtered(depth)
    assert smooth.shape == (10, WIDTH)
    for row, column in ((0, 100), (4, 320), (9, 600)):
        wanted = weighted_mean(depth, 235 + row, column)
        assert smooth[row, column] == pytest.approx(wanted, abs=2e-4)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), parts=st.integers(2, 90))
def test_the_column_minimum_is_that_of_its_plain_twin(seed: int, parts: int) -> None:
    random = np.random.default_rng(seed)
    depth = random.uniform(-0.5, 4.0, (5, 60)).astype(np.float32)
    depth[random.random(depth.shape) < 0.3] = np.nan
    depth[random.random(depth.shape) < 0.1] = np.inf
    alpha, beta = math.atan(-30.0 / 40.0), math.atan(30.0 / 40.0)
    sense, points = np.empty(parts), np.zeros((parts, 3))
    column_minimum(depth, 3, 40.0, 41.0, 29.5, 4.5, alpha, beta, sense, points)
    v, u = np.mgrid[3:8, 0:60]
    used = np.isfinite(depth) & (depth > 0.0)
    z = depth[used].astype(np.float64)
    x, y = (u[used] - 29.5) / 40.0 * z, (v[used] - 4.5) / 41.0 * z
    n = np.floor(parts * (np.arctan2(x, z) - alpha) / (beta - alpha)).astype(int)
    wanted = np.full(parts, np.inf)
    np.minimum.at(wanted, n, np.hypot(x, z))
    assert sense == pytest.approx(wanted)
    hit = np.isfinite(sense)
    assert np.hypot(points[hit, 0], points[hit, 2]) == pytest.approx(sense[hit])
    for part in np.flatnonzero(hit):
        assert np.abs(np.column_stack([x, y, z]) - points[part]).sum(axis=1).min() < 1e-9


def one_beam(lidar_m: float, camera_m: float) -> tuple[float, int]:
    """Range and source of the beam ahead; range nan if it is not there."""
    ranges = np.full(360, 5.0)
    ranges[180] = lidar_m
    bearings = np.radians(np.arange(360) - 180.0)
    ahead: PseudoScan = pseudo_of(np.array([0.0]), np.array([camera_m]), 0.01 * camera_m, (0, 0))
    scan = paper_fuse(sweep_of(ranges, bearings), [ahead])
    assert not scan.layer.any()
    rays = scan.points_base
    found = np.flatnonzero(np.abs(np.arctan2(rays[:, 1], rays[:, 0])) < 0.01)
    if not found.size:
        return math.nan, LIDAR
    return float(np.hypot(*rays[found[0]])), int(scan.source[found[0]])


def test_a_beam_keeps_the_minimum_associated_or_not() -> None:
    # sigma_L 16 mm and sigma_C 20 mm at 2 m: the gate is at 1.96 * 25.6 mm = 50 mm
    assert one_beam(2.0, 1.0) == pytest.approx((1.0, CAMERA))
    assert one_beam(2.0, 1.94) == pytest.approx((1.94, CAMERA))
    assert one_beam(2.0, 1.96) == pytest.approx((1.96, BOTH))
    assert one_beam(2.0, 2.04) == pytest.approx((2.0, BOTH))
    assert one_beam(2.0, 2.06) == pytest.approx((2.0, LIDAR))
    assert one_beam(2.0, 4.0) == pytest.approx((2.0, LIDAR))


def test_no_return_is_filled_what_is_invalid_or_too_near_is_not() -> None:
    assert one_beam(math.inf, 3.0) == pytest.approx((3.0, CAMERA))
    for nothing in (math.nan, -math.inf):
        length, _ = one_beam(nothing, 3.0)
        assert math.isnan(length)


def test_what_both_measured_is_kept_beside_the_minimum() -> None:
    sweep = turning(360, 2.0)
    scan = paper_fuse(sweep, [pseudo_of(np.array([0.0]), np.array([1.2]), 0.012, (0.3, 0.0))])
    at = np.flatnonzero(scan.source == CAMERA)
    assert at.size == 1
    assert scan.lidar_range_m[at] == pytest.approx(2.0)
    assert scan.camera_range_m[at] == pytest.approx(1.5)
    assert scan.variance_m2[at] == pytest.approx(0.012**2)
    assert np.count_nonzero(np.isfinite(scan.camera_range_m)) == 1
    assert len(scan.points_base) == 360


def test_directions_without_a_lidar_beam_are_left_out() -> None:
    sweep = sweep_of(np.full(11, 3.0), np.linspace(-0.1, 0.1, 11))
    seen = pseudo_of(np.linspace(-0.5, 0.5, 101), np.full(101, 1.0), 0.01, (0.0, 0.0))
    scan = paper_fuse(sweep, [seen])
    assert len(scan.points_base) == 11
    assert (scan.source == CAMERA).all()


def test_without_beams_or_pseudo_scans_there_is_nothing_to_compensate() -> None:
    sweep = turning(90, 3.0)
    assert paper_fuse(sweep, []).points_base == pytest.approx(sweep.returns().points_base)
    assert len(paper_fuse(sweep_of(np.empty(0), np.empty(0)), []).points_base) == 0
    holes = PaperProjection(camera(), PaperConfig())(image(empty()))
    assert np.isnan(holes.ranges_m).all()
    assert (paper_fuse(sweep, [holes]).source == LIDAR).all()


def test_what_makes_no_camera_is_refused() -> None:
    known = camera()
    with pytest.raises(ValueError, match="not known"):
        PaperProjection(CameraCalibration(None, known.intrinsics), PaperConfig())
    with pytest.raises(ValueError, match="not known"):
        PaperProjection(CameraCalibration(known.T_base_camera, None), PaperConfig())
    assert known.intrinsics is not None
    K = known.intrinsics.K.copy()
    K[1, 2] = 900.0
    with pytest.raises(ValueError, match="no rows"):
        PaperProjection(
            CameraCalibration(known.T_base_camera, Intrinsics(K, WIDTH, HEIGHT)), PaperConfig()
        )
    with pytest.raises(ValueError, match="320 x 240"):
        PaperProjection(known, PaperConfig())(image(np.ones((240, 320), dtype=np.float32)))


def test_real_images_give_the_minimum_of_their_rows(shared_data: Path) -> None:
    """A level Kinect's views: filtered or not, most bins say the same to the filter's width."""
    import cv2

    K = np.array([[532.6, 0.0, 319.5], [0.0, 532.6, 239.5], [0.0, 0.0, 1.0]])
    calibration = CameraCalibration(camera().T_base_camera, Intrinsics(K, WIDTH, HEIGHT))
    projection = PaperProjection(calibration, PaperConfig())
    files = sorted((shared_data / "depth" / "kinect").glob("*.png"))
    assert files
    for file in files:
        raw = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        depth = np.where(raw > 0, raw / np.float32(1000.0), np.float32(np.nan)).astype(np.float32)
        pseudo = projection(image(depth))
        rows = depth[235:245]
        x = (np.arange(WIDTH) - 319.5) / 532.6
        lengths = rows * np.hypot(x, 1.0)
        plain = np.where(np.isnan(lengths), np.inf, lengths).min(axis=0)
        hit = np.isfinite(pseudo.ranges_m)
        assert np.count_nonzero(hit) <= np.count_nonzero(np.isfinite(plain))
        columns = np.rint(319.5 - np.tan(pseudo.bearings_rad[hit]) * 532.6).astype(int)
        off = pseudo.ranges_m[hit] - plain[columns]
        assert np.quantile(np.abs(off), 0.9) < 0.04
        assert hit.any()
