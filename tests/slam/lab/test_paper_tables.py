"""The measures on the paper's own rows, and where its print does not add up."""

from __future__ import annotations

import numpy as np
import pytest

from slam.lab.drives.beam_errors import BEAMS_DEG, beam_errors
from slam.lab.tables import paper_tables as paper


def test_the_camera_errors_are_those_of_the_printed_places() -> None:
    camera_m, _ = paper.map_point_errors_m()
    printed = [row.camera_error_m for row in paper.MAP_POINTS]
    np.testing.assert_allclose(camera_m, printed, atol=0.0006)
    assert camera_m.mean() == pytest.approx(paper.MAP_POINT_MEAN_CAMERA_M, abs=0.0006)


def test_the_fused_errors_are_too_but_for_b() -> None:
    _, fused_m = paper.map_point_errors_m()
    printed = np.array([row.fused_error_m for row in paper.MAP_POINTS])
    assert np.flatnonzero(np.abs(fused_m - printed) > 0.001).tolist() == [1]
    assert fused_m[1] == pytest.approx(0.144, abs=0.0006)
    assert printed.mean() == pytest.approx(paper.MAP_POINT_MEAN_FUSED_M, abs=0.0006)
    assert fused_m.mean() == pytest.approx(0.135, abs=0.0006)


def test_the_beams_give_other_means_than_are_printed() -> None:
    actual = np.array([row.actual_m for row in paper.BEAMS])
    beams = np.array([row.beam_deg for row in paper.BEAMS])
    assert tuple(beams.tolist()) == BEAMS_DEG
    lidar = beam_errors(np.array([[row.lidar_m for row in paper.BEAMS]]), actual, beams)
    fused = beam_errors(np.array([[row.fused_m for row in paper.BEAMS]]), actual, beams)
    assert lidar.mae_m[0] == pytest.approx(0.1452, abs=5e-5)
    assert fused.mae_m[0] == pytest.approx(0.0511, abs=5e-5)
    assert fused.rmse_m[0] == pytest.approx(0.0530, abs=5e-5)
    assert lidar.rmse_m[0] == pytest.approx(paper.BEAM_RMSE_LIDAR_M, abs=2e-4)
    assert lidar.mae_m[0] - paper.BEAM_MAE_LIDAR_M == pytest.approx(0.001, abs=5e-5)
    # Beam 0 is printed with an error of -0.028 where its row gives -0.038: that is the difference.
    assert fused.mae_m[0] - 0.001 == pytest.approx(paper.BEAM_MAE_FUSED_M, abs=1e-4)
    squares = fused.rmse_m[0] ** 2 * 10 - 0.038**2 + 0.028**2
    assert np.sqrt(squares / 10) == pytest.approx(paper.BEAM_RMSE_FUSED_M, abs=5e-4)


def test_fusion_is_better_in_each_printed_corridor_and_scores_lie_in_order() -> None:
    assert all(row.lidar_percent < row.fused_percent < 100 for row in paper.RESTORATION)
    worst = [100 - row.fused_percent for row in paper.RESTORATION]
    assert (round(min(worst), 1), round(max(worst), 1)) == (2.3, 3.7)
    assert all(0 < row.minimum < row.mean < row.maximum < 1 for row in paper.MATCH_SCORES)
