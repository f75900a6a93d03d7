"""Depth cameras in bags: every encoding of both ROS versions, and what a bad image costs."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datasets import bag_images
from datasets.bags import BagRecording
from datasets.errors import InputError
from datasets.messages import DepthImage, Float32s, LaserScan, Message, Odometry
from datasets.options import ReadOptions
from tests.datasets.bag_factory import (
    FORMATS,
    T0_NS,
    Entry,
    Format,
    S,
    camera_info_entry,
    compressed_entry,
    image_entry,
    odometry_entry,
    png,
    scan_entry,
    storage_file,
    tf_entry,
    write_bag,
)

MS = 1_000_000
RAW = "/camera/depth/image_rect_raw"
COMPRESSED = RAW + "/compressedDepth"
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
TF = tf_entry(
    T0_NS,
    ("base_link", "laser", (0.2, 0.0, 0.9), (0, 0, 0, 1)),
    ("base_link", "camera_link", (0.35, 0.0, 0.2), (0, 0, 0, 1)),
    ("camera_link", "camera_depth_frame", (0.0, 0.02, 0.05), (0, 0, 0, 1)),
    ("camera_depth_frame", "camera_depth_optical_frame", (0, 0, 0), OPTICAL),
    topic="/tf_static",
)
INFO = camera_info_entry(T0_NS)


def mm(k: int) -> np.ndarray:
    """An asymmetric 8 x 6 image, different for each k, with a hole."""
    pixels = (1000 + 10 * k + np.arange(48).reshape(6, 8)).astype(np.uint16)
    pixels[1, 2] = 0
    return pixels


def metres(k: int) -> Float32s:
    return np.where(mm(k) > 0, mm(k) / 1000.0, np.nan).astype(np.float32)


def surroundings(count: int = 20) -> list[Entry]:
    entries = [TF, INFO]
    for k in range(count):
        entries.append(scan_entry(T0_NS + k * 100 * MS, bag_ns=T0_NS + k * 100 * MS + 60 * MS))
        entries.append(odometry_entry(T0_NS + k * 100 * MS + 30 * MS, 0.1 * k))
    return entries


def at(k: int) -> int:
    return T0_NS + (k * 100 + 50) * MS


def bag(folder: Path, entries: Sequence[Entry], kind: Format = "mcap", name: str = "drive") -> Path:
    return write_bag(folder, kind, sorted(entries, key=lambda entry: entry.bag_ns), name=name)


def read(path: Path, **options: object) -> tuple[BagRecording, list[Message]]:
    recording = BagRecording([path], ReadOptions(**options))  # type: ignore[arg-type]
    return recording, list(recording)


def images(messages: Sequence[Message]) -> list[DepthImage]:
    return [message for message in messages if isinstance(message, DepthImage)]


def one_of_each(k: int) -> dict[str, Entry]:
    a, b = 100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0
    with np.errstate(invalid="ignore"):
        inverse = np.where(mm(k) > 0, np.round(a / metres(k) + b), 0).astype(np.uint16)
    header = struct.pack("<iff", 0, 0.0, 0.0)
    return {
        "16UC1": image_entry(at(k), mm(k), padding=4),
        "mono16": image_entry(at(k), mm(k), encoding="mono16", bigendian=True),
        "32FC1": image_entry(at(k), metres(k), encoding="32FC1"),
        "compressedDepth": compressed_entry(at(k), header + png(mm(k)), topic=COMPRESSED),
        "inverse": compressed_entry(
            at(k), struct.pack("<iff", 0, a, b) + png(inverse), form="32FC1; compressedDepth"
        ),
        "png": compressed_entry(
            at(k), png(mm(k)), topic=RAW + "/compressed", form="16UC1; png compressed "
        ),
    }


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("encoding", list(one_of_each(0)))
def test_every_encoding_in_every_bag(tmp_path: Path, kind: Format, encoding: str) -> None:
    entries = surroundings() + [one_of_each(k)[encoding] for k in range(20)]
    recording, messages = read(bag(tmp_path, entries, kind))
    stamps = [message.stamp_ns for message in messages]
    assert stamps == sorted(stamps)
    assert sum(isinstance(m, LaserScan) for m in messages) == 20
    assert sum(isinstance(m, Odometry) for m in messages) == 20
    found = images(messages)
    assert [image.stamp_ns for image in found] == [at(k) for k in range(20)]
    tolerance = 2e-3 if encoding == "inverse" else 0.0
    for k, image in enumerate(found):
        np.testing.assert_allclose(image.depth_m, metres(k), atol=tolerance, rtol=0)
    (name,) = {image.camera for image in found}
    camera = recording.calibration.cameras[name]
    assert camera.intrinsics is not None
    np.testing.assert_array_equal(camera.intrinsics.K, [[5, 0, 4], [0, 5.5, 3], [0, 0, 1]])
    assert (camera.intrinsics.width_px, camera.intrinsics.height_px) == (8, 6)
    assert camera.T_base_camera is not None
    # One metre along the optical axis is one metre ahead; the image's right is the robot's right.
    ahead, right = camera.T_base_camera @ [0, 0, 1, 1], camera.T_base_camera @ [1, 0, 0, 1]
    assert ahead == pytest.approx([1.35, 0.02, 0.25, 1])
    assert right == pytest.approx([0.35, -0.98, 0.25, 1])
    assert not recording.notes
    again = images(list(recording))
    assert [image.stamp_ns for image in again] == [image.stamp_ns for image in found]


def test_raw_and_compressed_of_one_camera_are_one_and_the_option_chooses(tmp_path: Path) -> None:
    colour = image_entry(at(0), np.zeros((6, 8, 3), np.uint8), topic="/color", encoding="rgb8")
    jpeg = compressed_entry(at(0), b"\xff\xd8\xff", topic="/color/compressed", form="rgb8; jpeg")
    entries = [*surroundings(), colour, jpeg]
    for k in range(10):
        both = one_of_each(k)
        entries += [both["16UC1"], both["compressedDepth"]]
    path = bag(tmp_path, entries)
    recording, messages = read(path)
    assert {image.camera for image in images(messages)} == {RAW}
    (note,) = recording.notes
    assert note.startswith(f"{COMPRESSED} left out: it repeats the images of {RAW}")
    assert {m.camera for m in images(read(path, cameras=(COMPRESSED,))[1])} == {COMPRESSED}
    none = read(path, use_cameras=False)
    assert not images(none[1])
    assert not none[0].notes
    assert not none[0].calibration.cameras
    with pytest.raises(InputError, match=rf"/color: no depth camera.*rgb8.*can be: {RAW}"):
        read(path, cameras=("/color",))
    with pytest.raises(InputError, match=rf"topic depth: no such topic.*be: {RAW}"):
        read(path, cameras=("depth",))
    with pytest.raises(InputError, match="type nav_msgs/msg/Odometry"):
        read(path, cameras=("/odom",))


def test_rectified_and_aligned_copies_and_infrared_are_no_further_cameras(tmp_path: Path) -> None:
    entries = surroundings()
    for k in range(5):
        entries += [
            image_entry(at(k), mm(k), topic="/camera/depth/image_raw"),
            image_entry(at(k), mm(k), topic="/camera/depth/image_rect"),
            image_entry(at(k), mm(k), topic="/camera/aligned_depth_to_color/image", frame="color"),
            image_entry(at(k), mm(k), topic="/camera/depth/ir/image", encoding="mono16"),
            image_entry(at(k), mm(k), topic="/left/image_raw", encoding="mono16"),
            image_entry(at(k) + 1, mm(k), topic="/rear/tof/image_raw", frame="laser"),
        ]
    entries.append(camera_info_entry(T0_NS, topic="/rear/tof/camera_info"))
    recording, messages = read(bag(tmp_path, entries))
    assert {m.camera for m in images(messages)} == {
        "/camera/depth/image_rect",
        "/rear/tof/image_raw",
    }
    left_out = "\n".join(recording.notes)
    for name in ("/camera/depth/image_raw", "/camera/aligned_depth_to_color/image"):
        assert f"{name} left out: it repeats the images of /camera/depth/image_rect" in left_out
    assert "/camera/depth/ir/image left out: by its name" in left_out
    assert "/left/image_raw left out: by its name" in left_out
    # Asked for, it is read.
    chosen, _ = read(tmp_path / "drive", cameras=("/camera/depth/image_raw",))
    assert list(chosen.calibration.cameras) == ["/camera/depth/image_raw"]


def test_topics_of_depth_that_are_of_another_kind_are_told_of(tmp_path: Path) -> None:
    entries = surroundings()
    bgr = np.zeros((6, 8, 3), np.uint8)
    for k in range(3):
        entries += [
            image_entry(at(k), bgr, topic="/depth_camera/rgb/image", encoding="bgr8"),
            image_entry(at(k), bgr, topic="/camera/depth/painted", encoding="bgr8"),
            compressed_entry(at(k), b"\x00" * 40, form="16UC1; compressedDepth rvl"),
            Entry("/empty/depth", "sensor_msgs/msg/Image", at(k), b"\x00"),
        ]
    recording, messages = read(bag(tmp_path, entries))
    assert not images(messages)
    empty, painted, rvl = sorted(recording.notes, key=lambda note: len(note.split(" left")[0]))
    assert empty == "/empty/depth left out: none of its messages can be decoded"
    assert "/camera/depth/painted left out: its encoding 'bgr8'" in painted
    assert f"{COMPRESSED} left out: its format '16UC1; compressedDepth rvl'" in rvl
    assert set(recording.notes.values()) == {3}


def test_bad_images_cost_themselves_and_are_counted(tmp_path: Path) -> None:
    good = [image_entry(at(k), mm(k)) for k in range(12)]
    small = np.full((3, 4), 900, np.uint16)
    bad = [
        image_entry(at(12), small),
        image_entry(at(13), small),
        image_entry(at(14), mm(0), encoding="bgr8"),
        image_entry(at(15), mm(0), height=7),
        image_entry(at(16), np.zeros((6, 8), np.uint16)),
        Entry(RAW, "sensor_msgs/msg/Image", at(17), b"\x00\x01\x00\x00\x01"),
    ]
    recording, messages = read(bag(tmp_path, [*surroundings(), *good, *bad]))
    found = images(messages)
    assert [image.stamp_ns for image in found] == [at(k) for k in (*range(12), 16)]
    assert np.isnan(found[-1].depth_m).all()
    known = "(known are 16UC1, mono16, 32FC1, raw or as PNG)"
    name = f"image of {RAW}"
    assert recording.notes == {
        f"{name} left out: it has 4 x 3 pixels, its intrinsics are for 8 x 6": 2,
        f"{name} left out: its encoding 'bgr8' is none of a depth image {known}": 1,
        f"{name} left out: its data are shorter than its size says": 1,
        f"{name}: depth image without one measurement": 1,
        f"message of {RAW} left out: it can't be decoded": 1,
    }


def test_damaged_pngs_cost_themselves(tmp_path: Path) -> None:
    entries = surroundings()
    for k in range(15):
        data = struct.pack("<iff", 0, 0.0, 0.0) + png(mm(k))
        entries.append(compressed_entry(at(k), data[:-9] if k % 5 == 2 else data))
    recording, messages = read(bag(tmp_path, entries, "ros1"))
    assert len(images(messages)) == 12
    assert recording.notes == {f"image of {COMPRESSED} left out: its PNG is damaged": 3}


@pytest.mark.parametrize("kind", FORMATS)
def test_images_that_wait_long_are_read_again_and_are_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: Format
) -> None:
    """Odometry is recorded 1.5 s late, and some stamps repeat: what is left out is not mixed up."""
    entries = [TF, INFO]
    for k in range(60):
        entries.append(scan_entry(T0_NS + k * 100 * MS))
        entries.append(odometry_entry(T0_NS + k * 100 * MS, 0.1 * k, bag_ns=at(k) + 1500 * MS))
        entries.append(image_entry(at(k - (k % 7 == 3)), mm(k), bag_ns=at(k)))
        other = image_entry(at(k) + MS, mm(k + 50), topic="/rear/depth/image", frame="laser")
        entries += [other, camera_info_entry(at(k), topic="/rear/depth/camera_info")]
    path = bag(tmp_path, entries, kind)
    expected = images(read(path)[1])
    read_again = []
    original = bag_images.ImageStore._read_again

    def counted(self: bag_images.ImageStore, image: bag_images.WaitingImage) -> object:
        read_again.append(image.index)
        return original(self, image)

    monkeypatch.setattr(bag_images, "HELD_BYTES", 1000)
    monkeypatch.setattr(bag_images.ImageStore, "_read_again", counted)
    found = images(read(path)[1])
    assert len(read_again) > 60
    assert len(found) == len(expected) == 60 - 9 + 60
    for one, other in zip(found, expected, strict=True):
        assert (one.stamp_ns, one.camera) == (other.stamp_ns, other.camera)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)
    front = [m for m in found if m.camera == RAW]
    kept = [k for k in range(60) if k % 7 != 3]
    for k, image in zip(kept, front, strict=True):
        np.testing.assert_array_equal(image.depth_m, metres(k))


@pytest.mark.parametrize("off_s", [3600.0, -3600.0, 86_400.0 * 365])
def test_a_camera_of_another_time_costs_no_scan(tmp_path: Path, off_s: float) -> None:
    away_ns = round(off_s * S)
    entries = surroundings()
    entries += [image_entry(at(k) + away_ns, mm(k), bag_ns=at(k) - 60 * MS) for k in range(20)]
    path = bag(tmp_path, entries)
    recording, messages = read(path)
    assert sum(isinstance(m, LaserScan) for m in messages) == 20
    assert not images(messages)
    ((note, count),) = recording.notes.items()
    assert "more than 30 s away" in note
    assert count == 20
    file = tmp_path / "robot.yaml"
    file.write_text(f"cameras: {{{RAW}: {{clock_offset_s: {-off_s}}}}}\n")
    mended = images(read(path, calibration=file)[1])
    assert [image.stamp_ns for image in mended] == [at(k) for k in range(20)]


@pytest.mark.parametrize("off_s", [3.0, -3.0])
def test_a_camera_whose_clock_is_seconds_off_is_left_out_with_what_mends_it(
    tmp_path: Path, off_s: float
) -> None:
    off_ns = round(off_s * S)
    entries = surroundings()
    entries += [image_entry(at(k) + off_ns, mm(k), bag_ns=at(k) + 20 * MS) for k in range(20)]
    path = bag(tmp_path, entries)
    recording, messages = read(path)
    assert sum(isinstance(m, LaserScan) for m in messages) == 20
    assert not images(messages)
    ((note, count),) = recording.notes.items()
    assert f"stamped 3.0 s {'later' if off_s > 0.0 else 'earlier'}" in note
    assert f"clock_offset_s: {-off_s:.1f}" in note
    assert count == 20
    file = tmp_path / "robot.yaml"
    file.write_text(f"cameras: {{{RAW}: {{clock_offset_s: {-off_s}}}}}\n")
    mended = images(read(path, calibration=file)[1])
    assert [image.stamp_ns for image in mended] == [at(k) for k in range(20)]


def test_images_recorded_late_are_kept_where_all_sensors_are(tmp_path: Path) -> None:
    """A slow disk, or a recorder whose clock is off: it says nothing of the camera."""
    later_ns = 5 * S
    entries: list[Entry] = [TF, INFO]
    for k in range(20):
        entries += [
            scan_entry(at(k), bag_ns=at(k) + later_ns),
            odometry_entry(at(k) + MS, 0.1 * k, bag_ns=at(k) + MS + later_ns),
            image_entry(at(k), mm(k), bag_ns=at(k) + later_ns + 600 * MS),
        ]
    recording, messages = read(bag(tmp_path, entries))
    assert len(images(messages)) == 20
    assert not recording.notes


def test_a_camera_that_starts_before_the_others_keeps_its_images(tmp_path: Path) -> None:
    entries = surroundings() + [image_entry(at(k), mm(k)) for k in range(-30, 20)]
    recording, messages = read(bag(tmp_path, entries))
    assert [image.stamp_ns for image in images(messages)] == [at(k) for k in range(-30, 20)]
    assert not recording.notes


def test_a_clock_that_is_set_back_takes_the_images_along(tmp_path: Path) -> None:
    entries: list[Entry] = [TF, INFO]
    for k in range(80):
        stamp_ns = T0_NS + k * 100 * MS - (3600 * S if k >= 40 else 0)
        now_ns = T0_NS + k * 100 * MS
        entries += [
            scan_entry(stamp_ns, bag_ns=now_ns),
            odometry_entry(stamp_ns + MS, 0.1 * k, bag_ns=now_ns + MS),
            image_entry(stamp_ns + 2 * MS, mm(k), bag_ns=now_ns + 2 * MS),
        ]
    recording, messages = read(bag(tmp_path, entries))
    found = images(messages)
    assert [image.stamp_ns for image in found] == [T0_NS + k * 100 * MS + 2 * MS for k in range(80)]
    for k, image in enumerate(found):
        np.testing.assert_array_equal(image.depth_m, metres(k))
    assert sum(isinstance(m, LaserScan) for m in messages) == 80
    assert all("clock set back" in note for note in recording.notes)


STAMPS_MS = st.lists(st.one_of(st.integers(-40_000, 40_000), st.just(0)), min_size=12, max_size=30)


@settings(
    deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(STAMPS_MS)
def test_images_of_any_stamp_leave_the_scans_as_they_are(
    tmp_path: Path, wrong_ms: list[int]
) -> None:
    entries = surroundings(len(wrong_ms))
    wrong = [(k, at(k) + off_ms * MS) for k, off_ms in enumerate(wrong_ms)]
    entries += [image_entry(stamp_ns, mm(k), bag_ns=at(k)) for k, stamp_ns in wrong]
    entries.sort(key=lambda entry: entry.bag_ns)
    with TemporaryDirectory(dir=tmp_path) as folder:
        path = write_bag(Path(folder), "ros1", entries)
        recording, messages = read(path)
        plain = read(path, use_cameras=False)[1]
    kinds = (LaserScan, Odometry)
    kept = [(type(m), m.stamp_ns) for m in messages if isinstance(m, kinds)]
    assert kept == [(type(m), m.stamp_ns) for m in plain]
    counted = sum(count for note, count in recording.notes.items() if "left out" in note)
    assert len(images(messages)) + counted == len(wrong_ms)


def test_a_part_of_a_recording_decodes_only_its_images(tmp_path: Path) -> None:
    entries = surroundings() + [image_entry(at(k), mm(k)) for k in range(20)]
    found = images(read(bag(tmp_path, entries), start_s=0.5, duration_s=0.5)[1])
    assert [image.stamp_ns for image in found] == [at(k) for k in range(5, 10)]


@pytest.mark.parametrize("kind", FORMATS)
def test_a_camera_without_any_lidar(tmp_path: Path, kind: Format) -> None:
    entries = [TF, INFO]
    for k in range(20):
        entries += [image_entry(at(k), mm(k)), odometry_entry(at(k), 0.1 * k)]
    recording, messages = read(bag(tmp_path, entries, kind))
    assert len(images(messages)) == 20
    assert sum(isinstance(m, Odometry) for m in messages) == 20
    assert recording.layout.base_frame == "base_link"
    assert not recording.calibration.lidars
    assert not recording.notes


def test_lidars_can_be_left_out(tmp_path: Path) -> None:
    path = bag(tmp_path, surroundings() + [image_entry(at(k), mm(k)) for k in range(20)])
    recording, messages = read(path, use_lidars=False)
    assert not any(isinstance(m, LaserScan) for m in messages)
    assert len(images(messages)) == 20
    assert not recording.calibration.lidars
    with pytest.raises(InputError, match="no depth camera in the recording"):
        read(path, use_lidars=False, use_cameras=False)


@pytest.mark.parametrize(
    ("kind", "compression", "kept"), [("ros1", "bz2", 0.8), ("mcap", "", 0.4), ("sqlite3", "", 0.8)]
)
def test_what_is_readable_of_a_damaged_bag_is_read_with_its_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: Format, compression: str, kept: float
) -> None:
    """Also where images are read a second time: both readings meet the same damage."""
    entries = surroundings(40) + [image_entry(at(k), mm(k)) for k in range(40)]
    entries.sort(key=lambda entry: entry.bag_ns)
    whole = storage_file(write_bag(tmp_path, kind, entries, compression=compression))
    content = bytearray(whole.read_bytes())
    middle = round(0.5 * kept * len(content))
    content[middle : middle + 40] = bytes(40)
    path = tmp_path / f"broken{whole.suffix}"
    path.write_bytes(content[: round(kept * len(content))])
    found = images(read(path, salvage=True)[1])
    assert 5 < len(found) < 40
    monkeypatch.setattr(bag_images, "HELD_BYTES", 0)
    again = images(read(path, salvage=True)[1])
    assert [image.stamp_ns for image in again] == [image.stamp_ns for image in found]
    for one, other in zip(again, found, strict=True):
        np.testing.assert_array_equal(one.depth_m, other.depth_m)


def test_nothing_to_see_names_what_is_there(tmp_path: Path) -> None:
    path = bag(tmp_path, [odometry_entry(T0_NS, 0.0), INFO])
    with pytest.raises(InputError, match=r"no lidar.*/camera/depth/camera_info"):
        read(path)
    with pytest.raises(InputError, match=r"no depth camera.*/odom"):
        read(path, use_lidars=False)
