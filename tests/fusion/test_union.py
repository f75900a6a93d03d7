"""The union of points without association."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.se2 import se2
from fusion.placed_points import PlacedView
from fusion.scan import CAMERA, LIDAR
from fusion.union import union
from tests.fusion.views import pseudo_of, sweep_of

STILL = np.zeros(3)


def test_every_point_of_both_is_there_in_order() -> None:
    angles = np.radians(np.arange(360) - 180.0)
    lengths = np.full(360, 2.0)
    lengths[10:20] = np.inf
    sweep = sweep_of(lengths, angles, np.arange(360) * 1e-4)
    seen = pseudo_of(np.radians([-5.3, 0.2, 9.4]), np.array([1.0, 2.01, 3.0]), 0.02, (0.0, 0.0))
    scan = union(sweep, [PlacedView(seen, se2(0.0, 0.0, 0.0))], STILL)
    assert len(scan.points_base) == 353
    angles = np.degrees(np.arctan2(scan.points_base[:, 1], scan.points_base[:, 0]))
    assert (np.diff(angles) > 0.0).all()
    assert not scan.layer.any()
    camera = scan.source == CAMERA
    assert angles[camera] == pytest.approx([-5.3, 0.2, 9.4])
    assert scan.camera_range_m[camera] == pytest.approx([1.0, 2.01, 3.0])
    assert scan.variance_m2[camera] == pytest.approx(4e-4)
    assert scan.offsets_s[camera] == pytest.approx([0.0175, 0.018, 0.0189])
    assert (scan.source[~camera] == LIDAR).all()
    assert scan.lidar_range_m[~camera] == pytest.approx(2.0)
    assert np.isnan(scan.lidar_range_m[camera]).all()
    assert np.isnan(scan.camera_range_m[~camera]).all()


def test_alone_the_lidars_scan_is_what_it_is() -> None:
    sweep = sweep_of(np.full(8, 2.0), np.linspace(-3.0, 3.0, 8))
    assert union(sweep, [], STILL).points_base == pytest.approx(sweep.returns().points_base)
    nothing = sweep_of(np.empty(0), np.empty(0))
    seen = pseudo_of(np.array([0.0]), np.array([1.0]), 0.01)
    assert len(union(nothing, [PlacedView(seen, np.eye(3))], STILL).points_base) == 0
