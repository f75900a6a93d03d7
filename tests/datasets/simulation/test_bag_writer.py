"""Bags of simulated drives: read back what was streamed, and whole or not at all."""

from __future__ import annotations

import errno
import resource
import shutil
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from datasets.bag_messages import framed_pose
from datasets.bags import BagRecording
from datasets.errors import InputError
from datasets.messages import DepthImage, LaserScan, Message, Odometry
from datasets.options import ReadOptions
from datasets.simulation import bag_writer
from datasets.simulation.bag_writer import check_room, estimate, write_bag
from datasets.simulation.driver_messages import (
    ODOMETRY,
    TRUTH,
    DriverDepth,
    DriverPose,
    DriverTurn,
)
from datasets.simulation.place import DriveSpec, load_place
from datasets.simulation.robot import DEPTH, ROBOTS, SCAN, MountedLidar, Robot
from datasets.simulation.ros_messages import COMPRESSED, RosMessages
from datasets.simulation.simulated_drive import START_NS, SimulatedDrive

BEAM_ROOM = load_place("beam-room")
CURVE = DriveSpec(np.array([[0.0, 0.0], [0.3, 0.0], [0.4, 0.3]]), stand_s=0.2)
NAMES = ("drive.mcap", "drive.bag", "drive")


def driven(robot: str = "paper", seed: int = 2) -> SimulatedDrive:
    return SimulatedDrive(BEAM_ROOM, CURVE, ROBOTS[robot], seed)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bags")
    for name in NAMES:
        write_bag(driven(), folder / name)
    write_bag(driven(), folder / "raw.mcap", raw_depth=True)
    return {name: folder / name for name in (*NAMES, "raw.mcap")}


def assert_same(one: Message, other: Message) -> None:
    assert type(one) is type(other)
    assert one.stamp_ns == other.stamp_ns
    match one, other:
        case LaserScan(), LaserScan():
            assert one.lidar == other.lidar
            for name in ("ranges_m", "bearings_rad", "beam_offsets_s"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
            assert (one.range_min_m, one.range_max_m) == (other.range_min_m, other.range_max_m)
        case DepthImage(), DepthImage():
            np.testing.assert_array_equal(one.depth_m, other.depth_m)
        case Odometry(), Odometry():
            np.testing.assert_array_equal(one.T_odom_base, other.T_odom_base)


@pytest.mark.parametrize("name", [*NAMES, "raw.mcap"])
def test_the_reader_gives_back_what_was_streamed(bags: dict[str, Path], name: str) -> None:
    drive = driven()
    recording = BagRecording([bags[name]], ReadOptions())
    read, streamed = list(recording), list(drive)
    for one, other in zip(read, streamed, strict=True):
        assert_same(one, other)
    assert recording.notes == drive.notes
    lidar, camera = recording.calibration.lidars, recording.calibration.cameras
    np.testing.assert_allclose(
        lidar[SCAN].T_base_lidar, drive.calibration.lidars[SCAN].T_base_lidar, atol=1e-12
    )
    (mounted,) = camera.values()
    expected = drive.calibration.cameras[DEPTH]
    assert mounted.T_base_camera is not None
    assert mounted.intrinsics is not None
    assert expected.T_base_camera is not None
    assert expected.intrinsics is not None
    np.testing.assert_allclose(mounted.T_base_camera, expected.T_base_camera, atol=1e-12)
    np.testing.assert_array_equal(mounted.intrinsics.K, expected.intrinsics.K)


@pytest.mark.parametrize("name", NAMES)
def test_lidar_odometry_and_truth_come_back(bags: dict[str, Path], name: str) -> None:
    drive = driven()
    recording = BagRecording([bags[name]], ReadOptions())
    read = [message for message in recording if not isinstance(message, DepthImage)]
    streamed = [message for message in drive if not isinstance(message, DepthImage)]
    for one, other in zip(read, streamed, strict=True):
        assert_same(one, other)
    truth = recording.ground_truth()
    assert truth is not None
    np.testing.assert_array_equal(truth.stamps_ns, drive.ground_truth().stamps_ns)
    np.testing.assert_array_equal(truth.xyyaw, drive.ground_truth().xyyaw)


@pytest.mark.parametrize("name", [*NAMES, "raw.mcap"])
def test_other_peoples_reader_finds_what_ros_expects(bags: dict[str, Path], name: str) -> None:
    seen = defaultdict(list)
    stamps_ns: list[int] = []
    with AnyReader([bags[name]]) as reader:
        for connection, at_ns, data in reader.messages():
            stamps_ns.append(at_ns)
            seen[connection.topic].append((at_ns, reader.deserialize(data, connection.msgtype)))
    image = DEPTH if name == "raw.mcap" else DEPTH + COMPRESSED
    assert set(seen) == {
        *("/scan", "/odom", "/tf", "/tf_static", TRUTH, "/camera/depth/camera_info", image)
    }
    assert stamps_ns == sorted(stamps_ns)
    raws = list(driven().driver_messages())

    turns = [raw for raw in raws if isinstance(raw, DriverTurn)]
    for raw, (at_ns, scan) in zip(turns, seen["/scan"], strict=True):
        assert at_ns == raw.published_ns
        assert scan.header.stamp.sec * 10**9 + scan.header.stamp.nanosec == raw.stamp_ns
        assert scan.header.frame_id == "laser"
        np.testing.assert_array_equal(scan.ranges, raw.turn.ranges_m)
        assert scan.angle_increment < 0.0
        assert scan.angle_min == pytest.approx(np.pi)

    images = [raw for raw in raws if isinstance(raw, DriverDepth)]
    for raw, (_, message) in zip(images, seen[image], strict=True):
        if name == "raw.mcap":
            assert (message.encoding, message.step) == ("16UC1", 1280)
            pixels = message.data.view("<u2").reshape(message.height, message.width)
        else:
            assert message.format == "16UC1; compressedDepth png"
            pixels = cv2.imdecode(message.data[12:], cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(pixels, raw.depth_mm)
    for (_, info), (_, message) in zip(seen["/camera/depth/camera_info"], seen[image], strict=True):
        assert info.header == message.header
        assert (info.width, info.height) == (640, 480)
        k = info.K if name.endswith(".bag") else info.k
        np.testing.assert_allclose(k, [384, 0, 319.5, 0, 384, 239.5, 0, 0, 1])

    poses = [raw for raw in raws if isinstance(raw, DriverPose)]
    for raw, (_, message) in zip(
        (raw for raw in poses if raw.topic == ODOMETRY), seen[ODOMETRY], strict=True
    ):
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
        assert [message.pose.pose.position.x, message.pose.pose.position.y] == [*raw.xyyaw[:2]]
        assert message.twist.twist.linear.x == raw.speed_m_s
        assert message.twist.twist.angular.z == raw.turn_rate_rad_s
    for raw, (_, message) in zip(
        (raw for raw in poses if raw.topic == TRUTH), seen[TRUTH], strict=True
    ):
        assert message.header.frame_id == "map"
        assert [message.pose.position.x, message.pose.position.y] == [*raw.xyyaw[:2]]

    links = {
        (link.header.frame_id, link.child_frame_id): link.transform
        for _, message in [*seen["/tf_static"], *seen["/tf"]]
        for link in message.transforms
    }
    assert set(links) == {
        ("base_link", "laser"),
        ("base_link", "camera_link"),
        ("camera_link", "camera_depth_optical_frame"),
        ("odom", "base_link"),
    }
    assert links["base_link", "laser"].translation.z == 0.895
    turn = links["camera_link", "camera_depth_optical_frame"].rotation
    assert np.abs([turn.x - -0.5, turn.y - 0.5, turn.z - -0.5, turn.w - 0.5]).max() < 1e-12
    assert len(seen["/tf"]) == len(seen["/odom"])
    assert seen["/tf_static"][0][0] == START_NS


def test_the_same_drive_is_the_same_bytes_whatever_the_threads(
    bags: dict[str, Path], tmp_path: Path
) -> None:
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1 if before != 1 else 2)
        write_bag(driven(), tmp_path / "other.mcap")
    finally:
        cv2.setNumThreads(before)
    assert (tmp_path / "other.mcap").read_bytes() == bags["drive.mcap"].read_bytes()
    write_bag(driven(seed=3), tmp_path / "seed.mcap")
    assert (tmp_path / "seed.mcap").read_bytes() != bags["drive.mcap"].read_bytes()
    write_bag(driven(), tmp_path / "other.bag")
    assert (tmp_path / "other.bag").read_bytes() == bags["drive.bag"].read_bytes()


def test_it_is_known_beforehand_how_large_a_bag_becomes(bags: dict[str, Path]) -> None:
    for name, raw_depth in (("drive.mcap", False), ("raw.mcap", True)):
        size = bags[name].stat().st_size
        assert estimate(driven(), raw_depth=raw_depth).size_bytes == pytest.approx(size, rel=0.15)
    blind = replace(ROBOTS["paper"], cameras={})
    assert estimate(SimulatedDrive(BEAM_ROOM, CURVE, blind, 1)).size_bytes < 1e6
    with pytest.raises(InputError, match=r"needs about .* MB free"):
        check_room(bags["drive.mcap"], 10**18)


def test_progress_is_told(tmp_path: Path) -> None:
    told: list[float] = []
    written = write_bag(driven(), tmp_path / "drive.mcap", progress=told.append)
    duration_s = driven().drive.duration_s
    assert told == sorted(told)
    assert duration_s - 1.0 < told[-1] <= duration_s + 0.1
    assert written.size_bytes == (tmp_path / "drive.mcap").stat().st_size
    assert written.messages["/scan"] == sum(isinstance(m, LaserScan) for m in driven())


@contextmanager
def small_files() -> Iterator[None]:
    """Files may not become larger than 100 kB: writing more is an OSError, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", NAMES)
def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, name: str) -> None:
    with small_files(), pytest.raises(InputError, match=r"can't be written .*Make room"):
        write_bag(driven(), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_full_at_the_end_keeps_the_bag_that_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "drive.mcap").write_bytes(b"an older bag")

    def full(made: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(bag_writer, "_sync", full)
    with pytest.raises(InputError, match="No space left on device"):
        write_bag(driven(), tmp_path / "drive.mcap", force=True)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"an older bag"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", [KeyboardInterrupt, RuntimeError])
def test_whatever_breaks_in_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, kind: type[BaseException]
) -> None:
    calls = iter(range(40))
    original = RosMessages.of

    def failing(self: RosMessages, raw: object) -> object:
        if next(calls, None) is None:
            raise kind
        return original(self, raw)  # type: ignore[arg-type]

    monkeypatch.setattr(RosMessages, "of", failing)
    with pytest.raises(kind):
        write_bag(driven(), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", NAMES)
def test_a_bag_is_replaced_only_if_asked(bags: dict[str, Path], tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    write_bag(driven(seed=3), path)
    with pytest.raises(InputError, match=r"exists already.*--force"):
        write_bag(driven(), path)
    write_bag(driven(), path, force=True)
    files = [path] if path.is_file() else sorted(path.iterdir())
    wanted = [bags[name]] if path.is_file() else sorted(bags[name].iterdir())
    assert [file.read_bytes() for file in files] == [file.read_bytes() for file in wanted]
    assert list(tmp_path.iterdir()) == [path]


def test_a_bag_that_cannot_be_replaced_stays(
    bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "drive"
    shutil.copytree(bags["drive"], path)

    def refused(made: Path, target: Path) -> None:
        raise OSError(errno.EIO, "input/output error")

    monkeypatch.setattr(bag_writer.os, "replace", refused)
    with pytest.raises(InputError, match="can't be written"):
        write_bag(driven(seed=3), path, force=True)
    assert list(tmp_path.iterdir()) == [path]
    for file in sorted(path.iterdir()):
        assert file.read_bytes() == (bags["drive"] / file.name).read_bytes()


def test_what_is_no_bag_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("...")
    with pytest.raises(InputError, match="no bag of that kind"):
        write_bag(driven(), tmp_path / "thesis", force=True)
    shutil.move(tmp_path / "thesis", tmp_path / "thesis.mcap")
    with pytest.raises(InputError, match="no bag of that kind"):
        write_bag(driven(), tmp_path / "thesis.mcap", force=True)
    assert (tmp_path / "thesis.mcap" / "thesis.tex").read_text() == "..."


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("drive.db3", r"no kind of bag ends in \.db3.*\.mcap"),
        ("nowhere/drive.mcap", "no such folder.*Make"),
        ("file/drive.mcap", "no such folder"),
    ],
)
def test_paths_that_can_not_be_are_refused(tmp_path: Path, path: str, said: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=said):
        write_bag(driven(), tmp_path / path)


@pytest.mark.parametrize("seed", range(20))
def test_mountings_of_all_kinds_come_back(seed: int) -> None:
    turned = Rotation.random(random_state=seed)
    if seed < 4:  # half turns, and almost none
        axis = np.eye(3)[seed % 3]
        turned = Rotation.from_rotvec(axis * (1e-7 if seed == 3 else np.pi))
    T_base_lidar = np.eye(4)
    T_base_lidar[:3, :3] = turned.as_matrix()
    T_base_lidar[:3, 3] = 0.3, -0.2, 0.5
    robot = Robot({SCAN: MountedLidar(T_base_lidar)})
    store = get_typestore(Stores.ROS2_JAZZY)
    mountings = RosMessages(store, robot, raw_depth=False).mountings(START_NS).message
    assert mountings.transforms[0].transform.rotation.w >= 0.0
    np.testing.assert_allclose(
        framed_pose(mountings.transforms[0]).T_parent_child, T_base_lidar, atol=1e-14
    )
