"""Trouble on simulated drives: the truth goes with the base, the odometry knows nothing of it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from datasets.errors import InputError
from datasets.messages import Array, LaserScan, Odometry
from datasets.se2 import inverse
from datasets.simulation.driver_messages import TRUTH, DriverPose, DriverTurn
from datasets.simulation.place import DriveSpec, Place, load_drive, load_place
from datasets.simulation.place_file import (
    CarriedSection,
    DoorClosedSection,
    LidarSilentSection,
    OdometryResetSection,
    TroubleSection,
    TurnedSection,
)
from datasets.simulation.robot import ROBOTS, Robot
from datasets.simulation.simulated_drive import START_NS, SimulatedDrive
from datasets.simulation.trouble import KINDS, HandledDrive, TroubleKind, drawn_trouble, time_at_s
from datasets.simulation.wheels import NO_WHEEL_ERRORS, GyroErrors

CAMPUS = load_place("campus")
SEEING = replace(ROBOTS["paper"], cameras={}, wheels=NO_WHEEL_ERRORS)
BLIND = replace(SEEING, lidars={})
STILL_GYRO = GyroErrors(noise_rad_s=0.0, bias_rad_s=0.0, bias_walk_rad_s=0.0)
WAY = DriveSpec(np.array([[0.0, 0.0], [6.0, 0.0]]), stand_s=1.0)
CARRIED = CarriedSection(
    kind="carried",
    at_m=3.0,
    to=(0.0, -6.0, 90.0),
    seconds=4.0,
    via_m=((0.0, 0.0),),
    then_m=((0.0, -3.0),),
)
TURNED = TurnedSection(kind="turned", at_m=3.0, by_deg=80.0, seconds=0.5)


def driven(*trouble: TroubleSection, robot: Robot = BLIND, spec: DriveSpec = WAY) -> SimulatedDrive:
    return SimulatedDrive(CAMPUS, replace(spec, trouble=trouble), robot, 1)


def odometry(drive: SimulatedDrive) -> tuple[Array, Array]:
    """Times (N,) s and T_odom_base (N, 3, 3)."""
    messages = [message for message in drive if isinstance(message, Odometry)]
    times_s = np.array([message.stamp_ns - START_NS for message in messages]) / 1e9
    return times_s, np.array([message.T_odom_base for message in messages])


def test_a_carried_base_is_where_it_was_set_down_and_its_wheels_know_nothing() -> None:
    drive = driven(CARRIED)
    assert isinstance(drive.drive, HandledDrive)
    (hand,) = drive.drive.handlings
    assert hand.end_s - hand.begin_s == 4.0
    begin, end, last = drive.drive.pose([hand.begin_s, hand.end_s, drive.drive.duration_s])
    np.testing.assert_allclose(begin, [3.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(end, [0.0, -6.0, math.pi / 2], atol=1e-9)
    np.testing.assert_allclose(last, [0.0, -3.0, math.pi / 2], atol=1e-9)

    times_s, seen = odometry(drive)
    held = seen[(times_s >= hand.begin_s) & (times_s <= hand.end_s)]
    assert len(held) > 190
    np.testing.assert_allclose(held, np.broadcast_to(held[0], held.shape), atol=1e-12)
    # Without errors the wheels see 3 m ahead, then 3 m more: the way that they rolled.
    np.testing.assert_allclose(held[0][:2, 2], [3.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(seen[-1][:2, 2], [6.0, 0.0], atol=1e-3)


def test_the_truth_never_jumps_and_goes_round_the_corner_in_the_hands() -> None:
    drive = driven(CARRIED)
    truth = [raw for raw in drive.driver_messages() if isinstance(raw, DriverPose)]
    poses = np.array([raw.xyyaw for raw in truth if raw.topic == TRUTH])
    # 9 m in 4 s, smoothly: at most 1.5 times the mean.
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 1.5 * 9.0 / 4.0 / 50.0 + 1e-9
    assert np.abs(np.diff(poses[:, 2])).max() < 1.5 * (math.pi / 2) / 4.0 / 50.0 + 1e-9
    assert np.minimum(np.abs(poses[:, 0]), np.abs(poses[:, 1])).max() < 1e-9
    np.testing.assert_array_equal(drive.ground_truth().matrices()[:, 0, 2], poses[:, 0])


def test_before_and_after_the_carrying_odometry_and_truth_move_alike() -> None:
    drive = driven(CARRIED)
    assert isinstance(drive.drive, HandledDrive)
    (hand,) = drive.drive.handlings
    times_s, seen = odometry(drive)
    true = drive.drive.pose(times_s)
    after = times_s >= hand.end_s
    went = inverse(seen[after][0]) @ seen[after][-1]
    ahead = np.hypot(*(true[after][-1, :2] - true[after][0, :2]))
    np.testing.assert_allclose(went[:2, 2], [ahead, 0.0], atol=1e-9)
    before = times_s <= hand.begin_s
    np.testing.assert_allclose(seen[before][:, 0, 2], true[before][:, 0], atol=1e-9)


def test_a_base_turned_by_hand_drives_back_to_its_path_and_only_a_gyro_feels_it() -> None:
    drive = driven(TURNED)
    assert isinstance(drive.drive, HandledDrive)
    (hand,) = drive.drive.handlings
    start, end = drive.drive.pose([hand.begin_s, hand.end_s])
    np.testing.assert_allclose(end - start, [0.0, 0.0, math.radians(80.0)], atol=1e-9)
    last = drive.drive.pose([drive.drive.duration_s])[0]
    np.testing.assert_allclose(last, [6.0, 0.0, 0.0], atol=1e-6)

    def yaw_seen(robot: Robot) -> float:
        times_s, seen = odometry(driven(TURNED, robot=robot))
        at = [int(np.searchsorted(times_s, t)) for t in (hand.begin_s, hand.end_s)]
        step = inverse(seen[at[0]]) @ seen[at[1]]
        return math.degrees(math.atan2(step[1, 0], step[0, 0]))

    assert yaw_seen(BLIND) == pytest.approx(0.0, abs=0.1)
    assert yaw_seen(replace(BLIND, gyro=STILL_GYRO)) == pytest.approx(80.0, abs=1.0)


def test_odometry_starts_at_zero_again_and_goes_on_from_there() -> None:
    times_s, seen = odometry(driven(OdometryResetSection(kind="odometry_reset", at_m=3.0)))
    plain_s, plain = odometry(driven())
    np.testing.assert_array_equal(times_s, plain_s)
    reset = int(np.searchsorted(times_s, time_at_s(driven().drive, 3.0, "here")))
    np.testing.assert_array_equal(seen[:reset], plain[:reset])
    np.testing.assert_allclose(seen[reset], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(seen[reset:], inverse(plain[reset]) @ plain[reset:], atol=1e-9)
    assert plain[reset][0, 2] == pytest.approx(3.0, abs=0.02)


def test_a_silent_lidar_gives_no_scan_in_its_time_and_the_same_ones_around_it() -> None:
    silent = driven(LidarSilentSection(kind="lidar_silent", at_m=1.0, seconds=5.0), robot=SEEING)
    begin_s = time_at_s(silent.drive, 1.0, "here")

    def scans(drive: SimulatedDrive) -> dict[float, DriverTurn]:
        turns = (raw for raw in drive.driver_messages() if isinstance(raw, DriverTurn))
        return {turn.turn.stamp_s: turn for turn in turns}

    left, plain = scans(silent), scans(driven(robot=SEEING))
    missing = sorted(set(plain) - set(left))
    assert 34 <= len(missing) <= 37
    for stamp_s in missing:
        assert begin_s - 0.15 < stamp_s < begin_s + 5.0
    assert not any(begin_s <= stamp_s <= begin_s + 5.0 for stamp_s in left)
    for stamp_s, turn in left.items():
        np.testing.assert_array_equal(turn.turn.ranges_m, plain[stamp_s].turn.ranges_m)
    assert max(left) > begin_s + 5.0


def hits_on_leaf(drive: SimulatedDrive, place: Place, door: str) -> tuple[Array, Array]:
    """Times (N,) s of scans, and how many of their points lie on the closed leaf, (N,)."""
    hinge, tip = place.doors[door].hinge, place.doors[door].tip
    along = (tip - hinge) / np.linalg.norm(tip - hinge)
    times_s, counts = [], []
    for scan in drive:
        if not isinstance(scan, LaserScan):
            continue
        time_s = (scan.stamp_ns - START_NS) / 1e9
        x_m, y_m, yaw = drive.drive.pose([time_s])[0]
        returned = np.isfinite(scan.ranges_m)
        bearings = scan.bearings_rad[returned] + yaw
        away = np.column_stack([np.cos(bearings), np.sin(bearings)])
        points = np.array([x_m, y_m]) + scan.ranges_m[returned, None] * away - hinge
        on = (points @ along > 0.1) & (points @ along < 0.8)
        on &= np.abs(points @ [-along[1], along[0]]) < 0.1
        times_s.append(time_s)
        counts.append(int(on.sum()))
    return np.array(times_s), np.array(counts)


@pytest.mark.parametrize("people", [True, False])
def test_a_door_stands_open_until_it_is_closed(people: bool) -> None:
    # At 5.2 m of corridor 1, block A's open door is at the robot's right hand.
    spec = DriveSpec(np.array([[5.2, 0.0], [6.2, 0.0]]), stand_s=2.0)
    event = DoorClosedSection(kind="door_closed", at_m=0.5, door="block A/leaf 0", seconds=0.5)
    drive = SimulatedDrive(CAMPUS, replace(spec, trouble=(event,)), SEEING, 1, people=people)
    closes_s = time_at_s(drive.drive, 0.5, "here")
    times_s, counts = hits_on_leaf(drive, CAMPUS, "block A/leaf 0")
    assert (counts[times_s < closes_s - 0.15] < 5).all()
    after = counts[times_s > closes_s + 0.5]
    assert len(after) > 5
    assert (after > 20).all()


def test_every_kind_is_drawn_from_the_seed_and_can_be_driven() -> None:
    spec = CAMPUS.drives["tour"]
    doors = {name: (door.hinge, door.tip) for name, door in CAMPUS.doors.items()}
    for kind in KINDS:
        drawn = [drawn_trouble(kind, spec.driven(), doors, seed, "here") for seed in (1, 1, 2)]
        assert drawn[0] == drawn[1] != drawn[2]
        for event in drawn[1:]:
            drive = SimulatedDrive(CAMPUS, replace(spec, trouble=(event,)), BLIND, 1)
            end = drive.drive.pose([drive.drive.duration_s])[0]
            assert np.hypot(end[0], end[1]) < 1e-6


@pytest.mark.parametrize("kind", ["carried", "turned"])
def test_a_drawn_handling_keeps_the_base_in_the_corridors(kind: TroubleKind) -> None:
    spec = CAMPUS.drives["tour"]
    event = drawn_trouble(kind, spec.driven(), {}, 2, "here")
    drive = SimulatedDrive(CAMPUS, replace(spec, trouble=(event,)), BLIND, 1).drive
    assert isinstance(drive, HandledDrive)
    (hand,) = drive.handlings
    poses = drive.pose(np.arange(hand.begin_s - 5.0, hand.end_s + 15.0, 0.5))
    assert CAMPUS.space.fault(poses[:, :2], closed=False, clearance_m=0.2) is None


def test_a_file_says_what_goes_wrong(tmp_path: Path) -> None:
    path = tmp_path / "drive.yaml"
    path.write_text(
        "way_points_m: [[0, 0], [6, 0]]\n"
        "trouble:\n"
        "  - {kind: turned, at_m: 3, by_deg: 80}\n"
        "  - {kind: door_closed, at_m: 4, door: block A/leaf 0}\n"
    )
    turned, closed = load_drive(path, CAMPUS).trouble
    assert turned == TurnedSection(kind="turned", at_m=3.0, by_deg=80.0)
    assert closed == DoorClosedSection(kind="door_closed", at_m=4.0, door="block A/leaf 0")


@pytest.mark.parametrize(
    ("event", "what"),
    [
        ("{kind: door_closed, at_m: 4, door: gate}", "no open door is called 'gate'"),
        ("{kind: carried, at_m: 4, to: [90, 0, 0]}", "outside the place"),
        ("{kind: stolen, at_m: 4}", "stolen"),
        ("{kind: turned, at_m: 0, by_deg: 9}", "greater than 0"),
    ],
)
def test_trouble_that_cannot_be_is_refused(tmp_path: Path, event: str, what: str) -> None:
    path = tmp_path / "drive.yaml"
    path.write_text(f"way_points_m: [[0, 0], [6, 0]]\ntrouble:\n  - {event}\n")
    with pytest.raises(InputError, match=what):
        load_drive(path, CAMPUS)


@pytest.mark.parametrize(
    "event", [TURNED, OdometryResetSection(kind="odometry_reset", at_m=3.0)], ids=lambda e: e.kind
)
def test_trouble_beyond_the_end_is_refused(event: TroubleSection) -> None:
    with pytest.raises(InputError, match="trouble at 60 m"):
        driven(event.model_copy(update={"at_m": 60.0}))


def test_a_base_set_down_behind_a_wall_is_refused() -> None:
    event = CarriedSection(kind="carried", at_m=3.0, to=(20.0, -7.0, 0.0))
    with pytest.raises(InputError, match="after the base was carried at 3 m, the way from"):
        driven(event)


def test_the_command_line_knows_the_kinds(tmp_path: Path) -> None:
    from slam.cli import app

    result = CliRunner().invoke(
        app, ["simulate", "campus", "-o", str(tmp_path / "a.mcap"), "--trouble", "stolen"]
    )
    assert result.exit_code != 0
    assert "no such trouble: stolen" in result.output + str(result.exception)
