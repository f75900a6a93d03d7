"""Whether a scan at a pose agrees with what earlier scans saw: walls where these saw walls, and
none in what they saw to be free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from datasets.messages import Array
from datasets.se2 import inverse, transform
from frontend import view_kernels
from frontend.prepared import PreparedScan
from fusion.kernel_types import Bytes
from fusion.scan import LIDAR_LAYER

MARGIN_M: Final = 0.15
MARGIN_RATIO: Final = 0.03
"""A point agrees within so much of what another scan saw in its direction: a noisy normal's worth
of position, and an error of the yaw of nearly two degrees."""

GAP_RAD: Final = 0.05
"""Between two beams farther apart than this nothing was seen."""

COMPARED_POINTS: Final = 200


@dataclass(frozen=True, slots=True)
class Agreement:
    """Points of a scan, and of the scans it is compared with, by what the other side says.

    agreeing      : they stand where it saw something.
    contradicting : they stand in what it saw to be free.
    total         : all of them; the rest is hidden, or out of sight.
    """

    agreeing: int
    contradicting: int
    total: int

    @property
    def share(self) -> float:
        """0..1: of the points that both sides can tell of, those that agree; 0 without any."""
        return self.agreeing / max(1, self.agreeing + self.contradicting)

    @property
    def seen(self) -> float:
        """0..1: the points that both sides can tell of."""
        return (self.agreeing + self.contradicting) / max(1, self.total)


def agreement(
    scan: PreparedScan, T_frame_base: Array, others: Sequence[tuple[PreparedScan, Array]]
) -> Agreement:
    """Compare the main layer of a scan at a pose (3, 3) with others at theirs, both ways.

    A point of the scan agrees if one of the others agrees with it, and is contradicted if none does
    and one contradicts it; the same with the points of each of the others in the scan's view.
    """
    part = scan.part(LIDAR_LAYER)
    every = max(1, -(-(part.stop - part.start) // COMPARED_POINTS))
    points = scan.points_base[part][::every]
    verdicts = np.zeros(len(points), dtype=np.uint8)
    back = []
    for other, T_frame_other in others:
        T_other_base = inverse(T_frame_other) @ T_frame_base
        _compare(transform(T_other_base, points), other, verdicts)
        seen = other.points_base[other.part(LIDAR_LAYER)]
        seen = seen[:: max(1, -(-len(seen) // COMPARED_POINTS))]
        backward = np.zeros(len(seen), dtype=np.uint8)
        _compare(transform(inverse(T_other_base), seen), scan, backward)
        back.append(backward)
    every_verdict = np.concatenate([verdicts, *back])
    return Agreement(
        int(np.count_nonzero(every_verdict == view_kernels.AGREES)),
        int(np.count_nonzero(every_verdict == view_kernels.CONTRADICTS)),
        len(every_verdict),
    )


def _compare(points: Array, view: PreparedScan, verdicts: Bytes) -> None:
    """See ``view_kernels.compare_with_view``; points (N, 2) in the view's base frame."""
    part = view.part(LIDAR_LAYER)
    view_kernels.compare_with_view(
        np.ascontiguousarray(points),
        view.points_base[part],
        view.bearings_rad[part],
        float(view.origin_base[0]),
        float(view.origin_base[1]),
        MARGIN_M,
        MARGIN_RATIO,
        GAP_RAD,
        verdicts,
    )
