"""What a fused scan refuses to be."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.messages import Array
from fusion.scan import FusedScan


def scan(
    points: Array,
    origin: Array | None = None,
    times: int = 0,
    sources: int | None = None,
    layers: tuple[int, ...] | None = None,
) -> FusedScan:
    origin = np.zeros(2) if origin is None else origin
    count = len(points)
    return FusedScan(
        0,
        "a",
        origin,
        points,
        np.zeros(times),
        np.zeros(count if sources is None else sources, dtype=np.uint8),
        0.01,
        np.zeros(count, dtype=np.uint8) if layers is None else np.array(layers, dtype=np.uint8),
        np.full(count, 1e-4),
        np.full(count, np.nan),
        np.full(count, np.nan),
    )


def test_times_may_be_unknown() -> None:
    assert scan(np.ones((3, 2))).offsets_s.size == 0
    assert scan(np.ones((3, 2)), times=3).offsets_s.size == 3
    assert scan(np.empty((0, 2))).points_base.shape == (0, 2)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_must_be_finite(value: float) -> None:
    points = np.ones((3, 2))
    points[1, 1] = value
    with pytest.raises(ValueError, match="finite"):
        scan(points)


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match="points_base"):
        scan(np.ones((3, 3)))
    with pytest.raises(ValueError, match="origin_base"):
        scan(np.ones((3, 2)), origin=np.zeros(3))
    with pytest.raises(ValueError, match="3 points"):
        scan(np.ones((3, 2)), times=2)
    with pytest.raises(ValueError, match="3 points"):
        scan(np.ones((3, 2)), sources=4)
    with pytest.raises(ValueError, match="3 points"):
        scan(np.ones((3, 2)), layers=(0, 1))


def test_layers_come_one_after_the_other() -> None:
    assert scan(np.ones((3, 2)), layers=(0, 0, 1)).layer.tolist() == [0, 0, 1]
    with pytest.raises(ValueError, match="layer 0"):
        scan(np.ones((3, 2)), layers=(0, 1, 0))


def test_a_lidar_alone_measured_every_point() -> None:
    points, origin = np.array([[3.0, 4.0], [0.0, 1.0]]), np.array([0.0, 1.0])
    alone = FusedScan.of_lidar(0, "a", origin, points, np.empty(0), 0.01, np.full(2, 1e-4))
    assert alone.lidar_range_m == pytest.approx([np.hypot(3.0, 3.0), 0.0])
    assert np.isnan(alone.camera_range_m).all()
    assert not alone.source.any()
    assert not alone.layer.any()
