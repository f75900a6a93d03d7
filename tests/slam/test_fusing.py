"""Which sensors take part in a scan, and what becomes of them when they turn out to stand amiss."""

from __future__ import annotations

from collections import Counter

import numpy as np

from datasets.messages import DepthImage, LaserScan
from datasets.recording import Calibration, CameraCalibration, LidarCalibration
from datasets.se2 import se2, transform
from frontend.motion import MotionModel
from fusion.pseudo_scan import PseudoScan
from slam.config import Config
from slam.fusing import Fusing


def wall_ahead(image: DepthImage) -> PseudoScan:
    """What a camera at (0.2, 0) sees of a wall some 2 m ahead."""
    bearings = np.linspace(-0.3, 0.3, 13)
    surfaces = np.column_stack([np.full(13, 2.2), 2.0 * np.tan(bearings)])
    return PseudoScan(
        image.stamp_ns,
        image.camera,
        np.array([0.2, 0.0]),
        bearings,
        2.0 / np.cos(bearings),
        np.full(13, 0.01),
        0.3,
        np.full(13, 2.0),
        surfaces.astype(np.float32),
        0.05,
    )


def test_cameras_that_stand_elsewhere_take_their_views_with_them() -> None:
    """Two cameras without a lidar: the final passes may move one of them."""
    names = ("/front", "/left")
    calibration = Calibration({}, dict.fromkeys(names, CameraCalibration(None, None)))
    config = Config(sensors="camera")
    fusing = Fusing(config, calibration, MotionModel(config.motion), Counter())
    fusing.project = lambda calibration, config: wall_ahead
    for stamp_ns, name in enumerate(names):
        fused = fusing.fused(DepthImage(stamp_ns, name, np.ones((2, 2), np.float32)))
        assert fused is not None
        assert fused.points_base.shape == (13, 2)
    front, left = fusing.views
    T_true_said = se2(0.05, -0.02, 0.03)

    fusing.remount("/left", T_true_said, 0.04)

    assert fusing.views[0] is front
    moved = fusing.views[1]
    assert moved.stamp_ns == left.stamp_ns + 40_000_000
    expected = transform(T_true_said, left.points_base.astype(np.float64))
    np.testing.assert_allclose(moved.points_base, expected, atol=1e-6)
    origin = transform(T_true_said, np.array([[0.2, 0.0]]))[0]
    np.testing.assert_allclose(moved.origin_base, origin)
    np.testing.assert_allclose(fusing.origins_base()["/left"], origin)
    np.testing.assert_allclose(fusing.origins_base()["/front"], [0.2, 0.0])


def test_views_at_90_hz_wait_as_long_as_a_scan_waits_for_its_odometry() -> None:
    calibration = Calibration(
        {"/scan": LidarCalibration(np.eye(4))}, {"/front": CameraCalibration(None, None)}
    )
    config = Config()
    fusing = Fusing(config, calibration, MotionModel(config.motion), Counter())
    fusing.project = lambda calibration, config: wall_ahead
    for k in range(120):
        image = DepthImage(k * 11_000_000, "/front", np.ones((2, 2), np.float32))
        fusing.add_view(image)
    bearings = np.linspace(-3.0, 3.0, 600)
    scan = LaserScan(0, "/scan", np.full(600, 5.0), bearings, np.empty(0), 0.1, 10.0)

    fused = fusing.fused(scan)

    assert fused is not None
    assert fusing.without_view["/front"] == 0
    assert fusing.compared > 0


def test_scans_before_the_first_view_count_as_without_one() -> None:
    calibration = Calibration(
        {"/scan": LidarCalibration(np.eye(4))}, {"/front": CameraCalibration(None, None)}
    )
    config = Config()
    fusing = Fusing(config, calibration, MotionModel(config.motion), Counter())
    fusing.project = lambda calibration, config: wall_ahead
    for k in range(3):
        scan = LaserScan(
            k * 100_000_000, "/scan", np.full(6, 5.0), np.arange(6.0), np.empty(0), 0.1, 10.0
        )
        fusing.fused(scan)
    fusing.add_view(DepthImage(300_000_000, "/front", np.ones((2, 2), np.float32)))
    assert fusing.without_view["/front"] == 3
    assert fusing.cameras_without_view() == []
