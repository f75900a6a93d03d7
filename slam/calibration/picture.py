"""A calibration as a picture: walls as lidar and camera see them, before and after."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from fusion.calibration.estimate import CalibrationResult
from fusion.calibration.matches import upright_points
from fusion.calibration.views import View

Picture = npt.NDArray[np.uint8]

SHOWN_VIEWS = 4
REACH_M = 6.0
PANEL_PX = 460
# Blue, green, red, as OpenCV orders them.
LIDAR, CAMERA, BASE, INK = (150, 150, 150), (40, 40, 210), (200, 110, 20), (70, 70, 70)


def calibration_picture(result: CalibrationResult, floor_z_m: float) -> Picture:
    """(H, W, 3) from above, in the base frame, ahead being up; a column for each of some images.

    Grey: what the lidar saw around the time of an image. Red: what of the image stands upright, in
    the upper row by the mounting that was begun with, in the lower one by the result. The arrow is
    the base.
    """
    seen = _most_seeing(result, floor_z_m)
    rows = []
    for title, T_base_camera in (
        ("before", result.T_base_camera_guess),
        ("after", result.T_base_camera),
    ):
        panels = [_panel(view, T_base_camera, floor_z_m) for view in seen]
        rows.append(np.hstack(panels))
        _write(rows[-1], title, (12, 28))
    picture = np.vstack(rows)
    _scale_bar(picture)
    return picture


def _most_seeing(result: CalibrationResult, floor_z_m: float) -> list[View]:
    """Of even parts of the recording the view with the most that stands upright nearby."""
    views, T_base_camera = result.views, result.T_base_camera

    def near(index: int) -> int:
        points_base = upright_points(views[index].blocks, T_base_camera, floor_z_m)
        return int((np.hypot(*points_base.T) < REACH_M).sum())

    parts = np.array_split(np.arange(len(views)), min(SHOWN_VIEWS, len(views)))
    return [views[max(part.tolist(), key=near)] for part in parts]


def _panel(view: View, T_base_camera: Array, floor_z_m: float) -> Picture:
    import cv2  # noqa: PLC0415

    panel = np.full((PANEL_PX, PANEL_PX, 3), 255, np.uint8)
    cv2.rectangle(panel, (0, 0), (PANEL_PX - 1, PANEL_PX - 1), (225, 225, 225), 1)
    _dots(panel, view.points_base, LIDAR, 2)
    _dots(panel, upright_points(view.blocks, T_base_camera, floor_z_m), CAMERA, 1)
    tail, tip = (_pixel(np.array([[x, 0.0]]))[0].tolist() for x in (-0.2, 0.3))
    cv2.arrowedLine(panel, tail, tip, BASE, 2, cv2.LINE_AA, tipLength=0.4)
    return panel


def _pixel(points_base: Array) -> npt.NDArray[np.int64]:
    """(N, 2) column and row: the base stands low in the middle, ahead is up, left is left."""
    scale = PANEL_PX / (REACH_M + 1.5)
    columns = PANEL_PX / 2.0 - points_base[:, 1] * scale
    rows = PANEL_PX - (points_base[:, 0] + 1.5) * scale
    return np.rint(np.column_stack([columns, rows])).astype(np.int64)


def _dots(panel: Picture, points_base: Array, colour: tuple[int, int, int], radius_px: int) -> None:
    import cv2  # noqa: PLC0415

    for column, row in _pixel(points_base).tolist():
        if 0 <= column < PANEL_PX and 0 <= row < PANEL_PX:
            cv2.circle(panel, (column, row), radius_px, colour, -1, cv2.LINE_AA)


def _write(picture: Picture, text: str, at: tuple[int, int]) -> None:
    import cv2  # noqa: PLC0415

    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.7, INK, 2, cv2.LINE_AA)


def _scale_bar(picture: Picture) -> None:
    import cv2  # noqa: PLC0415

    height, length = picture.shape[0], round(PANEL_PX / (REACH_M + 1.5))
    cv2.line(picture, (12, height - 14), (12 + length, height - 14), INK, 2)
    _write(picture, "1 m", (20 + length, height - 8))
