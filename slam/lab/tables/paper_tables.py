"""The numbers that the paper prints in its tables 1 to 5, as they stand there.

Chi et al., Electronics 2023, 12(12), 2716. Where the print does not add up, both are here: what is
printed, and by way of the rows what comes out of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.messages import Array

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class MapPointRow:
    """Tables 1 and 2: a corner's true place and its place in both maps, m, with printed errors."""

    name: str
    true_m: Point
    camera_m: Point
    camera_error_m: float
    fused_m: Point
    fused_error_m: float


MAP_POINTS = (
    MapPointRow("A", (1.045, 0.746), (1.271, 0.830), 0.241, (1.182, 0.765), 0.138),
    MapPointRow("B", (5.755, -2.133), (5.891, -2.079), 0.146, (5.899, -2.129), 0.134),
    MapPointRow("C", (2.048, -5.954), (2.688, -6.247), 0.704, (2.160, -5.968), 0.113),
    MapPointRow("D", (-5.914, -3.256), (-4.153, -3.450), 1.772, (-5.774, -3.290), 0.144),
)
MAP_POINT_MEAN_CAMERA_M = 0.716
MAP_POINT_MEAN_FUSED_M = 0.132


@dataclass(frozen=True, slots=True)
class BeamRow:
    """Table 3: one beam of one scan, m."""

    beam_deg: float
    actual_m: float
    lidar_m: float
    fused_m: float


BEAMS = (
    BeamRow(0, 0.720, 0.684, 0.682),
    BeamRow(36, 0.781, 0.804, 0.805),
    BeamRow(72, 0.838, 0.789, 0.791),
    BeamRow(108, 0.776, 0.715, 0.718),
    BeamRow(144, 1.135, 1.086, 1.081),
    BeamRow(180, 1.013, 2.062, 0.932),
    BeamRow(216, 2.041, 1.997, 1.979),
    BeamRow(252, 1.303, 1.256, 1.252),
    BeamRow(288, 1.234, 1.188, 1.183),
    BeamRow(324, 0.862, 0.910, 0.907),
)
BEAM_MAE_LIDAR_M, BEAM_MAE_FUSED_M = 0.1442, 0.0501
BEAM_RMSE_LIDAR_M, BEAM_RMSE_FUSED_M = 0.3345, 0.0524


@dataclass(frozen=True, slots=True)
class RestorationRow:
    """Table 4: restoration degree of one corridor, percent."""

    name: str
    lidar_percent: float
    fused_percent: float


RESTORATION = (
    RestorationRow("corridor-1", 93.57, 97.68),
    RestorationRow("corridor-2", 95.56, 96.28),
    RestorationRow("corridor-3", 97.06, 97.32),
    RestorationRow("corridor-4", 96.78, 97.29),
)


@dataclass(frozen=True, slots=True)
class MatchScoreRow:
    """Table 5: scores of 8 constraints."""

    name: str
    minimum: float
    maximum: float
    mean: float


MATCH_SCORES = (
    MatchScoreRow("Lidar", 0.620, 0.791, 0.712),
    MatchScoreRow("Camera", 0.636, 0.799, 0.690),
    MatchScoreRow("Paper [16]", 0.651, 0.824, 0.729),
    MatchScoreRow("Paper [17]", 0.629, 0.775, 0.671),
    MatchScoreRow("Lidar + Camera", 0.719, 0.802, 0.763),
)
CONSTRAINTS_A_ROW = 8


def map_point_errors_m() -> tuple[Array, Array]:
    """(camera, fused) errors that the printed places of tables 1 and 2 give, (4,) each."""
    true = np.array([row.true_m for row in MAP_POINTS])
    camera = np.array([row.camera_m for row in MAP_POINTS]) - true
    fused = np.array([row.fused_m for row in MAP_POINTS]) - true
    return np.hypot(*camera.T), np.hypot(*fused.T)
