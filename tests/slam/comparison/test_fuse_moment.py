"""``slam fuse``: the data of the figure on a place that is known, the file, and mistakes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets.bags import read_trajectory
from datasets.errors import InputError
from datasets.messages import DepthImage
from datasets.options import ReadOptions
from datasets.recording import CameraCalibration, Intrinsics
from datasets.se2 import inverse, xyyaw
from datasets.simulation.simulated_drive import START_NS
from fusion.depth_labels import BEHIND, FREE, HOLE, NEAREST, TOO_HIGH
from fusion.paper.mode import PaperConfig
from fusion.scan import CAMERA
from slam.comparison.fuse_moment import FuseMoment, fuse_moment, paper_labels, range_rows
from slam.comparison.fuse_picture import fuse_picture, gate_words
from slam.config import Config
from tests.slam.conftest import Command
from tests.slam.crate_drive import FACE_M, write_crate_drive

AT_S = 1.6


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_crate_drive(tmp_path_factory.mktemp("crate"))


@pytest.fixture(scope="module")
def moment(bag: Path) -> FuseMoment:
    return fuse_moment([bag], ReadOptions(), Config(), AT_S)


def column_and_row(x_m: float, y_m: float, z_m: float) -> tuple[int, int]:
    """Of a point in the base frame, in the image of a level camera at (0.15, 0, 0.25) m."""
    ahead_m = x_m - 0.15
    return round(319.5 - 384.0 * y_m / ahead_m), round(239.5 - 384.0 * (z_m - 0.25) / ahead_m)


def face_ahead_m(bag: Path, moment: FuseMoment) -> float:
    """How far the crate's face is from the base when the image is taken, by the truth."""
    x_m, _, yaw = read_trajectory(bag, None).at(np.array([moment.image.stamp_ns]))[0]
    assert abs(yaw) < 0.01
    return FACE_M - float(x_m)


def test_it_is_the_image_nearest_to_the_time_and_the_scan_nearest_to_it(
    moment: FuseMoment,
) -> None:
    assert abs(moment.image_s - AT_S) <= 0.101  # five images a second
    assert moment.sweep is not None
    assert abs(moment.offset_s) <= 0.5 / 7.0 + 0.005  # seven turns a second
    assert moment.offset_s == pytest.approx((moment.image.stamp_ns - moment.sweep.moment_ns) * 1e-9)
    assert "ms" in moment.title()[1]


def test_the_motion_in_between_is_the_true_one(bag: Path, moment: FuseMoment) -> None:
    assert moment.sweep is not None
    stamps_ns = np.array([moment.sweep.moment_ns, moment.image.stamp_ns])
    rows = read_trajectory(bag, None).at(np.sort(stamps_ns))
    T_scan, T_view = (
        np.array([[math.cos(a), -math.sin(a), x], [math.sin(a), math.cos(a), y], [0, 0, 1.0]])
        for x, y, a in (rows if stamps_ns[0] < stamps_ns[1] else rows[::-1])
    )
    off = xyyaw(inverse(inverse(T_scan) @ T_view) @ moment.T_scan_view)
    assert moment.odometry
    np.testing.assert_allclose(off, 0.0, atol=0.004)


def test_each_pixel_has_the_role_of_what_stands_there(bag: Path, moment: FuseMoment) -> None:
    face_m = face_ahead_m(bag, moment)
    roles = {}
    for name, point in {
        "face of the crate": (face_m, 0.2, 0.15),
        "wall behind it": (face_m + 2.0, 0.2, 0.6),
        "floor": (1.4, 0.0, 0.0),
    }.items():
        column, row = column_and_row(*point)
        patch = moment.labels[row - 4 : row + 5, column - 4 : column + 5]
        roles[name] = int(np.bincount(patch.ravel()).argmax())
    assert roles["face of the crate"] == NEAREST
    assert roles["floor"] == FREE
    # The wall stands beyond what the camera is trusted to, or behind the crate.
    assert roles["wall behind it"] in (BEHIND, TOO_HIGH)


def test_the_ranges_are_those_of_crate_and_wall(bag: Path, moment: FuseMoment) -> None:
    rows, face_m = range_rows(moment), face_ahead_m(bag, moment)
    bearing = math.atan2(0.2, face_m)
    lidar = rows.lidar[np.abs(rows.lidar[:, 0] - bearing) < 0.03]
    np.testing.assert_allclose(lidar[:, 1] * np.cos(lidar[:, 0]), face_m + 2.0, atol=0.1)
    camera = rows.camera[np.abs(rows.camera[:, 0] - bearing) < 0.03]
    np.testing.assert_allclose(camera[:, 1] * np.cos(camera[:, 0]), face_m, atol=0.05)
    fused = np.abs(rows.fused[:, 0] - bearing) < 0.03
    put_in = rows.fused[fused & (rows.source == CAMERA)]
    assert len(put_in) > 3
    np.testing.assert_allclose(put_in[:, 1] * np.cos(put_in[:, 0]), face_m, atol=0.05)


def test_the_tolerance_lies_around_the_lidars_ranges(moment: FuseMoment) -> None:
    rows = range_rows(moment)
    lidar = rows.lidar[np.argsort(rows.lidar[:, 0])]
    middle = 0.5 * (rows.limits[:, 1] + rows.limits[:, 2])
    nearest = np.abs(lidar[:, 0] - rows.limits[:, :1]).argmin(axis=1)
    np.testing.assert_allclose(middle, lidar[nearest, 1], atol=1e-9)
    half = 0.5 * (rows.limits[:, 2] - rows.limits[:, 1])
    # At least 1.96 times the placing error alone, 2 cm, and never half a metre.
    assert (half > 0.039).all()
    assert (half < 0.5).all()


def test_a_stamp_is_as_good_as_seconds(bag: Path, moment: FuseMoment) -> None:
    stamped = fuse_moment([bag], ReadOptions(), Config(), START_NS * 1e-9 + AT_S)
    assert stamped.image.stamp_ns == moment.image.stamp_ns


def test_paper_mode_takes_the_image_as_it_is(bag: Path, moment: FuseMoment) -> None:
    paper = fuse_moment([bag], ReadOptions(), Config(fusion="paper"), AT_S)
    np.testing.assert_array_equal(paper.T_fused_view, np.eye(3))
    np.testing.assert_array_equal(paper.T_scan_view, moment.T_scan_view)
    used = np.isin(paper.labels, (NEAREST, BEHIND)).any(axis=1)
    assert np.flatnonzero(used).tolist() == list(range(235, 245))
    assert gate_words(paper) == "10 rows around the middle count"
    assert gate_words(moment) == "height gate 0.03 to 1 m, to 4 m"


def test_in_each_column_of_the_papers_rows_the_nearest_pixel_counts() -> None:
    depth_m = np.full((6, 4), 2.0, np.float32)
    depth_m[3, 0] = 1.5
    depth_m[0, 1] = 0.5  # of another row
    depth_m[2:4, 3] = np.nan
    K = np.array([[4.0, 0, 1.5], [0, 4.0, 2.5], [0, 0, 1]])
    camera = CameraCalibration(np.eye(4), Intrinsics(K, 4, 6))
    labels = paper_labels(DepthImage(0, "c", depth_m), camera, PaperConfig(scan_height_px=2))
    expected = np.full((6, 4), TOO_HIGH)
    expected[2:4] = [[BEHIND, NEAREST, NEAREST, HOLE], [NEAREST, BEHIND, BEHIND, HOLE]]
    np.testing.assert_array_equal(labels, expected)


def test_without_a_lidar_the_pseudo_laser_stands_alone(bag: Path) -> None:
    alone = fuse_moment([bag], ReadOptions(use_lidars=False), Config(), AT_S)
    assert alone.sweep is None
    assert alone.fused is None
    rows = range_rows(alone)
    assert not len(rows.lidar)
    np.testing.assert_array_equal(
        rows.camera[:, 0], alone.pseudo.bearings_rad[np.isfinite(alone.pseudo.ranges_m)]
    )
    assert "alone" in alone.title()[-1]
    assert fuse_picture(alone).startswith(b"\x89PNG")


def test_without_odometry_the_base_is_taken_to_stand(bag: Path) -> None:
    standing = fuse_moment([bag], ReadOptions(), Config(odometry=False), AT_S)
    np.testing.assert_array_equal(standing.T_scan_view, np.eye(3))
    assert "no odometry" in standing.title()[1]


def test_the_same_moment_gives_the_same_picture(moment: FuseMoment) -> None:
    picture = fuse_picture(moment)
    assert picture == fuse_picture(replace(moment))
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    assert pixels.shape == (1120, 1600, 3)
    assert (pixels != 255).any(axis=2).mean() > 0.1


@pytest.mark.parametrize("at_s", [-1.0, 60.0])
def test_a_time_outside_is_told_with_the_length(bag: Path, at_s: float) -> None:
    with pytest.raises(InputError, match=r"outside the recording, which lasts [34]\.\d\d s"):
        fuse_moment([bag], ReadOptions(), Config(), at_s)


def test_a_recording_without_a_camera_is_refused(tmp_path: Path) -> None:
    bag = write_crate_drive(tmp_path, "two-lidars")
    with pytest.raises(InputError, match="no depth camera"):
        fuse_moment([bag], ReadOptions(), Config(), 1.0)


def test_the_command_writes_one_file_and_replaces_none(
    slam: Command, bag: Path, tmp_path: Path
) -> None:
    out = tmp_path / "fused.png"
    done = slam("fuse", bag, "--at", AT_S, "-o", out)
    assert (done.code, done.err) == (0, "")
    assert done.out.splitlines()[-1] == str(out)
    assert [path.name for path in tmp_path.iterdir()] == ["fused.png"]
    written = out.read_bytes()
    again = slam("fuse", bag, "--at", AT_S, "-o", out)
    assert again.code == 2
    assert "exists already" in again.err
    assert out.read_bytes() == written
    forced = slam("fuse", bag, "--at", AT_S, "-o", out, "--mode", "paper", "--force")
    assert forced.code == 0
    assert out.read_bytes() != written


def test_a_mistake_leaves_no_file(slam: Command, bag: Path, tmp_path: Path) -> None:
    done = slam("fuse", bag, "--at", 60, "-o", tmp_path / "fused.png")
    assert done.code == 2
    assert done.err.count("\n") == 1
    assert not list(tmp_path.iterdir())
