"""What numbers in a file may be: beyond these is damage, and would overflow further on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

FARTHEST_M: Final = 1e8
"""UTM coordinates reach 1e7 m; beyond is damage, and would overflow when composed."""
FARTHEST_MOUNTING_M: Final = 100.0
"""No sensor stands further from the base of its robot."""
LARGEST_RAD: Final = 1e6
"""Headings may have gathered many turns; angles of beams are bounded alike."""
LONGEST_RANGE_M: Final = 1e5
"""No lidar sees further, not even one whose driver writes millimetres."""
LARGEST_INFORMATION: Final = 1e18
"""Recorded graphs hold information up to 3e12 1/m^2."""


def within(values: Iterable[float], most: float) -> bool:
    """Whether all are finite, and no larger than that."""
    return all(-most <= value <= most for value in values)
