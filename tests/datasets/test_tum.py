"""TUM files: round trips by our reader and by evo's, and errors that name the line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from datasets.errors import InputError
from datasets.trajectory import Trajectory
from datasets.tum import format_stamp, parse_stamp_ns, read_tum, write_tum

EPOCH_NS = 1_686_652_417_123_456_789
STAMPS_NS = st.integers(min_value=-(2**63) + 1, max_value=2**63 - 1)


@given(STAMPS_NS)
def test_a_stamp_goes_through_text_unchanged(stamp_ns: int) -> None:
    assert parse_stamp_ns(format_stamp(stamp_ns)) == stamp_ns


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("976052905.167303", 976_052_905_167_303_000),
        ("1686652417.123456789", EPOCH_NS),
        ("1.686652417123456789e+09", EPOCH_NS),
        ("12", 12_000_000_000),
        ("-0.000000001", -1),
        (".5", 500_000_000),
        ("0.00000000149", 1),
    ],
)
def test_stamps_are_read_exactly(text: str, stamp_ns: int) -> None:
    assert parse_stamp_ns(text) == stamp_ns


@pytest.mark.parametrize("text", ["", "nan", "inf", "12:30", "1e400", "1e10", "0x10"])
def test_what_is_no_stamp_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="time in"):
        parse_stamp_ns(text)


COORDINATE = st.floats(-1e8, 1e8)
POSES = st.lists(st.tuples(COORDINATE, COORDINATE, st.floats(-7.0, 7.0)), min_size=1, max_size=5)


@given(POSES, st.integers(-EPOCH_NS, EPOCH_NS), st.integers(1, 10**12))
def test_a_trajectory_comes_back(
    tmp_path_factory: pytest.TempPathFactory,
    poses: list[tuple[float, float, float]],
    first_ns: int,
    step_ns: int,
) -> None:
    stamps_ns = first_ns + step_ns * np.arange(len(poses), dtype=np.int64)
    trajectory = Trajectory(stamps_ns, np.array(poses))
    path = tmp_path_factory.mktemp("tum") / "trajectory.tum"
    write_tum(path, trajectory)
    back = read_tum(path)
    np.testing.assert_array_equal(back.stamps_ns, stamps_ns)
    np.testing.assert_array_equal(back.xyyaw[:, :2], trajectory.xyyaw[:, :2])
    turn = back.xyyaw[:, 2] - trajectory.xyyaw[:, 2]
    np.testing.assert_allclose(np.sin(turn / 2), 0.0, atol=1e-14)
    first = path.read_bytes()
    write_tum(path, trajectory)
    assert path.read_bytes() == first
    assert [file.name for file in path.parent.iterdir()] == ["trajectory.tum"]


def test_evo_reads_what_we_write(tmp_path: Path) -> None:
    from evo.tools import file_interface

    trajectory = Trajectory(
        EPOCH_NS + np.array([0, 10**9], dtype=np.int64), np.array([[1.0, -2.0, 0.3], [4, 5, -3]])
    )
    write_tum(tmp_path / "t.tum", trajectory)
    theirs = file_interface.read_tum_trajectory_file(str(tmp_path / "t.tum"))
    for T_evo, T_ours in zip(theirs.poses_se3, trajectory.matrices(), strict=True):
        np.testing.assert_allclose(T_evo[:2, :2], T_ours[:2, :2], atol=1e-12)
        np.testing.assert_allclose(T_evo[:3, 3], [*T_ours[:2, 2], 0.0], atol=1e-12)
    np.testing.assert_allclose(theirs.timestamps, trajectory.stamps_ns * 1e-9, atol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 0.3, -2.0])
def test_the_heading_of_a_3d_pose_is_that_of_its_x_axis(tmp_path: Path, scale: float) -> None:
    rotation = Rotation.from_euler("ZYX", [2.5, 0.4, -0.7])
    quaternion = " ".join(repr(float(scale * q)) for q in rotation.as_quat())
    path = tmp_path / "t.tum"
    path.write_text(f"# a comment\n\n1.5 1 2 3 {quaternion}\n")
    x_axis = rotation.as_matrix()[:, 0]
    expected = [1.0, 2.0, math.atan2(x_axis[1], x_axis[0])]
    np.testing.assert_allclose(read_tum(path).xyyaw, [expected], atol=1e-12)


GOOD = "1.0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("", "t.tum:", "no pose"),
        ("# only a comment\n", "t.tum:", "no pose"),
        (GOOD + "2.0 0 0 0 0 0 1\n", "line 2", "7 values where 8"),
        (GOOD + "\n2.0 0 x 0 0 0 0 1\n", "line 3", "could not convert"),
        (GOOD + "2.0 nan 0 0 0 0 0 1\n", "line 2", "not finite"),
        (GOOD + "2.0 0 0 0 0 0 0 0\n", "line 2", "quaternion"),
        (GOOD + "1.0 0 0 0 0 0 0 1\n", "line 2", "does not come after"),
        (GOOD + "soon 0 0 0 0 0 0 1\n", "line 2", "'soon'"),
    ],
)
def test_errors_name_the_line(tmp_path: Path, text: str, where: str, what: str) -> None:
    path = tmp_path / "t.tum"
    path.write_text(text)
    with pytest.raises(InputError, match=what) as caught:
        read_tum(path)
    assert where in str(caught.value)


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        read_tum(tmp_path / "absent.tum")
    with pytest.raises(InputError, match="cannot read"):
        read_tum(tmp_path)
    (tmp_path / "t.bag").write_bytes(b"#ROSBAG V2.0\n\xff\xfe\x80")
    with pytest.raises(InputError, match="no text file"):
        read_tum(tmp_path / "t.bag")


@pytest.mark.parametrize("text", ["1e999980", "-1e999980", "1e31", "9" * 40, "nan", "inf", "1e-9x"])
def test_a_stamp_that_is_no_time_is_refused_at_once(text: str) -> None:
    with pytest.raises(ValueError, match="time in"):
        parse_stamp_ns(text)


@pytest.mark.parametrize("text", ["1e-999980", "0e999999", "0"])
def test_a_stamp_that_is_next_to_nothing_is_zero(text: str) -> None:
    assert parse_stamp_ns(text) == 0


def test_a_pose_beyond_the_earth_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "far.tum"
    path.write_text("1 0 0 0 0 0 0 1\n2 4e9 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"line 2: a value is larger than 1e\+08"):
        read_tum(path)
