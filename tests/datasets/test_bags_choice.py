"""Which topics and frames are taken, and what is said where there is none to take."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from datasets.bags import BagRecording
from datasets.errors import InputError
from datasets.messages import Odometry
from datasets.options import ReadOptions
from datasets.se2 import xyyaw
from datasets.tf_tree import se3
from tests.datasets.bag_factory import (
    T0_NS,
    Entry,
    S,
    Transform,
    odometry_entry,
    pose_entry,
    scan_entry,
    string_entry,
    tf_entry,
    write_bag,
    yaw_quaternion,
)

LEVEL = (0.0, 0.0, 0.0, 1.0)
BACK = (0.0, 0.0, 1.0, 0.0)
UPSIDE_DOWN = (1.0, 0.0, 0.0, 0.0)


def bag(tmp_path: Path, *entries: Entry) -> Path:
    return write_bag(tmp_path, "ros1", sorted(entries, key=lambda entry: entry.bag_ns))


def recording(path: Path, **options: object) -> BagRecording:
    return BagRecording([path], ReadOptions(**options))  # type: ignore[arg-type]


def static(*transforms: Transform, at_ns: int = T0_NS) -> Entry:
    return tf_entry(at_ns, *transforms, topic="/tf_static")


def test_a_chain_of_static_and_constant_links_with_a_lidar_upside_down_and_backwards(
    tmp_path: Path,
) -> None:
    """base_footprint -> base_link (tf) -> plate (tf_static, turned back) -> laser (rolled)."""
    entries = [scan_entry(T0_NS + k * S // 10, frame="/laser") for k in range(5)]
    entries += [odometry_entry(T0_NS + k * S // 10, 0.0, child="base_footprint") for k in range(5)]
    entries += [
        tf_entry(T0_NS + k * S // 10, ("/base_footprint", "/base_link", (0, 0, 0.1), LEVEL))
        for k in range(5)
    ]
    entries.append(static(("base_link", "plate", (-0.4, 0, 0.2), BACK)))
    entries.append(static(("plate", "laser", (0, 0.05, 0.02), UPSIDE_DOWN)))
    found = recording(bag(tmp_path, *entries))
    assert found.layout.base_frame == "base_footprint"
    expected = (
        se3((0, 0, 0.1), LEVEL) @ se3((-0.4, 0, 0.2), BACK) @ se3((0, 0.05, 0.02), UPSIDE_DOWN)
    )
    T_base_lidar = found.calibration.lidars["/scan"].T_base_lidar
    assert T_base_lidar == pytest.approx(expected, abs=1e-12)
    assert T_base_lidar[2, 2] == pytest.approx(-1.0)


def test_odometry_that_is_only_in_tf(tmp_path: Path) -> None:
    """map -> odom -> base_footprint -> base_link -> laser; other frames hang on odom too."""
    entries: list[Entry] = []
    for k in range(40):
        at_ns = T0_NS + k * S // 20
        entries.append(
            tf_entry(
                at_ns,
                ("odom", "base_footprint", (0.1 * k, -0.02 * k, 0), yaw_quaternion(0.1 * k)),
                ("base_footprint", "base_link", (0.0, 0, 0.1), LEVEL),
                ("base_link", "laser", (0.3, 0, 0.1), LEVEL),
            )
        )
        entries.append(tf_entry(at_ns, ("odom", "plan", (k, 0, 0), LEVEL)))
        entries.append(tf_entry(at_ns, ("map", "odom", (0.5 * k, 0, 0), LEVEL)))
        if k % 2:
            entries.append(scan_entry(at_ns))
    found = recording(bag(tmp_path, *entries))
    poses = [m.T_odom_base for m in found if isinstance(m, Odometry)]
    assert found.layout.base_frame == "base_footprint"
    assert len(poses) == 40
    for k, T_odom_base in enumerate(poses):
        x, y, yaw = xyyaw(T_odom_base)
        assert (x, y) == pytest.approx((0.1 * k, -0.02 * k))
        assert math.cos(yaw - 0.1 * k) == pytest.approx(1.0)
    assert found.calibration.lidars["/scan"].T_base_lidar[0, 3] == pytest.approx(0.3)


def test_odometry_can_be_chosen_by_topic_and_from_tf(tmp_path: Path) -> None:
    entries: list[Entry] = [static(("base_link", "laser", (0, 0, 0), LEVEL))]
    for k in range(5):
        at_ns = T0_NS + k * S // 10
        entries.append(scan_entry(at_ns))
        entries.append(odometry_entry(at_ns, 1.0, topic="/robot/odom"))
        entries.append(odometry_entry(at_ns, 2.0, topic="/camera/odom"))
        entries.append(odometry_entry(at_ns, 4.0, topic="/gt/odom"))
        entries.append(tf_entry(at_ns, ("odom", "base_link", (3.0, 0, 0), LEVEL)))
    path = bag(tmp_path, *entries)

    def first_x(**options: object) -> float:
        messages = recording(path, **options)
        return next(m.T_odom_base[0, 2] for m in messages if isinstance(m, Odometry))

    assert first_x() == 1.0
    assert first_x(odometry="camera/odom") == 2.0
    assert first_x(odometry="tf") == 3.0
    assert any("not from /camera/odom" in note for note in recording(path).notes)
    truth = recording(path).ground_truth()
    assert truth is not None
    assert truth.xyyaw[0, 0] == 4.0
    with pytest.raises(InputError, match=r"`--odometry` can be: .*/robot/odom"):
        recording(path, odometry="/nothing")
    with pytest.raises(InputError, match="--ground-truth"):
        recording(path, ground_truth="/scan")


def test_visual_odometry_of_a_camera_moves_the_base(tmp_path: Path) -> None:
    """The camera is 0.5 m ahead of the base and looks left; the base is what is tracked."""
    entries = [
        static(
            ("base_link", "camera", (0.5, 0, 0.4), yaw_quaternion(math.pi / 2)),
            ("base_link", "laser", (0.1, 0, 0.2), LEVEL),
        ),
        scan_entry(T0_NS),
        odometry_entry(T0_NS, 2.0, 1.0, math.pi / 2, child="camera"),
    ]
    found = recording(bag(tmp_path, *entries))
    odometry = next(m for m in found if isinstance(m, Odometry))
    assert found.layout.base_frame == "base_link"
    assert xyyaw(odometry.T_odom_base) == pytest.approx((1.5, 1.0, 0.0), abs=1e-9)


def test_odometry_whose_child_frame_is_nonsense_is_that_of_the_base(tmp_path: Path) -> None:
    """Seen in drivers: child_frame_id says odom. tf's first pose must not be added to it."""
    entries: list[Entry] = [static(("base_link", "laser", (0.1, 0, 0.2), LEVEL))]
    for k in range(5):
        at_ns = T0_NS + k * S // 10
        entries.append(scan_entry(at_ns))
        entries.append(odometry_entry(at_ns, 5.0 + k, child="odom"))
        entries.append(tf_entry(at_ns, ("odom", "base_link", (5.0 + k, 0, 0), LEVEL)))
    found = recording(bag(tmp_path, *entries))
    poses = [m.T_odom_base[0, 2] for m in found if isinstance(m, Odometry)]
    assert found.layout.base_frame == "base_link"
    assert poses == pytest.approx([5.0, 6.0, 7.0, 8.0, 9.0])


def test_what_is_ground_truth_by_option_is_not_odometry_too(tmp_path: Path) -> None:
    entries = [
        scan_entry(T0_NS),
        odometry_entry(T0_NS, 1.0, topic="/odom"),
        odometry_entry(T0_NS, 2.0, topic="/tracker"),
    ]
    found = recording(bag(tmp_path, *entries), ground_truth="/odom")
    assert [m.T_odom_base[0, 2] for m in found if isinstance(m, Odometry)] == [2.0]


def test_ground_truth_of_another_frame_becomes_that_of_the_base(tmp_path: Path) -> None:
    entries = [
        static(
            ("base_link", "laser", (0.1, 0, 0), LEVEL), ("base_link", "prism", (0, 1, 1), LEVEL)
        ),
        scan_entry(T0_NS),
        odometry_entry(T0_NS, 0.0),
        odometry_entry(T0_NS, 5.0, 5.0, math.pi / 2, topic="/ground_truth/odom", child="prism"),
    ]
    truth = recording(bag(tmp_path, *entries)).ground_truth()
    assert truth is not None
    assert truth.xyyaw[0] == pytest.approx([6.0, 5.0, math.pi / 2])


@pytest.mark.parametrize("delay_s", [3, 50])
def test_tf_that_comes_late_is_there_for_the_first_scan(tmp_path: Path, delay_s: int) -> None:
    entries = [scan_entry(T0_NS + k * S) for k in range(delay_s + 10)]
    late = [tf_entry(T0_NS + delay_s * S, ("base_link", "laser", (0.7, 0, 0), LEVEL))]
    found = recording(bag(tmp_path, *entries, *late))
    messages = iter(found)
    next(messages)
    assert found.calibration.lidars["/scan"].T_base_lidar[0, 3] == pytest.approx(0.7)


def test_a_lidar_that_nods_is_told_of(tmp_path: Path) -> None:
    entries: list[Entry] = [odometry_entry(T0_NS, 0.0)]
    for k in range(20):
        pitch = (0.0, math.sin(0.01 * k), 0.0, math.cos(0.01 * k))
        entries.append(tf_entry(T0_NS + k * S // 10, ("base_link", "laser", (0, 0, 1), pitch)))
        entries.append(scan_entry(T0_NS + k * S // 10))
    found = recording(bag(tmp_path, *entries))
    assert any("moves on the base" in note for note in found.notes)
    assert found.calibration.lidars["/scan"].T_base_lidar == pytest.approx(se3((0, 0, 1), LEVEL))


def test_one_lidar_without_any_tf_is_the_base_and_says_so(tmp_path: Path) -> None:
    entries = [scan_entry(T0_NS + k * S // 10) for k in range(3)]
    found = recording(bag(tmp_path, *entries))
    assert len(list(found)) == 3
    assert found.calibration.lidars["/scan"].T_base_lidar == pytest.approx(np.eye(4))
    assert any("taken as the base" in note for note in found.notes)
    assert any("no odometry" in note for note in found.notes)


def test_two_lidars_without_tf_need_a_calibration(tmp_path: Path) -> None:
    path = bag(
        tmp_path,
        scan_entry(T0_NS, topic="/front", frame="f"),
        scan_entry(T0_NS, topic="/rear", frame="r"),
    )
    with pytest.raises(InputError) as caught:
        recording(path)
    text = str(caught.value)
    assert "/front" in text
    assert "'f'" in text
    assert "--calibration FILE" in text
    calibration = tmp_path / "robot.yaml"
    calibration.write_text(
        "lidars:\n  /front: {mounting: {x_m: 0.4}}\n"
        "  /rear: {mounting: {x_m: -0.4, yaw_deg: 180}, mask_deg: [[-10, 10]], clock_offset_s: 2}\n"
    )
    found = recording(path, calibration=calibration)
    messages = list(found)
    rear = found.calibration.lidars["/rear"]
    assert rear.T_base_lidar[:2, 3] == pytest.approx([-0.4, 0.0])
    assert rear.masks_rad == ((pytest.approx(math.radians(-10)), pytest.approx(math.radians(10))),)
    assert [m.stamp_ns for m in messages] == [T0_NS, T0_NS + 2 * S]
    assert list(recording(path, lidars=("/rear",)).calibration.lidars) == ["/rear"]


def test_tf_that_does_not_know_the_lidar_is_an_error_that_names_it(tmp_path: Path) -> None:
    """tf_static forgotten when recording: the mounting can't be guessed."""
    entries = [scan_entry(T0_NS + k * S // 10, frame="hokuyo") for k in range(3)]
    entries += [tf_entry(T0_NS + S // 10, ("odom", "base_link", (0, 0, 0), LEVEL))]
    with pytest.raises(InputError, match=r"/scan: .*'hokuyo'.*--calibration FILE"):
        recording(bag(tmp_path, *entries))


def test_a_filtered_copy_of_a_scan_is_no_second_lidar(tmp_path: Path) -> None:
    entries: list[Entry] = [
        static(("base_link", "laser", (0, 0, 0), LEVEL), ("base_link", "rear", (-1, 0, 0), BACK))
    ]
    for k in range(5):
        entries.append(scan_entry(T0_NS + k * S // 10))
        entries.append(scan_entry(T0_NS + k * S // 10, topic="/scan_filtered"))
        entries.append(scan_entry(T0_NS + k * S // 10, topic="/rear_scan", frame="rear"))
    path = bag(tmp_path, *entries)
    found = recording(path)
    assert list(found.calibration.lidars) == ["/rear_scan", "/scan"]
    assert found.notes["/scan_filtered left out: it repeats the scans of /scan"] == 5
    chosen = recording(path, lidars=("/scan_filtered",))
    assert list(chosen.calibration.lidars) == ["/scan_filtered"]


def test_no_lidar_lists_what_there_is(tmp_path: Path) -> None:
    path = bag(
        tmp_path,
        string_entry(T0_NS),
        pose_entry(T0_NS, 0, 0, 0),
        Entry("/points", "sensor_msgs/msg/PointCloud2", T0_NS, b""),
    )
    with pytest.raises(InputError) as caught:
        recording(path)
    for expected in ("/points (sensor_msgs/msg/PointCloud2)", "/chatter", str(path)):
        assert expected in str(caught.value)


def test_a_lidar_that_is_not_there_lists_the_lidars(tmp_path: Path) -> None:
    path = bag(tmp_path, scan_entry(T0_NS, topic="/front"), string_entry(T0_NS))
    with pytest.raises(InputError, match=r"topic /back: no such topic.*`--lidar` can be: /front"):
        recording(path, lidars=("/back",))
    with pytest.raises(InputError, match="type std_msgs/msg/String"):
        recording(path, lidars=("/chatter",))


def test_scans_none_of_which_can_be_decoded(tmp_path: Path) -> None:
    path = bag(tmp_path, Entry("/scan", "sensor_msgs/msg/LaserScan", T0_NS, b"\x00"))
    with pytest.raises(InputError, match="no scan of /scan can be decoded"):
        recording(path)
