"""What a pseudo-laser scan refuses to be, and where its points lie."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.messages import Array
from fusion.pseudo_scan import PseudoScan


def pseudo(bearings: Array, ranges: Array, surfaces: Array | None = None) -> PseudoScan:
    surfaces = np.empty((0, 2)) if surfaces is None else surfaces
    count = len(bearings)
    return PseudoScan(
        0,
        "camera",
        np.array([0.5, -1.0]),
        bearings,
        ranges,
        np.full(len(ranges), 0.01),
        0.3,
        np.zeros(count),
        surfaces.astype(np.float32),
        0.01,
    )


def test_its_points_are_the_ends_of_the_finite_ranges() -> None:
    bearings = np.array([-np.pi / 2, 0.0, 0.5, 1.0])
    found = pseudo(bearings, np.array([2.0, 3.0, np.inf, np.nan]))
    assert found.points_base == pytest.approx(np.array([[0.5, -3.0], [3.5, -1.0]]))


@pytest.mark.parametrize(
    ("bearings", "ranges", "surfaces", "words"),
    [
        ([0.0, 0.1], [1.0], [], "2 bearings"),
        ([0.1, 0.0], [1.0, 1.0], [], "ascend"),
        ([0.0, np.nan], [1.0, 1.0], [], "finite"),
        ([0.0, 0.1], [1.0, 1.0], [[np.inf, 0.0]], "finite"),
        ([0.0, 0.1], [1.0, 1.0], [[1.0, 0.0, 2.0]], "surfaces_base"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    bearings: list[float], ranges: list[float], surfaces: list[list[float]], words: str
) -> None:
    shown = np.array(surfaces).reshape(len(surfaces), -1) if surfaces else None
    with pytest.raises(ValueError, match=words):
        pseudo(np.array(bearings), np.array(ranges), shown)
