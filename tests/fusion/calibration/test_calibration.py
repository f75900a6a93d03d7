"""The mounting of a camera: recovered where it can be known, and said where it can't."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from datasets.errors import InputError
from datasets.messages import Float32s
from datasets.recording import CameraCalibration
from fusion.calibration.blocks import DepthNoise
from fusion.calibration.estimate import CalibrationConfig, CalibrationResult, calibrate
from fusion.calibration.views import ViewLimits
from tests.fusion.calibration.calibration_rooms import (
    CAMERA,
    CORRIDOR,
    LIDAR,
    THREE,
    Room,
    body,
    straight,
)

LEVEL = (0.15, 0.0, 0.3, 0.0, 0.0, 0.0)
TILTED = (0.12, -0.1, 0.6, 6.0, 15.0, -8.0)
OFF = (0.07, -0.06, 0.08, 3.0, -4.0, 5.0)
DEGREES = np.array([1.0, 1.0, 1.0, *[180.0 / math.pi] * 3])


def calibrated(
    room: Room, guess: tuple[float, ...] | None, config: CalibrationConfig | None = None
) -> CalibrationResult:
    T_guess = None if guess is None else body(guess)
    return calibrate(room, config or CalibrationConfig(), Counter(), T_base_camera_guess=T_guess)


def shifted(mounting: tuple[float, ...], by: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(a + b for a, b in zip(mounting, by, strict=True))


@pytest.mark.parametrize("true", [LEVEL, TILTED])
def test_three_walls_and_a_floor_give_the_mounting_exactly(true: tuple[float, ...]) -> None:
    # A camera said to be this good shows the fold between wall and floor as one.
    sharp = CalibrationConfig(views=ViewLimits(noise=DepthNoise(subpixel_px=0.01)))
    result = calibrated(Room(THREE, body(true)), shifted(true, OFF), sharp)
    errors = np.abs(result.values * DEGREES - true)
    assert (errors[:3] < 0.0005).all(), errors
    assert (errors[3:] < 0.01).all(), errors
    assert result.determined
    assert not result.findings
    np.testing.assert_allclose(result.guess * DEGREES, shifted(true, OFF), atol=1e-9)


def test_without_a_guess_it_begins_level_at_the_lidar() -> None:
    result = calibrated(Room(THREE, body(LEVEL)), None)
    np.testing.assert_allclose(result.guess, [0.05, 0.0, 0.9, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(result.values * DEGREES, LEVEL, atol=0.1)


def test_the_mounting_of_the_recording_is_the_guess() -> None:
    room = Room(THREE, body(TILTED))
    known = room.calibration.cameras[CAMERA]
    room.calibration.cameras[CAMERA] = replace(known, T_base_camera=body(LEVEL))
    np.testing.assert_allclose(calibrated(room, None).guess * DEGREES, LEVEL, atol=1e-9)


def test_a_base_above_the_floor() -> None:
    true = shifted(TILTED, (0.0, 0.0, -0.1, 0.0, 0.0, 0.0))
    result = calibrated(Room(THREE, body(TILTED)), TILTED, CalibrationConfig(floor_z_m=-0.1))
    np.testing.assert_allclose(result.values[:3], true[:3], atol=0.002)


def test_a_bare_corridor_leaves_the_way_along_it_at_the_guess() -> None:
    guess = shifted(LEVEL, OFF)
    result = calibrated(Room(CORRIDOR, body(LEVEL), straight), guess)
    assert math.isinf(result.sigma[0])
    assert np.isfinite(result.sigma[1:]).all()
    assert result.values[0] == pytest.approx(guess[0], abs=0.005)
    np.testing.assert_allclose(result.values[1:3], LEVEL[1:3], atol=0.003)
    np.testing.assert_allclose(result.values[3:] * DEGREES[3:], LEVEL[3:], atol=0.05)
    assert "0 deg from straight ahead" in result.findings[0]
    assert "drive past a corner" in result.findings[0]


def test_without_a_floor_the_height_stays_and_the_walls_give_the_tilt() -> None:
    guess = shifted(TILTED, (0.05, 0.05, 0.07, 1.0, -1.5, 3.0))
    result = calibrated(Room(THREE, body(TILTED), floor=False), guess)
    assert math.isinf(result.sigma[2])
    assert result.values[2] == pytest.approx(guess[2], abs=1e-3)
    assert np.isfinite(np.delete(result.sigma, 2)).all()
    assert (np.abs(result.values * DEGREES - TILTED)[3:] < 0.2).all()
    assert (np.abs(result.values - np.array(TILTED))[:2] < 0.01).all()
    assert "no floor" in result.findings[0]


def test_a_guess_below_the_floor_is_said_and_mended() -> None:
    guess = shifted(LEVEL, (0.0, 0.0, -0.8, 2.0, 2.0, 2.0))
    result = calibrated(Room(THREE, body(LEVEL)), guess)
    assert result.values[2] == pytest.approx(LEVEL[2], abs=0.002)
    assert "0.50 m below the floor" in result.findings[0]
    with pytest.raises(InputError, match="below the floor, and no floor is seen"):
        calibrated(Room(THREE, body(LEVEL), floor=False), guess)


@pytest.mark.parametrize("clock_s", [0.05, -0.04])
def test_the_clock_of_the_images_is_told_and_taken_out_when_asked(clock_s: float) -> None:
    room = Room(THREE, body(LEVEL), clock_s=clock_s)
    result = calibrated(room, LEVEL)
    assert result.clock_s == pytest.approx(clock_s, abs=0.004)
    assert ("after" if clock_s > 0.0 else "before") in result.findings[0]
    asked = calibrated(room, LEVEL, CalibrationConfig(with_clock=True))
    np.testing.assert_allclose(asked.values[:3], LEVEL[:3], atol=0.004)
    np.testing.assert_allclose(asked.values[3:] * DEGREES[3:], LEVEL[3:], atol=0.1)


def test_a_robot_that_never_turns_shows_nothing_of_the_clocks() -> None:
    assert (
        calibrated(Room(THREE, body(LEVEL), lambda time_s: (0.0, 0.0, 0.0)), LEVEL).clock_s is None
    )


def test_the_same_recording_gives_the_same_numbers() -> None:
    room = Room(THREE, body(TILTED))
    first, again = (calibrated(room, LEVEL) for _ in range(2))
    assert first.values.tobytes() == again.values.tobytes()
    assert first.sigma.tobytes() == again.sigma.tobytes()


def _holes(depth: Float32s) -> Float32s:
    return np.full_like(depth, np.nan)


def _noise(depth: Float32s) -> Float32s:
    random = np.random.default_rng(1)
    return random.uniform(-1.0, 10.0, depth.shape).astype(np.float32)


def _infinite(depth: Float32s) -> Float32s:
    return np.full_like(depth, np.inf)


def _small(depth: Float32s) -> Float32s:
    return np.ascontiguousarray(depth[:50, :60])


@pytest.mark.parametrize(
    ("spoil", "why"),
    [(_holes, "no surface"), (_noise, "no surface"), (_infinite, "no surface"), (_small, "size")],
)
def test_images_that_say_nothing_are_refused(
    spoil: Callable[[Float32s], Float32s], why: str
) -> None:
    with pytest.raises(InputError, match=rf"only 0 depth images can be used.*{why}.*\(19\)"):
        calibrated(Room(THREE, body(LEVEL), spoil=spoil), LEVEL)


def test_sensors_that_look_in_different_directions_are_refused() -> None:
    behind = np.linspace(np.pi - 0.5, np.pi + 0.5, 300)
    walls = (*THREE, ((-3.0, -2.0), (-3.0, 2.0)))
    with pytest.raises(InputError, match="never see the same wall"):
        calibrated(Room(walls, body(LEVEL), bearings=behind), LEVEL)


def test_what_the_recording_lacks_is_named() -> None:
    room = Room(THREE, body(LEVEL))
    with pytest.raises(InputError, match=f"no camera /other.*{CAMERA}"):
        calibrate(room, CalibrationConfig(), Counter(), camera="/other")
    room.calibration.cameras[CAMERA] = CameraCalibration(None, None)
    with pytest.raises(InputError, match="pinhole"):
        calibrated(room, LEVEL)
    room = Room(THREE, body(LEVEL))
    room.calibration.cameras["/second"] = room.calibration.cameras[CAMERA]
    with pytest.raises(InputError, match="several depth cameras"):
        calibrated(room, LEVEL)
    room = Room(THREE, body(LEVEL))
    upended = room.calibration.lidars[LIDAR]
    room.calibration.lidars[LIDAR] = replace(upended, T_base_lidar=body((0, 0, 1, 0, 0, 0)))
    with pytest.raises(InputError, match="no lidar that is mounted level"):
        calibrated(room, LEVEL)
