"""``slam calibrate`` from the command line: file, table, picture, refusals."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets.calibration_file import read_calibration_file
from datasets.errors import InputError
from slam.calibration.calibrate import parse_guess
from tests.fusion.calibration.calibration_rooms import CAMERA, CORRIDOR, THREE, Room, body, straight
from tests.slam.conftest import Command

TRUE = (0.15, 0.02, 0.3, 0.0, 10.0, 0.0)
BEFORE = """\
lidars:
  /scan:
    mask_deg: [[-180, -150]]
cameras:
  /other: {clock_offset_s: 0.02}
odometry: /odom
"""


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Room:
    """What every recording's name opens."""
    room = Room(THREE, body(TRUE))
    monkeypatch.setattr("datasets.open_recording.open_recording", lambda *_: room)
    return room


def test_the_file_holds_the_mounting_and_what_was_there_before(
    slam: Command, room: Room, tmp_path: Path
) -> None:
    before, out, picture = tmp_path / "before.yaml", tmp_path / "out.yaml", tmp_path / "out.png"
    before.write_text(BEFORE)
    done = slam(
        *("calibrate", "drive.bag", "--guess", "0.1,0,0.4,2,8,3", "--calibration", before),
        *("-o", out, "--picture", picture),
    )
    assert done.code == 0, done.err
    assert "not determined" not in done.out
    read = read_calibration_file(out)
    mounting = read.cameras[CAMERA].T_base_camera
    assert mounting is not None
    np.testing.assert_allclose(mounting, body(TRUE), atol=0.003)
    assert read.lidars["/scan"].masks_rad
    assert read.odometry == "/odom"
    assert read.camera_clock_offsets_ns["/other"] == 20_000_000
    drawn = cv2.imread(str(picture))
    assert drawn is not None
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 10

    again = slam("calibrate", "drive.bag", "-o", out)
    assert again.code == 2
    assert "--force" in again.err
    assert slam("calibrate", "drive.bag", "-o", out, "--force").code == 0
    assert {path.name for path in tmp_path.iterdir()} == {"before.yaml", "out.yaml", "out.png"}


def test_what_is_not_determined_is_said_and_the_exit_code_is_1(
    slam: Command, room: Room, tmp_path: Path
) -> None:
    room.walls, room.pose = CORRIDOR, straight
    done = slam("calibrate", "drive.bag", "--guess", "0.2,0,0.4,0,8,3", "-o", tmp_path / "c.yaml")
    assert done.code == 1
    assert "not determined" in done.out
    assert "drive past a corner" in done.out
    assert "x not determined" in (tmp_path / "c.yaml").read_text()


def test_a_clock_is_written_only_when_asked(slam: Command, room: Room, tmp_path: Path) -> None:
    room.clock_s = 0.05
    out = tmp_path / "out.yaml"
    assert slam("calibrate", "drive.bag", "-o", out).code == 0
    assert "clock_offset_s" not in out.read_text()
    assert slam("calibrate", "drive.bag", "-o", out, "--force", "--with-clock").code == 0
    offset_ns = read_calibration_file(out).camera_clock_offsets_ns[CAMERA]
    assert offset_ns == pytest.approx(50_000_000, abs=5_000_000)


@pytest.mark.parametrize("words", ["", "1,2", "a,b,c,d,e,f", "0,0,nan,0,0,0", "0,0,0,0,0,0,0"])
def test_a_guess_that_is_none_is_refused(words: str) -> None:
    with pytest.raises(InputError, match="Six numbers"):
        parse_guess(words)


def test_a_guess_is_of_the_body() -> None:
    np.testing.assert_allclose(parse_guess("1, 2,3,10,20,30"), body((1, 2, 3, 10, 20, 30)))


def test_nothing_is_read_for_a_file_that_cannot_be_written(
    slam: Command, room: Room, tmp_path: Path
) -> None:
    done = slam("calibrate", "drive.bag", "-o", tmp_path / "nowhere" / "c.yaml")
    assert done.code == 2
    assert "folder that exists" in done.err
