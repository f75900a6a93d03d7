"""A view of a camera as the scan itself."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.camera_only import camera_scan
from fusion.pseudo_scan import PseudoScan
from fusion.scan import CAMERA


def test_what_is_hit_becomes_the_scan_and_nothing_else() -> None:
    pseudo = PseudoScan(
        7,
        "/depth",
        np.array([0.15, 0.0]),
        np.array([-0.5, 0.0, 0.5, 1.0]),
        np.array([1.0, np.inf, 2.0, np.nan]),
        np.array([0.01, np.nan, 0.02, np.nan]),
        0.3,
        np.array([1.0, 3.0, 2.0, 0.0]),
        np.zeros((5, 2), dtype=np.float32),
        0.5,
    )
    scan = camera_scan(pseudo)
    assert (scan.stamp_ns, scan.sensor, scan.beam_spacing_rad) == (7, "/depth", 0.5)
    assert scan.camera_range_m.tolist() == [1.0, 2.0]
    assert scan.variance_m2 == pytest.approx([1e-4, 4e-4])
    assert (scan.source == CAMERA).all()
    assert not scan.layer.any()
    assert np.isnan(scan.lidar_range_m).all()
    ends = [[0.15 + np.cos(0.5), -np.sin(0.5)], [0.15 + 2 * np.cos(0.5), 2 * np.sin(0.5)]]
    assert scan.points_base == pytest.approx(np.array(ends))
