"""The simulated D435i against what is known of it: formulas, plain twins, cases with answers."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest

from datasets.messages import Array
from datasets.simulation.depth_camera import (
    MODES,
    WINDOW_PX,
    DepthModel,
    _effects,
    random_field,
    simulate_depth,
    to_millimetres,
    true_disparity,
)
from datasets.simulation.depth_kernels import Effects, Float32s, degrade, mark_hidden
from datasets.simulation.place import MATERIALS, Material, Mover, Place, Solid
from datasets.simulation.scene import Scene

WALL = MATERIALS["wall"]
FACES = [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6)]
FACES += [(0, 2, 6), (0, 6, 4), (1, 7, 3), (1, 5, 7)]
Corner = tuple[float, float, float]

SMALL = DepthModel(mode="640x480")
PURE = DepthModel(
    mode="640x480", wave_px=0, ragged_px=0, edge_px=0, mixed_share=0, speckle_share=1e-9, band_px=0
)
"""Noise and geometry only: no seams, nothing ragged."""


def box(low: Corner, high: Corner, material: Material = WALL) -> Solid:
    corners = np.array(list(product(*zip(low, high, strict=True))), dtype=np.float32)
    return Solid("box", corners, np.array(FACES, dtype=np.uint32), material)


def scene(*solids: Solid, movers: tuple[Mover, ...] = ()) -> Scene:
    return Scene(Place("test", solids, movers, floor=False))


def wall_at(x_m: float, material: Material = WALL) -> Solid:
    return box((x_m, -50, -50), (x_m + 1, 50, 50), material)


def camera(height_m: float = 1.0, pitch_rad: float = 0.0, yaw_rad: float = 0.0) -> Array:
    """T_map_camera of a camera that looks along x, pitched down, then turned to the left."""
    T = np.eye(4)
    cp, sp, cy, sy = math.cos(pitch_rad), math.sin(pitch_rad), math.cos(yaw_rad), math.sin(yaw_rad)
    down = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    left = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    T[:3, :3] = left @ down @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    T[2, 3] = height_m
    return T


def shoot(
    of: Scene, model: DepthModel, seed: int = 1, pose: Array | None = None, time_s: float = 0.0
) -> Float32s:
    rng = np.random.default_rng(seed)
    return simulate_depth(of, camera() if pose is None else pose, model, rng, time_s)


def plane_residual_m(depth_m: Float32s, K: Array) -> Array:
    """z of each valid pixel less that of the plane z = a x + b y + c through them all."""
    v, u = np.nonzero(depth_m)
    z = depth_m[v, u].astype(np.float64)
    design = np.column_stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z**0])
    return np.asarray(z - design @ np.linalg.lstsq(design, z, rcond=None)[0])


# ---- noise ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("z_m", [1.0, 2.0, 3.0, 4.0])
@pytest.mark.parametrize("mode", ["1280x720", "640x480"])
def test_the_noise_of_a_plane_is_the_formula_s(mode: str, z_m: float) -> None:
    model = DepthModel(mode=mode, wave_px=0)
    depth_m = shoot(scene(wall_at(z_m)), model)
    expected_m = z_m**2 * model.subpixel_px / (MODES[mode].focal_px * model.baseline_m)
    off_m = plane_residual_m(depth_m, model.K)
    assert off_m.std() == pytest.approx(expected_m, rel=0.05)
    assert depth_m[depth_m > 0].mean() == pytest.approx(z_m, abs=0.1 * expected_m + 0.001 * z_m)


def test_the_noise_of_a_slanted_plane_too() -> None:
    model = SMALL.model_copy(update={"wave_px": 0.0})
    place = scene(box((2, -50, -50), (3, 50, 50)))
    depth_m = shoot(place, model, pose=camera(yaw_rad=0.5))
    off_m = plane_residual_m(depth_m, model.K)
    z_m = depth_m[depth_m > 0].astype(np.float64)
    # The residual along z of a fit in space is that of the depth, by the same formula.
    in_pixels = off_m / z_m**2 * model.focal_baseline
    assert in_pixels.std() == pytest.approx(model.subpixel_px, rel=0.3)
    assert abs(np.median(in_pixels)) < 0.02


def test_neighbours_err_alike_as_the_kernel_says() -> None:
    field = random_field(np.random.default_rng(2), (400, 600), 2, 4.0)
    assert field.std() == pytest.approx(1.0, abs=0.03)
    for lag in (2, 4, 8):
        pairs = (field[:, :-lag] * field[:, lag:]).mean(), (field[:-lag] * field[lag:]).mean()
        assert pairs == pytest.approx([math.exp(-(lag**2) / 4 / 4.0**2)] * 2, abs=0.06)


@pytest.mark.parametrize("phase", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_interpolation_leaves_the_variance_even(phase: tuple[int, int]) -> None:
    field = random_field(np.random.default_rng(5), (800, 800), 2, 2.0)
    assert field[phase[0] :: 2, phase[1] :: 2].std() == pytest.approx(1.0, abs=0.03)


def test_disparity_comes_in_steps() -> None:
    depth_m = shoot(scene(wall_at(2.0)), SMALL)
    steps = SMALL.focal_baseline / depth_m[depth_m > 0].astype(np.float64) * 32
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)


def test_slow_waves_begin_where_they_are_said_to() -> None:
    calm = SMALL.model_copy(update={"wave_px": 0.0})
    near = (shoot(scene(wall_at(2.0)), SMALL), shoot(scene(wall_at(2.0)), calm))
    np.testing.assert_array_equal(*near)
    waving, still = (shoot(scene(wall_at(5.0)), model) for model in (SMALL, calm))
    both = (waving > 0) & (still > 0)
    extra = SMALL.focal_baseline / waving[both] - SMALL.focal_baseline / still[both]
    assert extra.std() == pytest.approx(SMALL.wave_px, rel=0.2)


# ---- geometry ------------------------------------------------------------------------------------


def furnished() -> Scene:
    rng = np.random.default_rng(4)
    boxes = []
    for _ in range(40):
        x, y, z = rng.uniform([0.8, -3, -0.3], [6, 3, 1])
        size = rng.uniform(0.2, 0.6, size=3)
        boxes.append(box((x, y, z), (x + size[0], y + size[1], z + size[2])))
    return scene(wall_at(7.0), box((-50, -50, -1), (50, 50, 0)), *boxes)


def test_what_is_cast_at_every_fourth_pixel_is_what_all_rays_see() -> None:
    of, pose = furnished(), camera(0.6, 0.2, 0.1)
    disparity, signal = true_disparity(of, pose, SMALL, 0.0)
    v, u = np.mgrid[0:480, 0:640]
    rays_camera = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(SMALL.K).T
    lengths = np.linalg.norm(rays_camera, axis=-1).ravel()
    ways = (rays_camera @ pose[:3, :3].T).reshape(-1, 3) / lengths[:, None]
    hits = of.cast(
        np.tile(pose[:3, 3], (len(ways), 1)).astype(np.float32),
        ways.astype(np.float32),
        "depth",
        0.0,
    )
    all_rays = SMALL.focal_baseline / (hits.distance_m / lengths)
    assert np.isfinite(hits.distance_m).all()
    # Rays that graze an edge fall on either side of it by rounding.
    differs = np.abs(disparity.ravel() - all_rays) > 0.01
    assert differs.mean() < 2e-4
    cosine = np.abs((hits.normals * ways).sum(axis=1))
    assert (np.abs(signal.ravel() - WALL.reflectance * cosine) > 0.01).mean() < 5e-4


def test_left_is_left_and_up_is_up() -> None:
    off_axis = scene(wall_at(4.0), box((2, 0.4, 1.3), (2.1, 0.8, 1.6)))
    depth_m = shoot(off_axis, SMALL)
    v, u = np.nonzero((depth_m > 0) & (depth_m < 3))
    f = MODES["640x480"].focal_px
    assert u.mean() == pytest.approx(319.5 - f * 0.6 / 2, abs=2)
    assert v.mean() == pytest.approx(239.5 - f * 0.45 / 2, abs=2)


@pytest.mark.parametrize("z_m", [0.5, 1.0, 3.0])
def test_the_left_edge_lacks_a_band(z_m: float) -> None:
    lost = (shoot(scene(wall_at(z_m)), PURE) == 0).sum(axis=1)
    # B / (2 z tan(hfov / 2)) of the width
    width, f = MODES["640x480"].width, MODES["640x480"].focal_px
    band_px = PURE.baseline_m / (2 * z_m * (width / 2 / f)) * width
    assert np.median(lost) == pytest.approx(band_px, abs=1)


def test_the_shadow_is_left_of_a_near_edge_and_as_wide_as_the_formula_says() -> None:
    near_m, far_m = 1.0, 3.0
    depth_m = shoot(scene(wall_at(far_m), box((near_m, -0.3, 0.0), (1.2, 0.3, 2.0))), PURE)
    shadow_px = PURE.focal_baseline * (1 / near_m - 1 / far_m)
    row = depth_m[240, 40:]
    near = np.flatnonzero((row > 0.8) & (row < 1.2))
    before, after = row[: near[0]], row[near[-1] + 1 :]
    assert (before == 0).sum() == pytest.approx(shadow_px, abs=2)
    assert (before[-10:] == 0).all()
    assert (after == 0).sum() <= 1
    assert near.size == pytest.approx(MODES["640x480"].focal_px * 0.6 / near_m, abs=2)


def test_a_pole_throws_a_shadow_no_wider_than_itself() -> None:
    pole_m = 0.04
    depth_m = shoot(scene(wall_at(4.0), box((1.0, -0.02, -5), (1.0 + pole_m, 0.02, 5))), PURE)
    holes = (depth_m[100:380, 60:] == 0).sum(axis=1)
    assert np.median(holes) == pytest.approx(pole_m * 384 / 1.0, abs=3)


def test_seams_hold_holes_and_few_mixed_depths() -> None:
    model = SMALL.model_copy(update={"wave_px": 0.0})
    depth_m = shoot(scene(wall_at(2.5), box((1.2, -0.4, 0.0), (1.3, 0.4, 2.0))), model)
    right = depth_m[140:340, 400:500]  # the right side of the box is at column 447
    mixed = ((right > 1.3) & (right < 2.3)).sum(axis=1)
    holes = (right == 0).sum(axis=1)
    assert 0.1 < mixed.mean() < 3
    assert 1 < holes.mean() < 6
    assert ((mixed + holes) <= 12).all()


# ---- what gives no depth -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "lost_m", "seen_m"), [("1280x720", 0.26, 0.31), ("640x480", 0.16, 0.2)]
)
def test_nothing_is_seen_too_near(mode: str, lost_m: float, seen_m: float) -> None:
    model = DepthModel(mode=mode)
    assert not shoot(scene(wall_at(lost_m)), model).any()
    assert shoot(scene(wall_at(seen_m)), model).any()


@pytest.mark.parametrize("name", ["glass", "black", "polished"])
def test_what_is_invisible_is_a_hole(name: str) -> None:
    pane = box((1.5, -0.5, 0.6), (1.52, 0.5, 1.4), MATERIALS[name])
    depth_m = shoot(scene(wall_at(3.0), pane), SMALL)
    assert not depth_m[170:310, 220:420].any()
    assert (depth_m[20:100, 100:600] > 0).mean() > 0.95


def test_dark_things_are_lost_where_they_are_grazed() -> None:
    floor = box((-50, -50, -1), (50, 50, 0), Material("dark floor", reflectance=0.1))
    depth_m = shoot(scene(floor), SMALL, pose=camera(0.3, 0.3))
    cosine = SMALL.least_signal / 0.1
    seen = true_disparity(scene(floor), camera(0.3, 0.3), SMALL, 0.0)[1] / 0.1
    valid = depth_m[:, 60:] > 0
    assert valid[seen[:, 60:] > 1.8 * cosine].mean() > 0.99
    assert valid[seen[:, 60:] < 0.3 * cosine].mean() < 0.01


def test_the_sky_is_empty() -> None:
    assert not shoot(scene(box((-9, -1, 0), (-8, 1, 1))), SMALL).any()


def test_a_mover_is_seen_where_it_is_at_the_time() -> None:
    cart = Mover(
        "cart",
        box((-0.01, -0.2, 0.5), (0.01, 0.2, 1.5)),
        np.array([0.0, 2.0]),
        np.array([[2.0, 0.5, 0.0], [2.0, -0.5, 0.0]]),
        loop=False,
    )
    of = scene(wall_at(4.0), movers=(cart,))
    columns = []
    for time_s in (0.0, 2.0):
        depth_m = shoot(of, SMALL, time_s=time_s)
        columns.append(np.nonzero((depth_m > 0) & (depth_m < 2.5))[1].mean())
    assert columns == pytest.approx([319.5 - 384 * 0.5 / 2, 319.5 + 384 * 0.5 / 2], abs=3)


# ---- the form of it ------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_bytes() -> None:
    of, pose = furnished(), camera(0.6, 0.2)
    first, again, other = (shoot(of, SMALL, seed, pose).tobytes() for seed in (7, 7, 8))
    assert first == again
    assert first != other


@pytest.mark.parametrize("mode", list(MODES))
def test_each_mode_has_its_size_and_field_of_view(mode: str) -> None:
    model = DepthModel(mode=mode)
    depth_m = shoot(scene(wall_at(1.0)), model)
    assert depth_m.shape == (MODES[mode].height, MODES[mode].width)
    assert depth_m.dtype == np.float32
    centre = model.K @ [0, 0, 1]
    np.testing.assert_allclose(centre[:2], [(depth_m.shape[1] - 1) / 2, (depth_m.shape[0] - 1) / 2])


def test_millimetres_are_rounded_and_holes_stay() -> None:
    depth_m = np.array([[0.0, 0.28, 1.2346, 64.9999]], dtype=np.float32)
    assert to_millimetres(depth_m).tolist() == [[0, 280, 1235, 65000]]
    assert to_millimetres(depth_m).dtype == np.uint16


def test_a_pose_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="finite \\(4, 4\\)"):
        shoot(scene(wall_at(1.0)), SMALL, pose=np.eye(3))


# ---- plain twins ---------------------------------------------------------------------------------


def hidden_plain(disparity: Array) -> list[bool]:
    columns = np.arange(disparity.size) - disparity
    right = np.zeros(disparity.size)
    for column, value in zip(np.floor(columns).astype(int), disparity, strict=True):
        for k in (column, column + 1):
            if 0 <= k < right.size:
                right[k] = max(right[k], value)
    seen_at = np.floor(columns + 0.5).astype(int)
    return [bool(k >= 0 and right[k] > d + 1) for k, d in zip(seen_at, disparity, strict=True)]


def test_shadows_against_the_plain_twin() -> None:
    rng = np.random.default_rng(6)
    for _ in range(20):
        row = np.repeat(rng.uniform(0, 60, size=20), 16).astype(np.float32)
        hidden = np.empty(row.size, dtype=np.bool_)
        mark_hidden(row, np.empty_like(row), hidden)
        assert hidden.tolist() == hidden_plain(row)
        assert hidden.any()


def degrade_plain(images: tuple[Float32s, ...], scale: float, e: Effects) -> Array:
    here, near, far, smooth, signal, noise, ragged, waves = (i.astype(np.float64) for i in images)
    hidden = np.array([hidden_plain(row) for row in images[0]])
    height, width = here.shape
    column = np.broadcast_to(np.arange(width), here.shape)
    away = np.rint(e.ragged * ragged).astype(int)
    beside = np.clip(column + away, 0, width - 1)
    rows = np.arange(height)[:, None]
    below = np.clip(rows + away, 0, height - 1)
    lost = signal[below, beside] < e.least_signal * np.maximum(1 + 0.3 * ragged, 0.1)
    lost |= ragged > e.speckle
    at_edge = np.abs(here - smooth) > e.edge
    jump = np.maximum(near - far, 1e-9)
    lean = (smooth - far) / jump + e.per_px * e.ragged * ragged - 0.5
    is_near = 2 * here > near + far
    found = np.where(at_edge & (lean > e.zone), np.where(is_near, here, near), smooth)
    found = np.where(at_edge & (lean < -e.zone), np.where(is_near, far, here), found)
    lost |= at_edge & (lean < -e.zone) & hidden
    lost |= at_edge & (np.abs(lean) <= e.zone) & (hidden | (np.abs(noise) * jump > e.mixed))
    lost |= ~at_edge & hidden[rows, beside] & (np.abs(here[rows, beside] - here) < 1)
    lost |= (column < found + e.band + e.ragged * ragged) | (found > e.most)
    rise = np.clip(scale / np.maximum(found, e.least) / e.wave_from - 1, 0, 1.5)
    found = found + e.noise * noise + e.wave * rise * waves
    found = e.quantum * np.rint(found / e.quantum)
    return np.where(lost | (found < e.least), 0.0, scale / np.maximum(found, e.least))


def test_all_effects_against_the_plain_twin() -> None:
    import cv2

    disparity, signal = true_disparity(furnished(), camera(0.6, 0.2), SMALL, 0.0)
    rng = np.random.default_rng(9)
    window = np.ones((WINDOW_PX, WINDOW_PX), dtype=np.uint8)
    images = (
        disparity,
        np.asarray(cv2.dilate(disparity, window), dtype=np.float32),
        np.asarray(cv2.erode(disparity, window), dtype=np.float32),
        np.asarray(cv2.blur(disparity, window.shape), dtype=np.float32),
        np.asarray(cv2.blur(signal, window.shape), dtype=np.float32),
        *(random_field(rng, disparity.shape, 2, sigma) for sigma in (4.0, 1.25, 12.0)),
    )
    scale, effects = SMALL.focal_baseline, _effects(SMALL)
    quick, plain = degrade(*images, scale, effects), degrade_plain(images, scale, effects)
    # Rounding of float32 decides otherwise at a threshold now and then.
    assert (np.abs(quick - plain) > 1e-4 * plain).mean() < 2e-3
    assert 0.02 < (plain == 0).mean() < 0.5
