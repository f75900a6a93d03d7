"""A constant offset between the clocks of a trajectory and of its ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from datasets.trajectory import Trajectory
from slam.evaluation.alignment import alignment, residuals_m
from slam.evaluation.association import Pairs, associate, covered, require_enough

LIMIT_S = 0.5
STEP_S = 0.02
EXACT_S = 1e-4
KEPT = 0.9
TELLING = 0.9
"""An estimate is believed if it brings the error below this share."""
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """What is added to a stamp of the estimate to get the stamp of the ground truth.

    offset_s     : negative where the estimate is stamped late.
    estimated    : whether it was estimated here, or given.
    rmse_without_m, rmse_with_m : what it was estimated by: error over the best 90 % of the pairs
                   without an offset and with this one. NaN if it was given.
    at_limit     : the estimate lies at the end of what was searched, and means nothing.
    """

    offset_s: float
    estimated: bool
    rmse_without_m: float = math.nan
    rmse_with_m: float = math.nan
    at_limit: bool = False

    @property
    def telling(self) -> bool:
        """Whether the estimate explains a part of the error; a base that stood tells none."""
        return not self.at_limit and self.rmse_with_m < TELLING * self.rmse_without_m

    def __str__(self) -> str:
        if self.offset_s == 0.0 and not self.estimated:
            return "clocks taken as equal"
        late = "late" if self.offset_s < 0 else "early"
        text = (
            f"the trajectory is stamped {abs(self.offset_s):.4f} s {late} against the ground truth"
        )
        if not self.estimated:
            return f"{text} (given)"
        gain = f"{self.rmse_without_m:.4f} m without, {self.rmse_with_m:.4f} m with it"
        doubt = "" if self.telling else "; it hardly matters"
        if self.at_limit:
            doubt = "; NOT FOUND, this is the end of the search"
        return f"{text} (estimated: rmse of the best {KEPT:.0%} of the pairs {gain}{doubt})"


def estimate_time_offset(estimate: Trajectory, ground_truth: Trajectory) -> TimeOffset:
    """Find the offset within half a second that makes the aligned trajectories agree best.

    A coarse grid, then golden section to 0.1 ms. Every offset is judged by the same poses: those
    that have ground truth under all of them. The worst tenth of the pairs is left out each time,
    so a stretch that the estimate got wrong does not decide. A base that stands, or goes straight
    at one speed, does not tell its offset.

    Raises TooFewPairsError if the two hardly share a time.
    """
    grid_s = np.arange(-round(LIMIT_S / STEP_S), round(LIMIT_S / STEP_S) + 1) * STEP_S
    shifts_ns = np.rint(grid_s * 1e9).astype(np.int64)
    common = np.ones(len(estimate), dtype=np.bool_)
    for shift_ns in shifts_ns:
        common &= covered(ground_truth, estimate.stamps_ns + shift_ns)
    require_enough(int(common.sum()), estimate, ground_truth)
    judged = Trajectory(estimate.stamps_ns[common], estimate.xyyaw[common])

    def cost_m(offset_s: float) -> float:
        return trimmed_rmse_m(associate(judged, ground_truth, offset_s))

    costs_m = [cost_m(float(offset_s)) for offset_s in grid_s]
    best = int(np.argmin(costs_m))
    low_s, high_s = float(grid_s[max(best - 1, 0)]), float(grid_s[min(best + 1, grid_s.size - 1)])
    offset_s = _golden_section(cost_m, low_s, high_s)
    return TimeOffset(
        offset_s=offset_s,
        estimated=True,
        rmse_without_m=cost_m(0.0),
        rmse_with_m=cost_m(offset_s),
        at_limit=best in (0, grid_s.size - 1),
    )


def trimmed_rmse_m(pairs: Pairs) -> float:
    """The rmse of the best nine tenths of the pairs, aligned by these."""
    errors_m = residuals_m(pairs, alignment(pairs))
    kept = np.sort(np.argsort(errors_m, kind="stable")[: math.ceil(KEPT * errors_m.size)])
    best = Pairs(pairs.stamps_ns[kept], pairs.estimate[kept], pairs.truth[kept])
    return float(np.sqrt((residuals_m(best, alignment(best)) ** 2).mean()))


def _golden_section(cost: Callable[[float], float], low: float, high: float) -> float:
    left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    cost_left, cost_right = cost(left), cost(right)
    while high - low > EXACT_S:
        if cost_left < cost_right:
            high, right, cost_right = right, left, cost_left
            left = high - GOLDEN * (high - low)
            cost_left = cost(left)
        else:
            low, left, cost_left = left, right, cost_right
            right = low + GOLDEN * (high - low)
            cost_right = cost(right)
    return (low + high) / 2
