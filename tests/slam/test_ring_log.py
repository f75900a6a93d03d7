"""The ring's recording: repeatable, true to its own place, and not to be mapped by odometry."""

from __future__ import annotations

import gzip
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from datasets.carmen import CarmenRecording
from datasets.messages import Array, LaserScan, Odometry
from datasets.options import ReadOptions
from datasets.tum import read_tum
from tests.slam.ring_log import (
    BEAMS,
    LIDAR_AHEAD_M,
    NOISE_M,
    NOISE_PER_M,
    RANGE_MAX_M,
    WALLS_M,
    DemoFiles,
    beam_bearings_rad,
    cast,
    dead_reckoning,
    drive_the_way,
    wall_segments,
    write_demo_recording,
)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> DemoFiles:
    return write_demo_recording(tmp_path_factory.mktemp("demo"), seed=3)


def laser_lines(path: Path) -> list[list[str]]:
    with gzip.open(path, "rt", encoding="ascii") as log:
        return [line.split() for line in log if line.startswith("ROBOTLASER1 ")]


def march(x_m: float, y_m: float, direction_rad: float) -> float:
    """The same distance by another way: small steps until a wall lies between two of them."""
    walls = [(*a, *b) for line in WALLS_M for a, b in pairwise(line)]
    step_m = 0.002
    for k in range(round(RANGE_MAX_M / step_m)):
        x0, y0 = (
            x_m + k * step_m * math.cos(direction_rad),
            y_m + k * step_m * math.sin(direction_rad),
        )
        x1, y1 = (x0 + step_m * math.cos(direction_rad), y0 + step_m * math.sin(direction_rad))
        for ax, ay, bx, by in walls:
            sides = [
                (bx - ax) * (y0 - ay) - (by - ay) * (x0 - ax),
                (bx - ax) * (y1 - ay) - (by - ay) * (x1 - ax),
                (x1 - x0) * (ay - y0) - (y1 - y0) * (ax - x0),
                (x1 - x0) * (by - y0) - (y1 - y0) * (bx - x0),
            ]
            if sides[0] * sides[1] <= 0 and sides[2] * sides[3] <= 0:
                return (k + 0.5) * step_m
    return math.inf


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(
    demo: DemoFiles, tmp_path: Path
) -> None:
    again = write_demo_recording(tmp_path / "again", seed=3)
    other = write_demo_recording(tmp_path / "other", seed=4)
    assert again.recording.read_bytes() == demo.recording.read_bytes()
    assert again.ground_truth.read_bytes() == demo.ground_truth.read_bytes()
    assert other.recording.read_bytes() != demo.recording.read_bytes()
    assert sorted(path.name for path in again.recording.parent.iterdir()) == [
        "demo.log.gz",
        "demo_ground_truth.tum",
    ]
    assert demo.recording.stat().st_size < 3_000_000


def test_the_ground_truth_has_a_pose_for_every_scan_and_drives_one_loop(demo: DemoFiles) -> None:
    truth = read_tum(demo.ground_truth)
    lines = laser_lines(demo.recording)
    assert [round(float(words[-3]) * 1e3) for words in lines] == [
        round(stamp_ns / 1e6) for stamp_ns in truth.stamps_ns.tolist()
    ]
    steps_m = np.hypot(*np.diff(truth.xyyaw[:, :2], axis=0).T)
    assert 60.0 < steps_m.sum() < 90.0
    # It comes back to where it began, and further along its own tracks.
    apart_m = np.hypot(*(truth.xyyaw[len(truth) // 2 :, :2] - truth.xyyaw[0, :2]).T)
    assert apart_m.min() < 0.1
    assert apart_m[-1] > 5.0


def test_the_reader_gets_back_what_was_driven(demo: DemoFiles) -> None:
    recording = CarmenRecording([demo.recording], ReadOptions())
    messages = list(recording)
    scans = [message for message in messages if isinstance(message, LaserScan)]
    odometry = [message for message in messages if isinstance(message, Odometry)]
    truth = read_tum(demo.ground_truth)
    assert [scan.stamp_ns for scan in scans] == truth.stamps_ns.tolist()
    assert len(odometry) == pytest.approx(2 * len(scans), abs=1)
    no_returns = sum(int(np.count_nonzero(scan.ranges_m == np.inf)) for scan in scans)
    written = " ".join(" ".join(words) for words in laser_lines(demo.recording))
    # The head of each line holds the reach once more.
    assert no_returns == written.split().count(f"{RANGE_MAX_M:.3f}") - len(scans) > 0
    assert set(recording.notes) <= {"range at or beyond range_max taken as no return"}
    assert all(np.isfinite(scan.ranges_m[scan.ranges_m != np.inf]).all() for scan in scans)
    T_base_lidar = recording.calibration.lidars[scans[0].lidar].T_base_lidar
    expected = np.eye(4)
    expected[0, 3] = LIDAR_AHEAD_M
    np.testing.assert_allclose(T_base_lidar, expected, atol=2e-6)
    np.testing.assert_allclose(scans[0].bearings_rad, beam_bearings_rad(), atol=1e-6)
    driven = dead_reckoning(drive_the_way(), np.random.default_rng(3))
    np.testing.assert_allclose(odometry[-1].T_odom_base[:2, 2], driven[-1, :2], atol=0.1)


def test_the_base_drives_as_a_base_can_and_through_no_wall() -> None:
    drive = drive_the_way()
    dt_s = np.diff(drive.stamps_ns) * 1e-9
    moved = np.diff(drive.xyyaw, axis=0)
    speed = np.hypot(moved[:, 0], moved[:, 1]) / dt_s
    assert speed.max() < 0.81
    assert np.abs(moved[:, 2] / dt_s).max() < 0.71
    ticks = 20  # speeds are constant over a centimetre, so look at longer times than one tick
    assert (np.abs(speed[ticks:] - speed[:-ticks]) / (ticks * dt_s[0])).max() < 0.5
    # A differential drive goes where it looks.
    heading = np.arctan2(moved[:, 1], moved[:, 0])
    off = np.angle(np.exp(1j * (heading - drive.xyyaw[:-1, 2] - moved[:, 2] / 2)))
    assert np.abs(off).max() < 0.01
    around = np.linspace(-math.pi, math.pi, 72)
    clear_m = [cast(pose[:2], around, wall_segments()).min() for pose in drive.xyyaw[::50]]
    assert min(clear_m) > 0.35


def test_the_beams_measure_the_place_from_where_the_robot_was(demo: DemoFiles) -> None:
    truth = read_tum(demo.ground_truth)
    lines = laser_lines(demo.recording)
    random = np.random.default_rng(0)
    for scan, beam in zip(
        random.integers(0, len(lines), 12), random.integers(0, BEAMS, 12), strict=True
    ):
        words = lines[scan]
        start_rad, resolution_rad, count = float(words[2]), float(words[4]), int(words[8])
        assert count == BEAMS
        x, y, yaw = truth.xyyaw[scan].tolist()
        expected_m = march(
            x + LIDAR_AHEAD_M * math.cos(yaw),
            y + LIDAR_AHEAD_M * math.sin(yaw),
            yaw + start_rad + beam * resolution_rad,
        )
        measured_m = float(words[9 + beam])
        if math.isinf(expected_m):
            assert measured_m == RANGE_MAX_M
        else:
            assert measured_m == pytest.approx(
                expected_m, abs=5 * (NOISE_M + NOISE_PER_M * expected_m)
            )


def test_the_noise_of_the_beams_is_what_it_says(demo: DemoFiles) -> None:
    truth = read_tum(demo.ground_truth)
    errors = []
    for words, (x, y, yaw) in zip(
        laser_lines(demo.recording)[::10], truth.xyyaw[::10], strict=True
    ):
        measured_m = np.array([float(word) for word in words[9 : 9 + BEAMS]])
        bearings = float(words[2]) + np.arange(BEAMS) * float(words[4]) + yaw
        lidar = np.array([x + LIDAR_AHEAD_M * math.cos(yaw), y + LIDAR_AHEAD_M * math.sin(yaw)])
        true_m = cast(lidar, bearings, wall_segments())
        near = true_m < 0.9 * RANGE_MAX_M
        errors.append((measured_m - true_m)[near] / (NOISE_M + NOISE_PER_M * true_m[near]))
    normalised = np.concatenate(errors)
    # Beside corners a rounded start angle may take the other wall: the quartiles don't mind.
    low, high = np.quantile(normalised, [0.25, 0.75])
    assert high - low == pytest.approx(1.349, rel=0.05)
    assert abs(np.median(normalised)) < 0.05


@pytest.mark.parametrize("seed", range(6))
def test_the_raw_odometry_does_not_close_the_loop(seed: int) -> None:
    drive = drive_the_way()
    odometry = dead_reckoning(drive, np.random.default_rng(seed))
    from_start: Array = drive.xyyaw - drive.xyyaw[0]  # the drive begins along the x axis
    drift_m = np.hypot(*(odometry - from_start)[:, :2].T)
    assert drift_m.max() > 1.0
    # Yet step by step it is odometry one can use: after 5 m it is off by less than 0.5 m.
    after_5_m = np.searchsorted(np.cumsum(np.hypot(*np.diff(drive.xyyaw[:, :2], axis=0).T)), 5.0)
    assert drift_m[after_5_m] < 0.5


def test_the_place_is_asymmetric() -> None:
    """No quarter turn and no mirroring lays the walls on themselves."""
    walls = wall_segments().reshape(-1, 2, 2)
    corners = {tuple(corner) for corner in walls.reshape(-1, 2).tolist()}
    centre = walls.reshape(-1, 2).mean(axis=0)
    for mirror in (1.0, -1.0):
        for quarter in range(4):
            if mirror == 1.0 and quarter == 0:
                continue
            c, s = round(math.cos(quarter * math.pi / 2)), round(math.sin(quarter * math.pi / 2))
            turned = (walls.reshape(-1, 2) - centre) * [1.0, mirror] @ np.array([[c, s], [-s, c]])
            shifted = turned - turned.min(axis=0) + walls.reshape(-1, 2).min(axis=0)
            kept = sum(tuple(corner) in corners for corner in np.round(shifted, 6).tolist())
            assert kept < len(shifted) / 2
