"""``slam calibrate``: what it writes and what it says."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from datasets.calibration_file import T_BODY_OPTICAL, mounting, read_calibration_file
from datasets.errors import InputError
from datasets.messages import Array
from datasets.yaml_file import MarkedYaml
from fusion.calibration.estimate import NAMES, CalibrationResult

UNITS = ("m", "m", "m", "deg", "deg", "deg")
KEYS = tuple(f"{name}_{unit}" for name, unit in zip(NAMES, UNITS, strict=True))
DIGITS = (4, 4, 4, 3, 3, 3)
SHOWN = np.array([1.0, 1.0, 1.0, *[180.0 / math.pi] * 3])
"""From m and rad to the units of tables and files."""

LARGEST_M = 100.0


def parse_guess(text: str) -> Array:
    """T_base_camera, (4, 4) optical, of "x,y,z,roll,pitch,yaw" in m and deg, body axes.

    Raises InputError.
    """
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    good = len(values) == len(NAMES) and all(map(math.isfinite, values))
    if not good or max(map(abs, values[:3])) > LARGEST_M or max(map(abs, values[3:])) > 360.0:
        raise InputError(
            f"{text!r} is no mounting",
            where="--guess",
            remedy="Six numbers: x,y,z,roll,pitch,yaw in m and degrees, such as 0.15,0,0.25,0,5,0",
        )
    x, y, z = values[:3]
    roll, pitch, yaw = map(math.radians, values[3:])
    guess: Array = mounting((x, y, z), (roll, pitch, yaw)) @ T_BODY_OPTICAL
    return guess


def calibration_yaml(result: CalibrationResult, before: Path | None, *, with_clock: bool) -> str:
    """The calibration file with this camera's mounting, and all else of the one before.

    before     : a calibration file that was given, or None. Its comments are lost.
    with_clock : the clock took part in the fit, and is written as well.
    """
    read_calibration_file(before)  # says in words what is wrong with it
    content: dict[str, Any] = {}
    if before is not None:
        content = MarkedYaml.read(before, "the calibration file", "", "").content or {}
    camera = content.setdefault("cameras", {}).setdefault(result.camera, {})
    shown = [round(float(v), d) + 0.0 for v, d in zip(result.values * SHOWN, DIGITS, strict=True)]
    camera["mounting"] = dict(zip(KEYS, shown, strict=True))
    if with_clock and result.clock_s is not None:
        earlier_s = float(camera.get("clock_offset_s", 0.0))
        camera["clock_offset_s"] = round(earlier_s + result.clock_s, 4)
    sure = ", ".join(_sigma_words(result))
    lines = [f"# {result.camera}: by slam calibrate, {len(result.views)} images, one sigma: {sure}"]
    lines += [f"# {finding}" for finding in result.findings]
    return "\n".join(lines) + "\n" + yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def print_result(result: CalibrationResult, notes: Counter[str], console: Console) -> None:
    """A table of the six values, and below what is to be said about them."""
    table = Table(title=f"mounting of {result.camera}", title_justify="left")
    for heading in ("", "value", "change", "sigma", ""):
        table.add_column(heading, justify="left" if not heading else "right", no_wrap=True)
    change = (result.values - result.guess) * SHOWN
    change[3:] = (change[3:] + 180.0) % 360.0 - 180.0
    for index, (name, unit) in enumerate(zip(NAMES, UNITS, strict=True)):
        sigma = result.sigma[index] * SHOWN[index]
        known = math.isfinite(sigma)
        digits = DIGITS[index] - 1
        table.add_row(
            name,
            f"{result.values[index] * SHOWN[index]:.{digits}f} {unit}",
            f"{change[index]:+.{digits}f} {unit}",
            f"{sigma:.{digits + 1}f} {unit}" if known else "-",
            "determined" if known else "not determined",
        )
    console.print(table)
    console.print(
        f"{len(result.views)} images, {result.walls} walls seen in them by camera and lidar, "
        f"their points {result.apart_m * 100:.1f} cm apart (median)"
    )
    if result.clock_s is not None and result.clock_sigma_s is not None:
        console.print(
            f"clock of the camera against the lidar's: {result.clock_s * 1e3:+.1f} "
            f"+- {result.clock_sigma_s * 1e3:.1f} ms"
        )
    for finding in result.findings:
        console.print(f"warning: {finding}")
    for note, count in sorted(notes.items()):
        console.print(f"note: {note} ({count})")


def _sigma_words(result: CalibrationResult) -> list[str]:
    words = []
    for name, unit, sigma, digits in zip(NAMES, UNITS, result.sigma * SHOWN, DIGITS, strict=True):
        known = math.isfinite(sigma)
        words.append(f"{name} {sigma:.{digits}f} {unit}" if known else f"{name} not determined")
    return words
