"""Simulated drives as recordings: what comes out is what the sensors would give, in order."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterable
from dataclasses import replace
from itertools import islice, pairwise
from typing import get_args

import numpy as np
import pytest

from datasets.errors import InputError
from datasets.messages import Array, DepthImage, LaserScan, Message, Odometry
from datasets.se2 import inverse, wrap_rad, xyyaw
from datasets.simulation import odometry as odometry_module
from datasets.simulation.bag_writer import estimate
from datasets.simulation.depth_camera import DepthModel
from datasets.simulation.driver_messages import (
    ODOMETRY,
    TRUTH,
    DriverDepth,
    DriverPose,
    DriverTurn,
)
from datasets.simulation.lidar import G4
from datasets.simulation.place import DriveSpec, load_place
from datasets.simulation.place_file import RobotName
from datasets.simulation.robot import DEPTH, LOW_SCAN, ROBOTS, SCAN, SLIPPERY, Robot
from datasets.simulation.simulated_drive import START_NS, SimulatedDrive
from datasets.simulation.wheels import NO_WHEEL_ERRORS, GyroErrors

PAPER = ROBOTS["paper"]
BLIND = replace(PAPER, lidars={}, cameras={})
BEAM_ROOM, ROOM, OFFICE = (load_place(name) for name in ("beam-room", "room", "office"))
STAND = DriveSpec(np.array([[0.0, 0.0]]), stand_s=1.5)
CURVE = DriveSpec(np.array([[0.0, 0.0], [0.3, 0.0], [0.4, 0.3]]), stand_s=0.5)
LAP = DriveSpec(
    np.array([[-1.0, -1.0], [0.5, -1.0], [0.5, 1.5], [-1.0, 1.5]]), closed=True, stand_s=1.0
)


def content(message: Message) -> tuple[object, ...]:
    match message:
        case LaserScan():
            arrays = (message.ranges_m, message.bearings_rad, message.beam_offsets_s)
            return (message.stamp_ns, message.lidar, *(array.tobytes() for array in arrays))
        case DepthImage():
            return message.stamp_ns, message.camera, message.depth_m.tobytes()
        case Odometry():
            return message.stamp_ns, message.T_odom_base.tobytes()


def contents(messages: Iterable[Message]) -> list[tuple[object, ...]]:
    return [content(message) for message in messages]


def of(kind: type, messages: Iterable[Message]) -> list[tuple[object, ...]]:
    return contents(message for message in messages if isinstance(message, kind))


def odometry_of(robot: Robot, spec: DriveSpec, seed: int = 1) -> tuple[Array, Array]:
    """T_start_base by odometry and in truth, (N, 3, 3) each."""
    drive = SimulatedDrive(ROOM, spec, robot, seed)
    seen = np.array([message.T_odom_base for message in drive if isinstance(message, Odometry)])
    true = drive.ground_truth().matrices()
    return seen, inverse(true[0]) @ true


def test_a_seed_gives_the_same_messages_again_and_another_seed_others() -> None:
    drive = SimulatedDrive(BEAM_ROOM, CURVE, PAPER, 3)
    first = contents(drive)
    assert contents(drive) == first
    assert contents(SimulatedDrive(BEAM_ROOM, CURVE, PAPER, 3)) == first
    other = contents(SimulatedDrive(BEAM_ROOM, CURVE, PAPER, 4))
    # While the base stands, wheels say the same whatever the seed.
    assert not {c for c in other if len(c) > 2} & set(first)
    assert other[-1] != first[-1]


def test_messages_come_in_order_of_time_within_the_drive() -> None:
    drive = SimulatedDrive(BEAM_ROOM, CURVE, PAPER, 3)
    messages = list(drive)
    stamps_ns = [message.stamp_ns for message in messages]
    assert stamps_ns == sorted(stamps_ns)
    assert stamps_ns[0] == START_NS
    assert stamps_ns[-1] <= START_NS + drive.drive.duration_s * 1e9
    seconds = drive.drive.duration_s
    counts = [len(of(kind, messages)) for kind in (Odometry, LaserScan, DepthImage)]
    assert np.abs(counts - np.array([50.0, 7.0, 5.0]) * seconds).max() <= 2.0


def test_what_one_sensor_measures_does_not_depend_on_the_others() -> None:
    whole = list(SimulatedDrive(BEAM_ROOM, CURVE, PAPER, 3))
    two = replace(PAPER, lidars=ROBOTS["two-lidars"].lidars, cameras={}, wheels=None)
    alone = list(SimulatedDrive(BEAM_ROOM, CURVE, two, 3))
    assert of(LaserScan, whole) == [
        content(m) for m in alone if isinstance(m, LaserScan) and m.lidar == SCAN
    ]
    assert not of(Odometry, alone)
    low = [m for m in alone if isinstance(m, LaserScan) and m.lidar == LOW_SCAN]
    high = [m for m in alone if isinstance(m, LaserScan) and m.lidar == SCAN]
    assert low
    assert not {m.stamp_ns for m in low} & {m.stamp_ns for m in high}


def test_lidar_and_camera_see_what_stands_there() -> None:
    """The wall 2.06 m ahead over the low box, and the box itself, 1.013 m ahead of the base."""
    lidar = replace(PAPER, wheels=None)
    drive = SimulatedDrive(BEAM_ROOM, STAND, lidar, 1)
    messages = list(drive)
    scans = [message for message in messages if isinstance(message, LaserScan)]
    forward = np.array([scan.ranges_m[np.argmin(np.abs(scan.bearings_rad))] for scan in scans])
    left = np.array([s.ranges_m[np.argmin(np.abs(s.bearings_rad - np.pi / 2))] for s in scans])
    assert np.median(forward) == pytest.approx(2.06, abs=0.02)
    assert np.median(left) == pytest.approx(1.21, abs=0.03)  # to the right it is 0.77 m
    images = np.array([m.depth_m for m in messages if isinstance(m, DepthImage)])
    assert np.nanmedian(images[:, 235:245, 310:330]) == pytest.approx(1.013 - 0.15, abs=0.01)
    assert np.isnan(images).any()
    assert not (images <= 0.0).any()
    assert set(drive.calibration.cameras) == {DEPTH}
    intrinsics = drive.calibration.cameras[DEPTH].intrinsics
    assert intrinsics is not None
    assert (intrinsics.height_px, intrinsics.width_px) == images.shape[1:]


@pytest.mark.parametrize("name", ["tilted", "rolled", "offset"])
def test_mountings_are_where_the_calibration_says(name: str) -> None:
    """What a tilted camera sees of the floor lies on the floor, by its calibration."""
    still = DepthModel(mode="640x480", wave_px=0.0, subpixel_px=0.01)
    robot = replace(ROBOTS[name].seeing(still, 5.0), lidars={}, wheels=None)
    drive = SimulatedDrive(ROOM, STAND, robot, 1)
    image = next(m for m in drive if isinstance(m, DepthImage))
    camera = drive.calibration.cameras[DEPTH]
    assert camera.T_base_camera is not None
    assert camera.intrinsics is not None
    v, u = np.mgrid[470:480, 200:440]
    z = image.depth_m[470:480, 200:440].astype(np.float64)
    K = camera.intrinsics.K
    points = np.stack(
        [(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z, np.ones_like(z)]
    )
    height_m = (camera.T_base_camera @ points.reshape(4, -1))[2]
    assert np.isfinite(height_m).mean() > 0.9
    assert np.abs(np.nanmedian(height_m)) < 0.005


def test_robots_differ_from_the_papers_in_one_thing() -> None:
    heights_m = {name: robot.lidars[SCAN].T_base_lidar[2, 3] for name, robot in ROBOTS.items()}
    assert heights_m["low-lidar"] == 0.5  # under the boxes' 0.9 m, over the obstacles' 0.3 m
    assert {height for name, height in heights_m.items() if name != "low-lidar"} == {0.895}
    assert not ROBOTS["two-lidars"].cameras
    assert all(robot.cameras for name, robot in ROBOTS.items() if name != "two-lidars")
    assert [name for name, robot in ROBOTS.items() if robot.gyro is not None] == ["gyro"]
    assert set(ROBOTS) == set(get_args(RobotName))
    assert ROOM.drives["tour"].robot == "low-lidar"
    assert BEAM_ROOM.drives["stand"].robot == "paper"


def test_drivers_publish_a_turn_when_it_is_over() -> None:
    drive = SimulatedDrive(BEAM_ROOM, STAND, PAPER, 3)
    raws = list(drive.driver_messages())
    published_ns = [raw.published_ns for raw in raws]
    assert published_ns == sorted(published_ns)
    turns = [raw for raw in raws if isinstance(raw, DriverTurn)]
    assert {raw.published_ns - raw.stamp_ns > 120_000_000 for raw in turns} == {True}
    for before, after in pairwise(turns):  # one turn begins where the last ended
        assert abs(after.stamp_ns - before.published_ns) <= 1
    assert all(raw.turn.angle_increment_rad < 0.0 for raw in turns)
    assert {raw.depth_mm.dtype for raw in raws if isinstance(raw, DriverDepth)} == {np.dtype("u2")}
    read = [raw.as_read(drive.notes) for raw in raws if raw.topic != TRUTH]
    assert sorted(contents(read)) == sorted(contents(drive))


def test_truth_is_where_the_base_is() -> None:
    drive = SimulatedDrive(ROOM, CURVE, BLIND, 1)
    truth = drive.ground_truth()
    times_s = (truth.stamps_ns - START_NS) * 1e-9
    np.testing.assert_allclose(truth.xyyaw, drive.drive.pose(times_s), atol=1e-6)
    assert drive.drive.duration_s - times_s[-1] < 0.02
    published = [raw for raw in drive.driver_messages() if raw.topic == TRUTH]
    assert [raw.stamp_ns for raw in published] == truth.stamps_ns.tolist()


@pytest.mark.parametrize(
    "gyro", [None, GyroErrors(noise_rad_s=0, bias_rad_s=0.01, bias_walk_rad_s=0)]
)
def test_odometry_without_errors_is_the_truth(gyro: GyroErrors | None) -> None:
    """The bias of a gyro is learned while the base stands."""
    seen, true = odometry_of(replace(BLIND, wheels=NO_WHEEL_ERRORS, gyro=gyro), LAP)
    np.testing.assert_allclose(seen, true, atol=1e-9 if gyro is None else 2e-3)


def test_odometry_tells_speeds() -> None:
    drive = SimulatedDrive(ROOM, LAP, replace(BLIND, wheels=NO_WHEEL_ERRORS), 1)
    poses = [raw for raw in drive.driver_messages() if isinstance(raw, DriverPose)]
    odometry, truth = ([p for p in poses if p.topic == topic] for topic in (ODOMETRY, TRUTH))
    for seen, true in zip(odometry, truth, strict=True):
        assert seen.speed_m_s == pytest.approx(true.speed_m_s, abs=0.01)
        assert seen.turn_rate_rad_s == pytest.approx(true.turn_rate_rad_s, abs=0.02)
    assert max(p.speed_m_s for p in truth) > 0.3
    assert max(p.turn_rate_rad_s for p in truth) > 0.3


def test_a_gyro_keeps_the_heading_of_wheels_that_slip() -> None:
    off_rad = {}
    for gyro in (None, GyroErrors()):
        robot = replace(BLIND, wheels=SLIPPERY, gyro=gyro)
        ends = [odometry_of(robot, LAP, seed) for seed in range(5)]
        angles = [wrap_rad(xyyaw(inverse(true[-1]) @ seen[-1])[2]) for seen, true in ends]
        off_rad[gyro is not None] = float(np.sqrt(np.mean(np.square(angles))))
    assert off_rad[True] < 0.2 * off_rad[False]


def test_pieces_of_odometry_fit_together(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = replace(BLIND, gyro=GyroErrors())
    for each in (robot, BLIND):
        whole, _ = odometry_of(each, CURVE)
        with monkeypatch.context() as patch:
            patch.setattr(odometry_module, "PIECE", 48)
            parts, _ = odometry_of(each, CURVE)
        np.testing.assert_allclose(parts, whole, atol=1e-12)


def test_laps_are_driven_without_a_stop() -> None:
    once = SimulatedDrive(ROOM, LAP, BLIND, 1)
    thrice = SimulatedDrive(ROOM, LAP, BLIND, 1, laps=3)
    assert thrice.drive.length_m == pytest.approx(3 * once.drive.length_m, rel=0.03)
    np.testing.assert_allclose(
        thrice.ground_truth().xyyaw[-1, :2], once.ground_truth().xyyaw[-1, :2], atol=0.02
    )
    speeds = [
        raw.speed_m_s
        for raw in thrice.driver_messages()
        if isinstance(raw, DriverPose) and raw.topic == TRUTH
    ]
    moving = np.array(speeds) > 0.0
    assert np.count_nonzero(np.diff(moving.astype(int)) == 1) == 1


def test_people_can_be_left_out() -> None:
    lidar = replace(BLIND, lidars=PAPER.lidars)
    with_people = of(LaserScan, SimulatedDrive(OFFICE, STAND, lidar, 1))
    without = of(LaserScan, SimulatedDrive(OFFICE, STAND, lidar, 1, people=False))
    empty = of(LaserScan, SimulatedDrive(replace(OFFICE, movers=()), STAND, lidar, 1))
    assert without == empty
    assert with_people != without


def test_a_long_drive_is_made_while_it_is_read() -> None:
    day = replace(STAND, stand_s=86400.0)
    quick = replace(PAPER, lidars={SCAN: PAPER.lidars[SCAN]._replace(model=G4)}, cameras={})
    tracemalloc.start()
    try:
        messages = SimulatedDrive(BEAM_ROOM, day, quick, 1)
        assert len(list(islice(messages, 500))) == 500
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


def test_a_slow_camera_may_see_nothing_of_a_short_drive() -> None:
    counts = []
    for seed in range(12):
        slow = replace(PAPER.seeing(None, 0.2), lidars={}, wheels=None)
        drive = SimulatedDrive(BEAM_ROOM, STAND, slow, seed)
        images = list(drive)
        assert len(images) == drive.image_count(DEPTH)
        assert all(m.stamp_ns <= START_NS + drive.drive.duration_s * 1e9 for m in images)
        assert estimate(drive).size_bytes > 0
        counts.append(len(images))
    assert set(counts) == {0, 1}


def test_drives_from_which_nothing_can_come_are_refused() -> None:
    with pytest.raises(InputError, match="2 laps of a drive that is not closed"):
        SimulatedDrive(ROOM, CURVE, PAPER, 1, laps=2)
    with pytest.raises(InputError, match="0 laps"):
        SimulatedDrive(ROOM, LAP, PAPER, 1, laps=0)
    with pytest.raises(InputError, match=r"over after 0\.5 s.*stand_s"):
        SimulatedDrive(ROOM, replace(STAND, stand_s=0.5), PAPER, 1)
