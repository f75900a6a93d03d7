"""Where a depth camera stands on the robot, from walls that the lidar sees too, and the floor."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from datasets.calibration_file import T_BODY_OPTICAL
from datasets.errors import InputError
from datasets.messages import Array
from datasets.recording import Recording
from datasets.section import Section
from fusion.calibration.fit import Fit, fit, turned_onto_walls
from fusion.calibration.floor import Floor, find_floor
from fusion.calibration.views import View, ViewLimits, level_lidar, views

LEAST_VIEWS = 5
LEAST_WALLS = 3
"""Walls in images that must have met walls of the lidar; with fewer the two never see the same."""

TURNING_RAD_S = 0.1
"""A robot that turns no faster shows nothing of the clocks."""

CLOCK_S = 0.005
MIXED = 0.3
"""A value counts as not determined if so much of a loose direction lies along it."""

NAMES = ("x", "y", "z", "roll", "pitch", "yaw")


class CalibrationConfig(Section):
    """How the mounting of a camera is estimated."""

    floor_z_m: float = Field(
        0.0, ge=-5.0, le=5.0, description="height of the floor in the base frame"
    )
    with_clock: bool = Field(
        False, description="let the clock between camera and lidar take part in the fit"
    )
    views: ViewLimits = ViewLimits()


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """The mounting of one camera.

    T_base_camera : (4, 4) of the optical frame; T_base_camera_guess : what it began with.
    values, guess : (6,) of the camera's body (x ahead, z up): x, y, z m, roll, pitch, yaw rad.
    sigma         : (6,) standard deviations of ``values``, inf where not determined.
    clock_s, clock_sigma_s : the images are of so many seconds after their stamps; None if the
                    recording doesn't show it.
    views         : the images that took part; walls : how many walls were met in them.
    apart_m       : median distance of the camera's wall points from the lidar's walls.
    findings      : what is not determined, or odd, and what to do, in words.
    """

    camera: str
    T_base_camera: Array
    T_base_camera_guess: Array
    values: Array
    guess: Array
    sigma: Array
    clock_s: float | None
    clock_sigma_s: float | None
    views: tuple[View, ...]
    walls: int
    apart_m: float
    findings: tuple[str, ...]

    @property
    def determined(self) -> bool:
        """Whether all six values are."""
        return bool(np.isfinite(self.sigma).all())


def calibrate(
    recording: Recording,
    config: CalibrationConfig,
    notes: Counter[str],
    *,
    camera: str | None = None,
    T_base_camera_guess: Array | None = None,
) -> CalibrationResult:
    """Estimate the mounting of a camera.

    camera : its name, None for the only one.
    T_base_camera_guess : (4, 4) of the optical frame; wrong by up to 30 deg in pitch and roll,
                          30 deg in yaw, 0.2 m across, any height. None: the recording's, else
                          level and ahead at the place of the lidar.
    notes  : counts, in the words of the report, what could not be used.

    Raises InputError where no mounting can come from the recording.
    """
    camera, found = views(recording, camera, config.views, notes)
    if len(found) < LEAST_VIEWS:
        left_out = "; ".join(f"{note} ({count})" for note, count in sorted(notes.items()))
        raise InputError(
            f"only {len(found)} depth images can be used ({left_out or 'there are no more'})",
            where=f"{recording.name}, {camera}",
            remedy="Record 20 s with images and scans, in rooms with walls and a floor in view",
        )
    guess = T_base_camera_guess
    if guess is None:
        guess = recording.calibration.cameras[camera].T_base_camera
    if guess is None:
        guess = T_BODY_OPTICAL.copy()
        guess[:3, 3] = level_lidar(recording.calibration).T_base_lidar[:3, 3]
    findings: list[str] = []
    floor = find_floor([view.blocks for view in found], guess[2, :3])
    start = _onto_floor(guess, floor, config.floor_z_m)
    if guess[2, 3] <= config.floor_z_m:
        findings.append(_underground(guess, floor, config.floor_z_m, f"{recording.name}, {camera}"))
    noise, floor_seen = config.views.noise, floor is not None
    start = turned_onto_walls(found, start, config.floor_z_m, noise)
    best = fit(found, start, config.floor_z_m, noise, floor=floor_seen, clock=False)
    walls = _walls(best)
    if walls < LEAST_WALLS:
        raise InputError(
            "camera and lidar never see the same wall",
            where=f"{recording.name}, {camera}",
            remedy="Give the rough mounting with --guess; if the two look in different "
            "directions, there is nothing to compare",
        )
    clock = _clock(found, best, config, findings, floor=floor_seen)
    if clock is not None and config.with_clock:
        best = clock
    findings += _loose_words(best, floor_seen=floor_seen)
    return _result(camera, found, guess, best, clock, tuple(findings))


def body_values(T_base_camera: Array) -> Array:
    """(6,): x, y, z m and roll, pitch, yaw rad of the camera's body, as calibration files say."""
    R = T_base_camera[:3, :3] @ T_BODY_OPTICAL[:3, :3].T
    pitch = math.asin(min(1.0, max(-1.0, -R[2, 0])))
    roll, yaw = math.atan2(R[2, 1], R[2, 2]), math.atan2(R[1, 0], R[0, 0])
    return np.array([*T_base_camera[:3, 3], roll, pitch, yaw])


def _onto_floor(T_base_camera: Array, floor: Floor | None, floor_z_m: float) -> Array:
    """The mounting raised and tilted, the shorter way, so that its floor is the floor."""
    if floor is None:
        return T_base_camera
    import cv2  # noqa: PLC0415

    up = T_base_camera[:3, :3] @ floor.up_camera
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    turn = axis / max(sine, 1e-12) * math.atan2(sine, up[2])
    T = T_base_camera.copy()
    T[:3, :3] = cv2.Rodrigues(turn)[0] @ T[:3, :3]
    T[2, 3] = floor_z_m + floor.height_m
    return T


def _underground(guess: Array, floor: Floor | None, floor_z_m: float, where: str) -> str:
    below_m = floor_z_m - guess[2, 3]
    what = f"the mounting to begin with puts the camera {below_m:.2f} m below the floor"
    if floor is None:
        raise InputError(
            f"{what}, and no floor is seen that could say better",
            where=where,
            remedy="Give a height above the floor with --guess, or --floor-z",
        )
    return f"{what}; the floor in its images puts it {floor.height_m:.2f} m above"


def _walls(result: Fit) -> int:
    """Walls in images that were met, each counted in each image."""
    return len(np.unique(result.matches.groups[~result.matches.floor]))


def _clock(
    found: list[View], best: Fit, config: CalibrationConfig, findings: list[str], *, floor: bool
) -> Fit | None:
    """The fit with the camera's clock as an unknown, if the recording shows it."""
    turning = [abs(float(view.velocity_base[2])) for view in found]
    if not np.nanmax([0.0, *turning]) > TURNING_RAD_S:
        return None
    noise = config.views.noise
    fitted = fit(found, best.T_base_camera, config.floor_z_m, noise, floor=floor, clock=True)
    if len(fitted.loose) and np.abs(fitted.loose[:, 6]).max() > MIXED:
        return None
    sigma_s = math.sqrt(fitted.covariance[6, 6])
    if abs(fitted.clock_s) > max(CLOCK_S, 3.0 * sigma_s):
        side = "after" if fitted.clock_s > 0.0 else "before"
        findings.append(
            f"the images seem to be of {abs(fitted.clock_s) * 1e3:.0f} +- {sigma_s * 1e3:.0f} ms "
            f"{side} their stamps, by the clock of the scans"
            + ("" if config.with_clock else "; --with-clock takes that out of the mounting")
        )
    return fitted


def _loose_words(best: Fit, *, floor_seen: bool) -> list[str]:
    """What is not determined, and what to do about it."""
    words = []
    if not floor_seen:
        words.append(
            "no floor was found in the images, so the height keeps the value it began with: let "
            "the camera see 1 m of bare floor, or measure the height and give it with --guess"
        )
    for direction in best.loose:
        largest = int(np.argmax(np.abs(direction)))
        if largest in (0, 1):
            along = math.degrees(math.atan2(direction[1], direction[0])) % 180.0
            along -= 180.0 if along > 90.0 else 0.0
            words.append(
                f"the place along the line {along:.0f} deg from straight ahead is not determined "
                "and keeps the value it began with: drive past a corner, or towards a wall"
            )
        elif largest == 5:
            words.append(
                "yaw is not determined and keeps the value it began with: drive where both "
                "sensors have walls in view, in more than one direction"
            )
        elif largest in (3, 4):
            words.append(
                f"{NAMES[largest]} is not determined and keeps the value it began with: let the "
                "camera see bare floor, or walls higher than the lidar"
            )
    return words


def _result(
    camera: str,
    found: list[View],
    guess: Array,
    best: Fit,
    clock: Fit | None,
    findings: tuple[str, ...],
) -> CalibrationResult:
    values, began = body_values(best.T_base_camera), body_values(guess)
    jacobian = _turn_to_angles(values)
    spread = jacobian @ best.covariance[:6, :6] @ jacobian.T
    sigma = np.sqrt(np.diag(spread))
    if len(best.loose):
        mixed = np.abs(best.loose[:, :6]).max(axis=0) > MIXED
        # A turn about the base's axes that is loose leaves the angles it would change loose.
        sigma[:3][mixed[:3]] = math.inf
        sigma[3:][(np.abs(jacobian[3:, 3:]) @ mixed[3:]) > MIXED] = math.inf
    walls = ~best.matches.floor & (best.system.weights > 0.0)
    apart = np.abs(best.system.distances_m[walls])
    return CalibrationResult(
        camera=camera,
        T_base_camera=best.T_base_camera,
        T_base_camera_guess=guess,
        values=values,
        guess=began,
        sigma=sigma,
        clock_s=None if clock is None else clock.clock_s,
        clock_sigma_s=None if clock is None else math.sqrt(clock.covariance[6, 6]),
        views=tuple(found),
        walls=_walls(best),
        apart_m=float(np.median(apart)) if apart.size else math.nan,
        findings=findings,
    )


def _turn_to_angles(values: Array) -> Array:
    """(6, 6): place and a small turn about the base's axes to place and roll, pitch, yaw."""
    pitch, yaw = values[4], values[5]
    c, s = math.cos(yaw), math.sin(yaw)
    out = np.eye(6)
    # Columns are the axes that roll, pitch and yaw turn about, in the base.
    axes = np.array(
        [
            [c * math.cos(pitch), -s, 0.0],
            [s * math.cos(pitch), c, 0.0],
            [-math.sin(pitch), 0.0, 1.0],
        ]
    )
    out[3:, 3:] = np.linalg.pinv(axes)
    return out
