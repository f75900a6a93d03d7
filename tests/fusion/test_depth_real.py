"""Real depth images through the whole projection: bare floor stays bare, walls are straight."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from datasets.messages import DepthImage
from datasets.recording import CameraCalibration, Intrinsics
from fusion.depth_config import DepthConfig
from fusion.depth_projection import DepthProjection
from slam.lab.bench.floor import (
    HEIGHTS_M,
    K_D435,
    floor_beams,
    nodded,
    read_depth,
    read_outlines,
    standing,
)

K_KINECT = np.array([[532.6, 0.0, 319.5], [0.0, 532.6, 239.5], [0.0, 0.0, 1.0]])

BARE_FLOOR = read_outlines(Path(__file__).with_name("bare_floor.yaml"))


@pytest.mark.parametrize("error_deg", [0.0, 0.5, -0.5])
def test_bare_floor_has_no_obstacles(shared_data: Path, error_deg: float) -> None:
    """Beams whose range comes from pixels of bare floor, over all beams that look at some."""
    false, looked = 0, 0
    for name, outline in BARE_FLOOR.items():
        depth_m = read_depth(shared_data / "depth" / "d435" / f"{name}.png")
        T = nodded(standing(depth_m, K_D435, HEIGHTS_M), math.radians(error_deg))
        assert T[2, 3] == pytest.approx(0.63, abs=0.03)
        beams = floor_beams(depth_m, outline, T)
        false, looked = false + beams[0], looked + beams[1]
        assert beams[2] > 0.95
    assert looked > 2000
    assert false / looked < 0.005


def test_a_wall_seen_by_a_kinect_is_straight(shared_data: Path) -> None:
    depth_m = read_depth(shared_data / "depth" / "kinect" / "020.png")
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
        found = project(DepthImage(0, kind, read_depth(path)))
        finite = np.isfinite(found.ranges_m)
        assert (found.ranges_m[finite] <= 4.0).all()
        assert (found.sigma_m[finite] > 0.0).all()
        assert (found.free_to_m <= np.where(finite, found.ranges_m, 4.0)).all()
