"""What a fused scan refuses to be."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.messages import Array
from fusion.scan import FusedScan


def scan(
    points: Array, origin: Array | None = None, times: int = 0, sources: int | None = None
) -> FusedScan:
    origin = np.zeros(2) if origin is None else origin
    count = len(points) if sources is None else sources
    return FusedScan(0, "a", origin, points, np.zeros(times), np.zeros(count, dtype=np.uint8), 0.01)


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
