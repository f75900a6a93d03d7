"""Real depth images through the whole projection: bare floor stays bare, walls are straight."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from datasets.messages import Array, DepthImage, Float32s
from datasets.recording import CameraCalibration, Intrinsics
from fusion.depth_config import DepthConfig
from fusion.depth_labels import FREE, NEAREST
from fusion.depth_projection import DepthProjection

K_D435 = np.array([[383.8, 0.0, 321.7], [0.0, 383.8, 236.8], [0.0, 0.0, 1.0]])
K_KINECT = np.array([[532.6, 0.0, 319.5], [0.0, 532.6, 239.5], [0.0, 0.0, 1.0]])

BARE_FLOOR = {
    "000": [(110, 479), (120, 440), (220, 310), (300, 295), (410, 290), (430, 190), (555, 175),
            (545, 270), (600, 330), (639, 330), (639, 479)],
    "024": [(110, 479), (140, 410), (200, 345), (270, 385), (365, 390), (375, 250), (340, 190),
            (545, 160), (540, 390), (639, 430), (639, 479)],
    "040": [(90, 479), (100, 420), (145, 360), (130, 260), (390, 215), (400, 320), (450, 400),
            (450, 479)],
    "056": [(80, 479), (90, 400), (180, 360), (250, 310), (225, 220), (560, 190), (560, 330),
            (530, 370), (560, 420), (600, 479)],
    "072": [(60, 479), (70, 430), (140, 400), (190, 340), (160, 215), (590, 160), (570, 300),
            (580, 330), (570, 420), (550, 479)],
    "088": [(120, 479), (150, 440), (80, 270), (500, 190), (620, 180), (620, 479)],
    "096": [(40, 479), (35, 275), (300, 230), (580, 210), (580, 479)],
    "104": [(45, 479), (35, 280), (300, 235), (500, 210), (500, 479)],
    "120": [(30, 479), (25, 300), (300, 245), (555, 200), (555, 400), (550, 479)],
    "144": [(220, 479), (260, 430), (360, 395), (425, 350), (410, 210), (630, 180), (630, 479)],
    "168": [(100, 479), (100, 430), (165, 390), (115, 230), (480, 190), (490, 479)],
    "184": [(200, 479), (195, 430), (200, 330), (165, 240), (420, 200), (440, 300), (470, 420),
            (470, 479)],
}  # fmt: skip
"""Outlined by hand, (column, row), in images of data/depth/d435."""


def read(path: Path) -> Float32s:
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.where(image > 0, image / 1000.0, np.nan).astype(np.float32)


def standing(depth_m: Float32s, K: Array, heights_m: tuple[float, float]) -> Array:
    """T_base_camera by the floor: the largest plane below within 37 deg of level, by RANSAC."""
    rng = np.random.default_rng(0)
    v, u = np.nonzero((depth_m < 3.0) & (np.arange(depth_m.shape[0]) > 150)[:, None])
    chosen = rng.choice(v.size, 20000)
    v, u = v[chosen], u[chosen]
    z = depth_m[v, u].astype(np.float64)
    points = np.column_stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z])
    allowed_m = 0.01 + 0.004 * z**2
    most, up, height_m = 0, np.zeros(3), 0.0
    for _ in range(400):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-6 or abs(normal[1]) < 0.8 * length:
            continue
        normal *= -np.sign(normal[1]) / length
        if not heights_m[0] < -normal @ a < heights_m[1]:
            continue
        inside = int((np.abs(points @ normal - normal @ a) < allowed_m).sum())
        if inside > most:
            most, up, height_m = inside, normal, float(-normal @ a)
    for _ in range(5):
        floor = np.abs(points @ up + height_m) < allowed_m
        weights = 1.0 / allowed_m[floor]
        scaled = np.linalg.lstsq(points[floor] * weights[:, None], -weights, rcond=None)[0]
        height_m = float(1.0 / np.linalg.norm(scaled))
        up = scaled * height_m
    ahead = np.array([0.0, 0.0, 1.0]) - up * up[2]
    ahead /= np.linalg.norm(ahead)
    T = np.eye(4)
    T[:3, :3] = np.vstack([ahead, np.cross(up, ahead), up])
    T[2, 3] = height_m
    return T


def nodded(T_base_camera: Array, pitch_rad: float) -> Array:
    c, s = math.cos(pitch_rad), math.sin(pitch_rad)
    R = np.eye(4)
    R[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return R @ T_base_camera


@pytest.mark.parametrize("error_deg", [0.0, 0.5, -0.5])
def test_bare_floor_has_no_obstacles(shared_data: Path, error_deg: float) -> None:
    """Beams whose range comes from pixels of bare floor, over all beams that look at some."""
    import cv2

    false, looked = 0, 0
    for name, outline in BARE_FLOOR.items():
        depth_m = read(shared_data / "depth" / "d435" / f"{name}.png")
        T = nodded(standing(depth_m, K_D435, (0.4, 0.9)), math.radians(error_deg))
        assert T[2, 3] == pytest.approx(0.63, abs=0.03)
        project = DepthProjection(CameraCalibration(T, Intrinsics(K_D435, 640, 480)), DepthConfig())
        area = np.zeros(depth_m.shape, dtype=np.uint8)
        cv2.fillPoly(area, [np.array(outline, dtype=np.int32)], 1)
        image = DepthImage(0, "d435", depth_m)
        labels, bins = project.used_pixels(image), project.bins_of_pixels()
        inside = (area == 1) & (bins >= 0)
        looked += np.unique(bins[inside]).size
        false += np.unique(bins[inside & (labels == NEAREST)]).size
        assert (labels[inside] == FREE).mean() > 0.95
    assert looked > 2000
    assert false / looked < 0.005


def test_a_wall_seen_by_a_kinect_is_straight(shared_data: Path) -> None:
    depth_m = read(shared_data / "depth" / "kinect" / "020.png")
    T = standing(depth_m, K_KINECT, (1.0, 2.0))
    config = DepthConfig(max_range_m=6.0, baseline_m=0.075)
    project = DepthProjection(CameraCalibration(T, Intrinsics(K_KINECT, 640, 480)), config)
    found = project(DepthImage(0, "kinect", depth_m))
    long = found.points_base[found.points_base[:, 1] > -0.4]
    assert len(long) > 120
    centred = long - np.median(long, axis=0)
    off_m = centred @ np.linalg.svd(centred)[2][1]
    assert np.median(np.abs(off_m)) < 0.02


@pytest.mark.parametrize("kind", ["d435", "kinect"])
def test_every_real_image_goes_through(shared_data: Path, kind: str) -> None:
    K, height_m = (K_D435, 0.63) if kind == "d435" else (K_KINECT, 1.5)
    T = np.eye(4)
    c, s = math.cos(0.33), math.sin(0.33)
    T[:3, :3] = [[0, -s, c], [-1, 0, 0], [0, -c, -s]]
    T[2, 3] = height_m
    project = DepthProjection(CameraCalibration(T, Intrinsics(K, 640, 480)), DepthConfig())
    for path in sorted((shared_data / "depth" / kind).glob("*.png"))[::4]:
        found = project(DepthImage(0, kind, read(path)))
        finite = np.isfinite(found.ranges_m)
        assert (found.ranges_m[finite] <= 4.0).all()
        assert (found.sigma_m[finite] > 0.0).all()
        assert (found.free_to_m <= np.where(finite, found.ranges_m, 4.0)).all()
