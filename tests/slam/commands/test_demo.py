"""The demo's recording: the same each time, and with something in it that the lidar misses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datasets.bags import BagRecording
from datasets.messages import DepthImage, LaserScan, Odometry
from datasets.options import ReadOptions
from slam.commands.demo_recording import write_demo_recording


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demo_recording(tmp_path_factory.mktemp("demo") / "made")


def test_it_has_what_a_robot_has_and_is_small(bag: Path) -> None:
    recording = BagRecording([bag], ReadOptions())
    kinds = {type(message) for message in recording}
    assert kinds == {LaserScan, DepthImage, Odometry}
    assert recording.ground_truth() is not None
    assert bag.stat().st_size < 40e6
    assert [path.name for path in bag.parent.iterdir()] == ["demo.mcap"]


def test_the_camera_sees_an_obstacle_that_the_lidar_looks_over(bag: Path) -> None:
    """The low box stands with its near left corner at (15.95, 0.35) in the place."""
    recording = BagRecording([bag], ReadOptions())
    truth = recording.ground_truth()
    assert truth is not None
    ahead_m = {LaserScan: np.empty(0), DepthImage: np.empty(0)}
    for message in recording:
        if isinstance(message, Odometry):
            continue
        x_m, y_m, yaw = truth.at(np.array([message.stamp_ns]))[0]
        if not 14.0 < x_m < 14.2:
            continue
        bearing = np.arctan2(0.5 - y_m, 15.95 - x_m) - yaw
        if isinstance(message, LaserScan):
            turned = np.angle(np.exp(1j * (message.bearings_rad - bearing)))
            ranges_m = message.ranges_m[np.abs(turned) < 0.02]
            ahead_m[LaserScan] = np.append(ahead_m[LaserScan], ranges_m)
        else:
            column = round(319.5 - 384.0 * np.tan(bearing))
            depth_m = message.depth_m[235:245, column - 8 : column + 8] + 0.15
            ahead_m[DepthImage] = np.append(ahead_m[DepthImage], depth_m)
    assert np.nanmedian(ahead_m[DepthImage]) == pytest.approx(1.85, abs=0.15)
    assert ahead_m[LaserScan].size > 10
    assert ahead_m[LaserScan].min() > 2.5
