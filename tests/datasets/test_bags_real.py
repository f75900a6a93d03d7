"""What the real bags hold, and that both lidars of each see the same walls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from datasets.bags import BagRecording, read_trajectory
from datasets.messages import Array, LaserScan, Message, Odometry
from datasets.options import ReadOptions

NAVIGATION, SECURITY = "/driver_laser_navigation/laser_scan", "/driver_laser_security/laser_scan"
FRONT, BACK = "/scan", "/hokuyo_back_scan"


def points_base(recording: BagRecording, scan: LaserScan) -> Array:
    seen = np.isfinite(scan.ranges_m)
    r, b = scan.ranges_m[seen], scan.bearings_rad[seen]
    points_lidar = np.column_stack([r * np.cos(b), r * np.sin(b), 0 * r, 0 * r + 1])
    T_base_lidar = recording.calibration.lidars[scan.lidar].T_base_lidar
    moved: Array = (points_lidar @ T_base_lidar.T)[:, :2]
    return moved


def of_lidar(messages: list[Message], lidar: str) -> list[LaserScan]:
    return [m for m in messages if isinstance(m, LaserScan) and m.lidar == lidar]


def share_on_the_same_walls(
    recording: BagRecording, one: LaserScan, other: LaserScan, within_m: float
) -> tuple[float, int]:
    """Of the points of one scan with a point of the other near: the share that is very near."""
    distance_m, _ = cKDTree(points_base(recording, one)).query(points_base(recording, other))
    near = distance_m < 0.5
    return float(np.mean(distance_m[near] < within_m)), int(near.sum())


@pytest.fixture(scope="module")
def guardian(shared_data: Path) -> tuple[BagRecording, list[Message]]:
    path = shared_data / "recordings" / "guardian_controller_2.bag"
    recording = BagRecording([path], ReadOptions())
    return recording, list(recording)


def test_guardian_has_two_lidars_back_to_back_and_odometry(
    guardian: tuple[BagRecording, list[Message]],
) -> None:
    recording, messages = guardian
    stamps = [message.stamp_ns for message in messages]
    assert stamps == sorted(stamps)
    assert len(of_lidar(messages, FRONT)) == 1028
    assert len(of_lidar(messages, BACK)) == 1031
    assert sum(isinstance(m, Odometry) for m in messages) == 2060
    assert recording.layout.base_frame == "base_footprint"
    front, back = (recording.calibration.lidars[name].T_base_lidar for name in (FRONT, BACK))
    # The chain to the front one passes a tilting joint that stands still, 0.8 mrad off level.
    assert front[:3, 3] == pytest.approx([0.4858, 0.0, 0.3720], abs=1e-3)
    assert front[:3, :3] == pytest.approx(np.eye(3), abs=1e-3)
    assert back[:3, 3] == pytest.approx([-0.4317, 0.0, 0.3606], abs=1e-3)
    assert back[:3, :3] == pytest.approx(np.diag([-1.0, -1.0, 1.0]), abs=1e-9)
    scan = of_lidar(messages, FRONT)[0]
    assert scan.beam_offsets_s[-1] == pytest.approx(680 * 9.765625e-5, rel=1e-6)
    assert not any("moves on the base" in note for note in recording.notes)
    assert recording.ground_truth() is None


def test_guardian_sees_the_same_walls_with_both_lidars(
    guardian: tuple[BagRecording, list[Message]],
) -> None:
    """They overlap at the sides only, and their tf is off by 1 deg against each other."""
    recording, messages = guardian
    front, back = of_lidar(messages, FRONT)[5], of_lidar(messages, BACK)[5]
    share, count = share_on_the_same_walls(recording, front, back, 0.1)
    assert count > 40
    assert share > 0.8


def test_jarvis_has_odometry_in_tf_and_ground_truth(shared_data: Path) -> None:
    path = shared_data / "recordings" / "jarvis_complex_path_fast.bag"
    recording = BagRecording([path], ReadOptions())
    messages = list(recording)
    stamps = [message.stamp_ns for message in messages]
    assert stamps == sorted(stamps)
    assert len(of_lidar(messages, NAVIGATION)) == 591
    assert len(of_lidar(messages, SECURITY)) == 619
    odometry = [m for m in messages if isinstance(m, Odometry)]
    assert len(odometry) == 1850
    mountings = recording.calibration.lidars
    assert mountings[NAVIGATION].T_base_lidar[:3, 3] == pytest.approx([0.194, 0.0, 2.0])
    assert mountings[SECURITY].T_base_lidar[:3, 3] == pytest.approx([0.895, 0.0, 0.1])
    assert of_lidar(messages, NAVIGATION)[0].beam_offsets_s[-1] == pytest.approx(0.125, rel=1e-3)
    assert of_lidar(messages, SECURITY)[0].beam_offsets_s.size == 0
    truth = recording.ground_truth()
    assert truth is not None
    assert len(truth) == 591
    np.testing.assert_array_equal(truth.xyyaw, read_trajectory(path, None).xyyaw)
    # Its odometry is very good: both go the same way.
    way_m = np.hypot(*np.diff(truth.xyyaw[:, :2], axis=0).T).sum()
    places = np.array([m.T_odom_base[:2, 2] for m in odometry])
    assert np.hypot(*np.diff(places, axis=0).T).sum() == pytest.approx(way_m, rel=0.1)


def test_jarvis_sees_the_same_walls_at_both_heights(shared_data: Path) -> None:
    path = shared_data / "recordings" / "jarvis_2_static.bag"
    recording = BagRecording([path], ReadOptions())
    messages = list(recording)
    high, low = of_lidar(messages, NAVIGATION)[5], of_lidar(messages, SECURITY)[5]
    share, count = share_on_the_same_walls(recording, high, low, 0.1)
    assert count > 200
    assert share > 0.7


def test_walking_a_real_bag_gives_the_same_as_its_index(shared_data: Path) -> None:
    path = shared_data / "recordings" / "jarvis_2_static.bag"
    part = {"start_s": 2.0, "duration_s": 5.0}
    indexed = list(BagRecording([path], ReadOptions(**part)))
    walked = list(BagRecording([path], ReadOptions(salvage=True, **part)))
    assert len(indexed) > 150
    assert [m.stamp_ns for m in walked] == [m.stamp_ns for m in indexed]
