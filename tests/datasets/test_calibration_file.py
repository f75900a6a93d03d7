"""The calibration YAML: what it gives, and what it says when it is wrong."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datasets.calibration_file import EXAMPLE, CalibrationFile, mounting, read_calibration_file
from datasets.errors import InputError


def read(folder: Path, text: str) -> CalibrationFile:
    path = folder / "calibration.yaml"
    path.write_text(text, encoding="utf-8")
    return read_calibration_file(path)


GOOD = """
lidars:
  /low:
    mounting: {x_m: 0.31, z_m: 0.1, roll_deg: 180, yaw_deg: 90}
    mask_deg: [[-180, -150], [150, 180]]
    clock_offset_s: -0.08
  /high:
    mask_deg: [[10, 20]]
cameras:
  /depth:
    mounting: {x_m: 0.15, z_m: 0.25, pitch_deg: 90}
    intrinsics: {width_px: 640, height_px: 480, fx_px: 384, fy_px: 385, cx_px: 321, cy_px: 239}
  /other: {}
odometry: tf
ground_truth: /true_pose
"""


def test_a_whole_file(tmp_path: Path) -> None:
    calibration = read(tmp_path, GOOD)
    assert calibration.odometry == "tf"
    low = calibration.lidar("/low", np.eye(4))
    assert low is not None
    # Upside down and turned left: its x looks along the base's y, its y along the base's x.
    np.testing.assert_allclose(low.T_base_lidar @ [1, 0, 0, 1], [0.31, 1, 0.1, 1], atol=1e-12)
    np.testing.assert_allclose(low.T_base_lidar @ [0, 1, 0, 1], [1.31, 0, 0.1, 1], atol=1e-12)
    assert low.masks_rad[1] == pytest.approx((math.radians(150), math.pi))
    assert calibration.clock_offset_ns("/low") == -80_000_000
    assert calibration.clock_offset_ns("/other") == 0


def test_a_camera_is_mounted_by_its_body_and_told_by_its_optical_frame(tmp_path: Path) -> None:
    calibration = read(tmp_path, GOOD)
    assert calibration.ground_truth == "/true_pose"
    depth, other = calibration.cameras["/depth"], calibration.cameras["/other"]
    assert depth.T_base_camera is not None
    # Pitched by 90 degrees it looks at the floor; the right of its image is the robot's right.
    np.testing.assert_allclose(depth.T_base_camera @ [0, 0, 1, 1], [0.15, 0, -0.75, 1], atol=1e-12)
    np.testing.assert_allclose(depth.T_base_camera @ [1, 0, 0, 1], [0.15, -1, 0.25, 1], atol=1e-12)
    assert depth.intrinsics is not None
    np.testing.assert_array_equal(depth.intrinsics.K, [[384, 0, 321], [0, 385, 239], [0, 0, 1]])
    assert (depth.intrinsics.width_px, depth.intrinsics.height_px) == (640, 480)
    assert other.T_base_camera is None
    assert other.intrinsics is None


def test_the_example_in_the_errors_is_right(tmp_path: Path) -> None:
    lidar = read(tmp_path, EXAMPLE).lidar("/scan", None)
    assert lidar is not None
    np.testing.assert_allclose(lidar.T_base_lidar @ [1, 0, 0, 1], [-0.8, 0, 0, 1], atol=1e-12)


def test_the_recordings_mounting_stands_where_the_file_has_none(tmp_path: Path) -> None:
    calibration = read(tmp_path, GOOD)
    recorded = mounting((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    high = calibration.lidar("/high", recorded)
    assert high is not None
    assert high.T_base_lidar is recorded
    assert len(high.masks_rad) == 1
    assert calibration.lidar("/high", None) is None
    assert calibration.lidar("/unheard", None) is None


@pytest.mark.parametrize("angles", [(0.3, -0.2, 1.1), (math.pi, 0.0, -2.0), (0.0, 1.5, 0.0)])
def test_mounting_angles_are_those_of_scipy(angles: tuple[float, float, float]) -> None:
    expected = Rotation.from_euler("xyz", angles).as_matrix()
    np.testing.assert_allclose(mounting((0, 0, 0), angles)[:3, :3], expected, atol=1e-12)


@pytest.mark.parametrize("text", ["", "# only a comment\n", "lidars: {}\n"])
def test_an_empty_file_says_nothing(tmp_path: Path, text: str) -> None:
    assert not read(tmp_path, text).lidars
    assert not read_calibration_file(None).lidars


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("lidar:\n  a: {}\n", "line 1, key lidar", "no such key"),
        (
            "odometry: /odom\nlidars:\n  /scan:\n    mounting:\n      x: 0.3\n",
            "line 5, key lidars./scan.mounting.x",
            "no such key",
        ),
        (
            "lidars:\n  /scan:\n    mounting: {x_m: left}\n",
            "line 3, key lidars./scan.mounting.x_m",
            "number",
        ),
        ("lidars:\n  /scan:\n    mounting: {x_m: .nan}\n", "line 3", "finite"),
        ("lidars:\n  s:\n    mask_deg:\n      - [0, 10]\n      - [5, 5]\n", "line 5", "mask"),
        ("lidars:\n  s:\n    mask_deg: [[0, 10, 20]]\n", "line 3", "items"),
        ("lidars:\n  s:\n    mask_deg: [[-180, 180]]\n", "line 3", "mask runs"),
        ("lidars: [1, 2]\n", "line 1, key lidars", "key: value"),
        ("cameras:\n  c: {mask_deg: []}\n", "line 2, key cameras.c.mask_deg", "no such key"),
        (
            "cameras:\n  c:\n    intrinsics: {f: 1}\n",
            "line 3, key cameras.c.intrinsics.f",
            "no such key",
        ),
        ("- 1\n", "line 1", "key: value"),
        ("lidars:\n  /scan:\n", "line 2, key lidars./scan", "key: value"),
        ("lidars:\n  /scan: {clock_offset_s: 1e12}\n", "line 2", "less than"),
        ("lidars:\n  a: {}\n  b: {}\n  a: {}\n", "line 4", "a second time"),
        ("lidars:\n  a: {mounting: {x_m: 1, x_m: 2}}\n", "line 2", "a second time"),
        (
            "cameras:\n  c:\n    intrinsics: {fx_px: 1}\n",
            "line 3, key cameras.c.intrinsics",
            "missing",
        ),
        ("lidars: &all\n  /scan: *all\n", "line 1", "stands in itself"),
        ("odometry: 2001-99\n  -99: 1\n", "line 2", "YAML"),
        ("lidars: {\n", "line 2", "YAML"),
        ("a: b: c\n", "line 1", "YAML"),
    ],
)
def test_errors_name_line_and_key(tmp_path: Path, text: str, where: str, what: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert where in caught.value.where
    assert str(tmp_path) in caught.value.where
    assert what in caught.value.what
    assert caught.value.remedy


def test_files_that_are_no_text_or_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="can't be read"):
        read_calibration_file(tmp_path / "missing.yaml")
    with pytest.raises(InputError, match="can't be read"):
        read_calibration_file(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    with pytest.raises(InputError, match="no text file"):
        read_calibration_file(tmp_path / "binary.yaml")


def test_a_lidar_that_is_not_there_is_named(tmp_path: Path) -> None:
    calibration = read(tmp_path, GOOD)
    calibration.require_known(["/low", "/high", "/third"])
    with pytest.raises(InputError, match=r"/high.*The recording has: /low"):
        calibration.require_known(["/low"])


def test_a_camera_that_is_not_there_is_named_and_its_clock_is_read(tmp_path: Path) -> None:
    calibration = read(tmp_path, "cameras:\n  /depth: {clock_offset_s: 0.035}\n  /other: {}\n")
    assert calibration.camera_clock_offsets_ns == {"/depth": 35_000_000, "/other": 0}
    calibration.require_known_cameras(["/depth", "/other"])
    with pytest.raises(InputError, match=r"key cameras./other: there is no such camera.*: /depth"):
        calibration.require_known_cameras(["/depth"])
