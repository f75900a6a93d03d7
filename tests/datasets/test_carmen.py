"""CARMEN logs: every kind of line, lines gone wrong, and the two real logs."""

from __future__ import annotations

import gzip
import math
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.carmen import CarmenRecording
from datasets.carmen_lines import sick_bearings, sick_range_max_m
from datasets.errors import InputError
from datasets.messages import LaserScan, Message, Odometry
from datasets.options import ReadOptions
from datasets.se2 import xyyaw

SECOND = 1_000_000_000


def flaser(stamp: str, ranges: str = "1.5 2.5 81.83 4.5", pose: str = "1 2 0.5") -> str:
    return f"FLASER {len(ranges.split())} {ranges} 9 9 9 {pose} {stamp} host 0.1"


def odom(stamp: str, pose: str = "1 2 0.5") -> str:
    return f"ODOM {pose} 0.1 0.2 0 {stamp} host 0.1"


def robotlaser(stamp: str, *, word: str = "ROBOTLASER1", laser: str = "1.2 2 0.5") -> str:
    return (
        f"{word} 0 -1.5 3.0 1.0 5.6 0.01 0 4 1.5 5.6 0 2.5 2 7 8 {laser} 1 2 0.5 "
        f"0.1 0.2 0.3 0.4 0 {stamp} host 0.1"
    )


def rawlaser(stamp: str) -> str:
    return f"RAWLASER1 0 -1.5 3.0 1.0 5.6 0.01 0 4 1.5 5.6 0 2.5 0 {stamp} host 0.1"


def write(folder: Path, *lines: str, name: str = "a.log") -> Path:
    path = folder / name
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def read(path: Path, options: ReadOptions | None = None) -> tuple[list[Message], CarmenRecording]:
    recording = CarmenRecording([path], options or ReadOptions())
    return list(recording), recording


def scans(messages: list[Message]) -> list[LaserScan]:
    return [m for m in messages if isinstance(m, LaserScan)]


def test_a_laser_line_gives_odometry_and_then_the_scan_at_one_stamp(tmp_path: Path) -> None:
    path = write(tmp_path, flaser("976052857.337557"))
    (odometry, scan), recording = read(path)
    assert isinstance(odometry, Odometry)
    assert isinstance(scan, LaserScan)
    assert odometry.stamp_ns == scan.stamp_ns == 976_052_857_337_557_000
    assert xyyaw(odometry.T_odom_base) == pytest.approx((1, 2, 0.5))  # the raw one, not 9 9 9
    np.testing.assert_array_equal(scan.ranges_m, [1.5, 2.5, math.inf, 4.5])
    assert scan.lidar == "front"
    assert recording.name == "a"
    assert "front" in recording.calibration.lidars


def test_odom_lines_fill_the_time_between_scans(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        odom("1.0", "7 7 0"),
        flaser("1.0"),
        odom("1.0", "8 8 0"),
        odom("1.1", "1.1 2 0.5"),
        flaser("1.2"),
    )
    messages, recording = read(path)
    poses = [
        (m.stamp_ns / SECOND, m.T_odom_base[0, 2]) for m in messages if isinstance(m, Odometry)
    ]
    assert poses == [(1.0, 1.0), (1.1, 1.1), (1.2, 1.0)]
    assert not any("odometry" in note for note in recording.notes)


def test_stamps_are_exact_to_the_nanosecond(tmp_path: Path) -> None:
    path = write(tmp_path, odom("1700000000.123456789"), odom("1700000000.2"), odom("1700000001"))
    stamps = [m.stamp_ns for m in read(path)[0]]
    assert stamps == [1_700_000_000_123_456_789, 1_700_000_000_200_000_000, 1_700_000_001 * SECOND]


def test_robotlaser_lines_tell_angles_limits_and_mounting(tmp_path: Path) -> None:
    messages, recording = read(write(tmp_path, robotlaser("3.5")))
    (scan,) = scans(messages)
    np.testing.assert_allclose(scan.bearings_rad, [-1.5, -0.5, 0.5, 1.5])
    np.testing.assert_array_equal(scan.ranges_m, [1.5, math.inf, math.inf, 2.5])
    assert scan.range_max_m == 5.6
    assert scan.stamp_ns == 3_500_000_000
    T_base_lidar = recording.calibration.lidars["front"].T_base_lidar
    # The lidar stands 0.2 m along odom's x, which the base sees turned by -0.5 rad.
    expected = [0.2 * math.cos(0.5), -0.2 * math.sin(0.5), 0.0]
    np.testing.assert_allclose(T_base_lidar[:3, 3], expected)


def test_of_two_kinds_of_line_for_one_lidar_one_is_read(tmp_path: Path) -> None:
    lines = [rawlaser("1.0"), robotlaser("1.01"), rawlaser("2.0"), robotlaser("2.01")]
    messages, recording = read(write(tmp_path, *lines))
    assert [scan.stamp_ns for scan in scans(messages)] == [1_010_000_000, 2_010_000_000]
    assert not any("left out" in note for note in recording.notes)
    messages, _ = read(write(tmp_path, rawlaser("1.0"), rawlaser("2.0"), odom("1.5")))
    assert len(scans(messages)) == 2


def test_parameters_are_the_mountings(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "PARAM robot_frontlaser_offset -0.04 host 0",
        "PARAM robot_frontlaser_side_offset 0.1 0 host 0",
        "PARAM robot_rearlaser_offset -0.3 0 host 0",
        flaser("1.0"),
        flaser("1.0").replace("FLASER", "RLASER"),
    )
    _, recording = read(path)
    front = recording.calibration.lidars["front"].T_base_lidar
    rear = recording.calibration.lidars["rear"].T_base_lidar
    np.testing.assert_allclose(front @ [1, 0, 0, 1], [0.96, 0.1, 0, 1])
    np.testing.assert_allclose(rear @ [1, 0, 0, 1], [-1.3, 0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("bad", "note"),
    [
        (flaser("2.0").replace("FLASER 4", "FLASER 5"), "scan left out: wrong number of ranges"),
        (flaser("2.0").replace("2.5 ", ""), "scan left out: wrong number of ranges"),
        ("FLASER", "scan left out: wrong number of ranges"),
        ("FLASER 0 9 9 9 1 2 0.5 2.0 host 0.1", "scan left out: wrong number of ranges"),
        ("FLASER 99999999999999999999 1", "scan left out: wrong number of ranges"),
        (flaser("2.0", pose="nan 0 0"), "scan left out: pose is not finite"),
        (flaser("2.0", pose="inf 0 0"), "scan left out: pose is not finite"),
        (flaser("2.0", ranges="1.5 2,5 3 4"), "scan left out: a value is no number"),
        (flaser("noon"), "scan left out: stamp is no time"),
        (flaser("-2.0"), "scan left out: stamp is no time"),
        (flaser("nan"), "scan left out: stamp is no time"),
        (odom("2.0", "nan 0 0"), "odometry left out: pose is not finite"),
        (odom("2.0", "1 2"), "odometry left out: wrong number of values"),
        ("PARAM robot_frontlaser_offset left host 0", "parameter left out:"),
        ("\x00\x01\x02 garbage", "line left out: no CARMEN message"),
    ],
)
def test_a_bad_line_costs_itself(tmp_path: Path, bad: str, note: str) -> None:
    good = [flaser(f"1.{i}") for i in range(10)]
    messages, recording = read(write(tmp_path, *good[:5], bad, *good[5:]))
    assert len(scans(messages)) == 10
    assert len(messages) == 20
    assert [n for n in recording.notes if n.startswith(note)]


def test_a_stamp_a_day_ahead_costs_one_scan(tmp_path: Path) -> None:
    lines = [flaser(f"{1000 + i / 5:.1f}") for i in range(50)]
    lines[20] = flaser(f"{1004 + 86400}")
    messages, recording = read(write(tmp_path, *lines))
    assert len(scans(messages)) == 49
    assert messages[-1].stamp_ns == 1_009_800_000_000
    assert recording.notes["scan left out: stamp jumps ahead and back"] == 1


def test_gzipped_logs_are_known_by_content_and_read_up_to_damage(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    lines = [flaser(f"{i}.5", " ".join(f"{r:.2f}" for r in rng.random(20))) for i in range(400)]
    packed = gzip.compress("\n".join(lines).encode())
    whole, cut, broken = (tmp_path / name for name in ("w.clf", "c.log.gz", "b.log"))
    whole.write_bytes(packed)
    cut.write_bytes(packed[: len(packed) // 2])
    broken.write_bytes(packed[: len(packed) // 2] + bytes(100) + packed[len(packed) // 2 + 100 :])
    assert len(scans(read(whole)[0])) == 400
    for path in (cut, broken):
        messages, recording = read(path)
        assert 100 < len(scans(messages)) < 400
        assert recording.notes[f"{path.name} is cut off or damaged: read up to there"] == 1


def test_the_parts_of_a_split_log_may_come_in_any_order(tmp_path: Path) -> None:
    lines = [line for k in range(30) for line in (odom(f"{10 + k}.2"), flaser(f"{10 + k}.5"))]
    first = write(tmp_path, "# none", "ODOM 1 2", *lines[:20], name="b.log")
    second, third = (
        write(tmp_path, *part, name=name)
        for part, name in ((lines[20:40], "a.log"), (lines[40:], "c.log"))
    )
    comment = write(tmp_path, "# logged by hand", name="0.log")
    recording = CarmenRecording([third, comment, first, second], ReadOptions())
    stamps = [m.stamp_ns for m in recording if isinstance(m, LaserScan)]
    assert stamps == [k * SECOND + SECOND // 2 for k in range(10, 40)]
    assert not [note for note in recording.notes if "stamp" in note or "clock" in note]


def test_several_files_follow_each_other(tmp_path: Path) -> None:
    first = write(tmp_path, flaser("1.0"), flaser("2.0"), name="1.log")
    second = write(tmp_path, flaser("3.0"), name="2.log")
    recording = CarmenRecording([first, second], ReadOptions())
    assert [s.stamp_ns // SECOND for s in scans(list(recording))] == [1, 2, 3]
    assert [s.stamp_ns // SECOND for s in scans(list(recording))] == [1, 2, 3]  # again


def test_options_choose(tmp_path: Path) -> None:
    lines = [flaser(f"{i}.0") for i in range(1, 10)] + [odom("10.0")]
    path = write(tmp_path, *lines)
    part, _ = read(path, ReadOptions(start_s=2.0, duration_s=3.0))
    assert [scan.stamp_ns // SECOND for scan in scans(part)] == [3, 4, 5, 6]
    lidar_only, _ = read(path, ReadOptions(use_odometry=False))
    assert all(isinstance(m, LaserScan) for m in lidar_only)
    rear, _ = read(path, ReadOptions(lidars=("rear",)))
    assert not scans(rear)
    for options in (
        ReadOptions(lidars=("/scan",)),
        ReadOptions(odometry="/odom"),
        ReadOptions(ground_truth="/truth"),
    ):
        with pytest.raises(InputError, match="CARMEN log"):
            read(path, options)


def test_the_calibration_file_goes_before_the_log(tmp_path: Path) -> None:
    path = write(tmp_path, "PARAM robot_frontlaser_offset 5 host 0", flaser("1.0"))
    yaml = tmp_path / "c.yaml"
    yaml.write_text(
        "lidars: {front: {mounting: {x_m: 0.1}, mask_deg: [[-95, -80]], clock_offset_s: 0.25}}"
    )
    messages, recording = read(path, ReadOptions(calibration=yaml))
    (scan,) = scans(messages)
    assert scan.stamp_ns == 1_250_000_000
    assert np.isnan(scan.ranges_m[0])
    assert recording.calibration.lidars["front"].T_base_lidar[0, 3] == pytest.approx(0.1)
    yaml.write_text("lidars: {fornt: {}}")
    with pytest.raises(InputError, match="fornt"):
        read(path, ReadOptions(calibration=yaml))


def test_a_log_has_no_depth_camera(tmp_path: Path) -> None:
    path = write(tmp_path, flaser("1"), flaser("2"))
    for options in (ReadOptions(cameras=("/depth",)), ReadOptions(use_lidars=False)):
        with pytest.raises(InputError, match="a CARMEN log holds no depth camera"):
            read(path, options)
    yaml = tmp_path / "robot.yaml"
    yaml.write_text("cameras: {/depth: {mounting: {z_m: 0.3}}}\n")
    with pytest.raises(InputError, match=r"cameras./depth: there is no such camera"):
        read(path, ReadOptions(calibration=yaml))
    messages, recording = read(path, ReadOptions(calibration=yaml, use_cameras=False))
    assert len(scans(messages)) == 2
    assert not recording.calibration.cameras


@pytest.mark.parametrize(
    ("count", "first_deg", "last_deg"),
    [
        (180, -90, 89),
        (181, -90, 90),
        (360, -90, 89.5),
        (361, -90, 90),
        (541, -135, 135),
        (1, -90, -90),
    ],
)
def test_bearings_of_lines_that_do_not_tell_them(
    count: int, first_deg: float, last_deg: float
) -> None:
    bearings_deg = np.degrees(sick_bearings(count))
    assert bearings_deg[0] == pytest.approx(first_deg)
    assert bearings_deg[-1] == pytest.approx(last_deg)
    assert sick_bearings(count) is sick_bearings(count)


def test_no_return_begins_at_the_codes_of_the_sicks_mode() -> None:
    assert sick_range_max_m(81.91) == 81.8
    assert sick_range_max_m(8.191) == 8.18
    assert sick_range_max_m(7.0) == 81.8
    assert sick_range_max_m(0.0) == 81.8


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=12), st.data())
def test_any_damage_leaves_an_ordered_stream_or_an_input_error(
    changes: list[tuple[int, int]], data: st.DataObject
) -> None:
    text = "\n".join([odom("1.0"), flaser("1.1"), robotlaser("1.2"), odom("1.3"), rawlaser("2")])
    damaged = bytearray(text.encode())
    for place, value in changes:
        damaged[place % len(damaged)] = value
    del damaged[data.draw(st.integers(0, len(damaged))) :]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "damaged.log"
        path.write_bytes(damaged)
        try:
            messages, _ = read(path)
        except InputError:
            messages = []
    stamps = [message.stamp_ns for message in messages]
    assert stamps == sorted(stamps)


@pytest.mark.parametrize(
    ("name", "scan_count", "beams", "x_m"), [("intel", 2947, 180, 0.0), ("fr079", 4791, 360, -0.04)]
)
def test_the_real_logs(
    shared_data: Path, name: str, scan_count: int, beams: int, x_m: float
) -> None:
    messages, recording = read(shared_data / "recordings" / f"{name}.log.gz")
    found = scans(messages)
    assert len(found) == scan_count
    assert {scan.ranges_m.size for scan in found} == {beams}
    assert len({id(scan.bearings_rad) for scan in found}) == 1
    assert recording.calibration.lidars["front"].T_base_lidar[0, 3] == x_m
    stamps = [message.stamp_ns for message in messages]
    assert stamps == sorted(stamps)
    for before, message in pairwise(messages):
        if isinstance(message, LaserScan):
            assert isinstance(before, Odometry)
            assert before.stamp_ns == message.stamp_ns
    finite = np.concatenate([scan.ranges_m[np.isfinite(scan.ranges_m)] for scan in found])
    assert 0.0 < finite.min() < finite.max() < 81.8
    relations = np.loadtxt(shared_data / "recordings" / f"{name}.relations", usecols=(0, 1))
    at_scans = np.isin(
        np.round(relations * 1e6).astype(np.int64),
        np.array([scan.stamp_ns // 1000 for scan in found]),
    )
    assert at_scans.mean() > 0.2  # the relations are in the stamps that were read
    assert not any(note.startswith("scan") for note in recording.notes)


@pytest.mark.parametrize(
    ("line", "note"),
    [
        (
            "ROBOTLASER1 0 -1.57 3.14 1e307 20 0 0 3 1 2 3 0 0 0 0 0 0 0 0 0 0 0 0 2.0 h 2.0",
            "angles",
        ),
        ("ROBOTLASER1 0 -1e9 3.14 0.01 20 0 0 3 1 2 3 0 0 0 0 0 0 0 0 0 0 0 0 2.0 h 2.0", "angles"),
        ("ROBOTLASER1 0 -1.57 3.14 0.01 20 0 0 3 1 2 3 0 0 0 0 1e300 0 0 0 0 0 0 0 2 h 2", "pose"),
        ("FLASER 3 1 2 3 0 0 0 4e9 0 0 2.0 h 2.0", "pose"),
    ],
)
def test_numbers_out_of_range_cost_the_line(tmp_path: Path, line: str, note: str) -> None:
    good = [f"FLASER 3 1 2 3 0 0 0 0 0 0 {k}.0 h {k}.0" for k in (1, 3)]
    if line.startswith("ROBOT"):
        good = [
            f"ROBOTLASER1 0 -1.57 3.14 0.01 20 0 0 3 1 2 3 0 0 0 0 0 0 0 0 0 0 0 0 {k}.0 h {k}.0"
            for k in (1, 3)
        ]
    path = tmp_path / "a.log"
    path.write_text("\n".join([good[0], line, good[1]]) + "\n")
    recording = CarmenRecording([path], ReadOptions())
    scans = [message for message in recording if isinstance(message, LaserScan)]
    assert [scan.stamp_ns for scan in scans] == [10**9, 3 * 10**9]
    assert any("left out" in told and note in told for told in recording.notes)


def test_a_gzipped_bomb_is_read_as_far_as_it_may_unpack(tmp_path: Path) -> None:
    line = b"FLASER 3 1 2 3 0 0 0 0 0 0 %d.0 h 1.0\n"
    path = tmp_path / "bomb.log.gz"
    with gzip.open(path, "wb") as file:
        for k in range(1, 9):
            file.write(line % k)
        for _ in range(100):
            file.write(b"#" + b" " * (1 << 20) + b"\n")
    recording = CarmenRecording([path], ReadOptions())
    assert len([message for message in recording if isinstance(message, LaserScan)]) == 8
    assert any("unpack to far more" in note for note in recording.notes)
