"""Mounting and intrinsics of depth cameras: from tf, CameraInfo and the calibration file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets.bags import BagRecording
from datasets.errors import InputError
from datasets.messages import Array, DepthImage, LaserScan
from datasets.options import ReadOptions
from datasets.recording import CameraCalibration
from datasets.tf_tree import se3
from tests.datasets.bag_factory import (
    T0_NS,
    Entry,
    S,
    Transform,
    camera_info_entry,
    image_entry,
    odometry_entry,
    scan_entry,
    tf_entry,
    write_bag,
)

DEPTH = "/camera/depth/image_rect_raw"
LEVEL = (0.0, 0.0, 0.0, 1.0)
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
LASER: Transform = ("base_link", "laser", (0.2, 0.0, 0.9), LEVEL)
PIXELS = np.full((6, 8), 1500, dtype=np.uint16)
INFO = camera_info_entry(T0_NS)


def pitched(down_rad: float) -> tuple[float, float, float, float]:
    return 0.0, math.sin(down_rad / 2), 0.0, math.cos(down_rad / 2)


def bag(folder: Path, *entries: Entry, transforms: Sequence[Transform] = (), **image: str) -> Path:
    """A scan, odometry and three images, with these transforms in tf_static."""
    all_of_it = [*entries, tf_entry(T0_NS, LASER, *transforms, topic="/tf_static")]
    all_of_it += [scan_entry(T0_NS), odometry_entry(T0_NS, 0.0)]
    all_of_it += [image_entry(T0_NS + k * S // 10, PIXELS, topic=DEPTH, **image) for k in range(3)]  # type: ignore[arg-type]
    return write_bag(folder, "ros1", sorted(all_of_it, key=lambda entry: entry.bag_ns))


def recording(path: Path, **options: object) -> BagRecording:
    return BagRecording([path], ReadOptions(**options))  # type: ignore[arg-type]


def camera(found: BagRecording, topic: str = DEPTH) -> CameraCalibration:
    known = found.calibration.cameras[topic]
    assert known.T_base_camera is not None
    assert known.intrinsics is not None
    return known


def T_of(found: BagRecording) -> Array:
    T_base_camera = camera(found).T_base_camera
    assert T_base_camera is not None
    return T_base_camera


def K_of(found: BagRecording) -> Array:
    pinhole = camera(found).intrinsics
    assert pinhole is not None
    return pinhole.K


HEAD: tuple[Transform, ...] = (
    ("base_link", "camera_link", (0.3, 0.1, 0.25), pitched(0.3)),
    ("camera_link", "camera_depth_frame", (0.0, 0.02, 0.0), LEVEL),
    ("camera_depth_frame", "camera_depth_optical_frame", (0, 0, 0), OPTICAL),
    ("camera_link", "camera_color_optical_frame", (0, 0.5, 0), OPTICAL),
)
T_HEAD = se3((0.3, 0.1, 0.25), pitched(0.3)) @ se3((0, 0.02, 0), LEVEL) @ se3((0, 0, 0), OPTICAL)


def test_the_mounting_through_several_links(tmp_path: Path) -> None:
    found = recording(bag(tmp_path, INFO, transforms=HEAD))
    assert T_of(found) == pytest.approx(T_HEAD, abs=1e-12)
    # Pitched down: the optical axis sinks.
    assert T_of(found)[2, 2] == pytest.approx(-math.sin(0.3))
    assert not found.notes


def test_links_that_come_only_in_moving_tf_and_late(tmp_path: Path) -> None:
    late = [tf_entry(T0_NS + 20 * S, *HEAD), scan_entry(T0_NS + 30 * S)]
    found = recording(bag(tmp_path, INFO, *late))
    assert T_of(found) == pytest.approx(T_HEAD, abs=1e-12)


def test_an_optical_frame_under_the_named_body_frame_is_used(tmp_path: Path) -> None:
    found = recording(bag(tmp_path, INFO, transforms=HEAD, frame="camera_link"))
    assert T_of(found) == pytest.approx(T_HEAD, abs=1e-12)
    (note,) = found.notes
    assert "for its frame camera_link stands camera_depth_optical_frame" in note


@pytest.mark.parametrize("frame", ["camera_link", "camera_depth_frame", "eye"])
def test_a_body_frame_without_an_optical_one_looks_along_x(tmp_path: Path, frame: str) -> None:
    """Named as such, or standing so that as an optical frame it would look at the ceiling."""
    mounting: Transform = ("base_link", frame, (0.3, 0.0, 0.4), pitched(0.3))
    found = recording(bag(tmp_path, INFO, transforms=[mounting], frame=frame))
    ahead = T_of(found) @ [0, 0, 1, 1]
    assert ahead == pytest.approx([0.3 + math.cos(0.3), 0, 0.4 - math.sin(0.3), 1])
    assert T_of(found) @ [1, 0, 0, 1] == pytest.approx([0.3, -1, 0.4, 1])
    (note,) = found.notes
    assert f"its frame {frame} is taken as that of the body" in note


def test_a_frame_without_a_telling_name_that_stands_as_an_optical_one(tmp_path: Path) -> None:
    mounting: Transform = ("base_link", "eye", (0.3, 0.0, 0.4), OPTICAL)
    found = recording(bag(tmp_path, INFO, transforms=[mounting], frame="eye"))
    assert T_of(found) @ [0, 0, 1, 1] == pytest.approx([1.3, 0, 0.4, 1])
    assert not found.notes


OWN = (5.0, 0, 4.0, 0, 5.5, 3.0, 0, 0, 1)
OTHER = (50.0, 0, 4.0, 0, 55.0, 3.0, 0, 0, 1)


def info(topic: str, K: Sequence[float] = OTHER, **rest: object) -> Entry:
    return camera_info_entry(T0_NS, topic=topic, K=K, **rest)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "infos",
    [
        [info("/camera/depth/camera_info", OWN), info("/camera_info"), info("/a/camera_info")],
        [info("/camera/depth/camera_info", OWN, frame="other"), info("/camera/camera_info")],
        [info("/camera_info", OWN), info("/a/camera_info", frame="b"), info("/b", size=(9, 6))],
        [info("/camera/depth_info", OWN), info("/camera_info"), info("/another/depth")],
        [info("/camera/depth/camera_info", size=(80, 60)), info("/camera_info", OWN)],
        [info("/camera/depth/camera_info", (0.0,) * 9), info("/camera_info", OWN)],
    ],
)
def test_the_camera_info_that_belongs_to_the_images(tmp_path: Path, infos: list[Entry]) -> None:
    found = recording(bag(tmp_path, *infos, transforms=HEAD))
    np.testing.assert_array_equal(K_of(found), np.reshape(OWN, (3, 3)))


def test_rectified_images_have_the_pinhole_p(tmp_path: Path) -> None:
    P = (6.0, 0, 4.1, 0.3, 0, 6.5, 3.1, 0, 0, 0, 1, 0)
    found = recording(bag(tmp_path, camera_info_entry(T0_NS, P=P, D=(0.3, 0, 0, 0, 0)),
                          transforms=HEAD))  # fmt: skip
    np.testing.assert_array_equal(K_of(found), [[6, 0, 4.1], [0, 6.5, 3.1], [0, 0, 1]])
    assert not found.notes


@pytest.mark.parametrize(("k1", "told"), [(0.3, True), (1e-4, False)])
def test_distortion_is_told_of_if_it_matters(tmp_path: Path, k1: float, told: bool) -> None:
    K = (500.0, 0, 320.0, 0, 500.0, 240.0, 0, 0, 1)
    D = (k1, 0.0, 0.0, 0.0, 0.0)
    lens = camera_info_entry(T0_NS, topic="/d/camera_info", size=(640, 480), K=K, D=D,
                             P=(1.0, 0, 9, 0, 0, 1, 9, 0, 0, 0, 1, 0))  # fmt: skip
    wide = image_entry(T0_NS + 7, np.full((480, 640), 1000, np.uint16), topic="/d/image_raw")
    found = recording(bag(tmp_path, INFO, lens, wide, transforms=HEAD))
    pinhole = camera(found, "/d/image_raw").intrinsics
    assert pinhole is not None
    np.testing.assert_array_equal(pinhole.K, np.reshape(K, (3, 3)))
    assert [note for note in found.notes if "its lens" in note] == list(found.notes)
    assert bool(found.notes) == told
    if told:
        rays = np.array([[[-0.64, -0.48, 1.0]]])
        moved, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.reshape(K, (3, 3)),
                                     np.array(D))  # fmt: skip
        assert f"by {np.hypot(*moved.ravel()):.1f} px" in next(iter(found.notes))


def test_binned_and_cut_images(tmp_path: Path) -> None:
    """A region of 16 x 12 from (4, 2) of 40 x 30 pixels, two by two in one."""
    K = (100.0, 0, 20.0, 0, 110.0, 15.0, 0, 0, 1)
    cut = camera_info_entry(T0_NS, size=(40, 30), K=K, binning=2, roi=(4, 2, 16, 12))
    found = recording(bag(tmp_path, cut, transforms=HEAD))
    np.testing.assert_array_equal(K_of(found), [[50, 0, 8], [0, 55, 6.5], [0, 0, 1]])
    assert sum(isinstance(m, DepthImage) for m in found) == 3


@pytest.mark.parametrize(
    ("entries", "transforms", "missing"),
    [
        ([INFO], (), "tf does not say how the camera's frame 'camera_depth_optical_frame' stands"),
        ([], HEAD, "no CameraInfo with intrinsics belongs to its images"),
        ([info("/camera/depth/camera_info", (0.0,) * 9)], HEAD, "no CameraInfo with intrinsics"),
    ],
)
def test_a_camera_that_is_half_known_is_left_out_with_the_remedy(
    tmp_path: Path, entries: list[Entry], transforms: Sequence[Transform], missing: str
) -> None:
    path = bag(tmp_path, *entries, transforms=transforms)
    found = recording(path)
    assert not found.calibration.cameras
    assert all(isinstance(m, LaserScan) or not isinstance(m, DepthImage) for m in found)
    ((note, count),) = found.notes.items()
    assert note.startswith(f"{DEPTH} left out: {missing}")
    assert "--calibration FILE" in note
    assert count == 3
    for options in ({"cameras": (DEPTH,)}, {"use_lidars": False}):
        with pytest.raises(InputError) as caught:
            recording(path, **options)
        assert missing in caught.value.what
        assert f"cameras: {{{DEPTH}: {{" in caught.value.remedy
    file = tmp_path / "robot.yaml"
    file.write_text(
        f"cameras:\n  {DEPTH}:\n    mounting: {{x_m: 0.5, z_m: 0.3}}\n    intrinsics:\n"
        "      {width_px: 8, height_px: 6, fx_px: 7, fy_px: 7, cx_px: 4, cy_px: 3}\n"
    )
    mended = recording(path, calibration=file)
    assert sum(isinstance(m, DepthImage) for m in mended) == 3
    assert T_of(mended) @ [0, 0, 1, 1] == pytest.approx([1.5, 0, 0.3, 1])
    assert not mended.notes


def test_a_camera_without_a_mounting_is_read_by_who_finds_it_out(tmp_path: Path) -> None:
    found = recording(bag(tmp_path, INFO), unmounted_cameras=True)
    known = found.calibration.cameras[DEPTH]
    assert known.T_base_camera is None
    assert known.intrinsics is not None
    assert sum(isinstance(m, DepthImage) for m in found) == 3
    (tmp_path / "blind").mkdir()
    blind = recording(bag(tmp_path / "blind", transforms=HEAD), unmounted_cameras=True)
    assert not blind.calibration.cameras  # without a pinhole nothing can be found out


def test_the_file_goes_before_the_recording_key_by_key(tmp_path: Path) -> None:
    path = bag(tmp_path, INFO, transforms=HEAD)
    file = tmp_path / "robot.yaml"
    file.write_text(f"cameras: {{{DEPTH}: {{mounting: {{x_m: 0.5, z_m: 0.3}}}}}}\n")
    found = recording(path, calibration=file)
    assert T_of(found)[:3, 3] == pytest.approx([0.5, 0, 0.3])
    assert K_of(found)[0, 0] == 5.0
    file.write_text("cameras: {/camera/deep: {mounting: {x_m: 0.5}}}\n")
    with pytest.raises(InputError, match=rf"key cameras./camera/deep: .* has: {DEPTH}"):
        recording(path, calibration=file)
    assert not recording(path, calibration=file, use_cameras=False).calibration.cameras


def test_a_camera_whose_size_is_not_that_of_its_intrinsics(tmp_path: Path) -> None:
    found = recording(bag(tmp_path, info("/camera/depth/camera_info", size=(80, 60)),
                          transforms=HEAD))  # fmt: skip
    assert not any(isinstance(m, DepthImage) for m in found)
    (note,) = found.notes
    assert "it has 8 x 6 pixels, its intrinsics are for 80 x 60" in note
    assert found.notes[note] == 3


@pytest.mark.parametrize(
    ("base", "z_m", "told"),
    [
        ("base_footprint", -0.05, True),
        ("base_footprint", 0.05, False),
        ("base_link", -0.05, False),
        ("base_link", -0.35, True),
    ],
)
def test_a_camera_underground_is_told_of(tmp_path: Path, base: str, z_m: float, told: bool) -> None:
    entries = [
        tf_entry(
            T0_NS,
            (base, "laser", (0, 0, 0.9), LEVEL),
            (base, "camera_depth_optical_frame", (0.2, 0, z_m), OPTICAL),
            topic="/tf_static",
        ),
        INFO,
        scan_entry(T0_NS),
        odometry_entry(T0_NS, 0.0, child=base),
        image_entry(T0_NS, PIXELS, topic=DEPTH),
    ]
    found = recording(write_bag(tmp_path, "ros1", entries))
    assert bool(found.notes) == told
    if told:
        (note,) = found.notes
        assert f"underground by its mounting, at a height of {z_m:.2f} m on {base}" in note


def test_a_camera_that_nods_is_told_of(tmp_path: Path) -> None:
    nods = [
        tf_entry(T0_NS + k * S // 10, ("base_link", "camera_depth_optical_frame",
                 (0.2, 0, 0.3 + 0.1 * k), OPTICAL))
        for k in range(5)
    ]  # fmt: skip
    found = recording(bag(tmp_path, INFO, *nods))
    assert any("moves on the base" in note for note in found.notes)


def test_the_base_is_that_of_the_lidars_whatever_the_cameras_hang_on(tmp_path: Path) -> None:
    """A camera on a mast of its own root: its mounting isn't known, the rest is as without it."""
    mast: Transform = ("mast", "camera_depth_optical_frame", (0, 0, 1), OPTICAL)
    found = recording(bag(tmp_path, INFO, transforms=[mast]))
    assert found.layout.base_frame == "base_link"
    assert found.calibration.lidars["/scan"].T_base_lidar[2, 3] == pytest.approx(0.9)
    assert not found.calibration.cameras
