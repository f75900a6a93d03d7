"""Pairs of estimated and true poses at the same times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.errors import InputError
from datasets.messages import Array
from datasets.trajectory import Stamps, Trajectory

LEAST_PAIRS = 3
LEAST_GAP_S = 0.2


class TooFewPairsError(InputError):
    """The two trajectories share too few times to be compared."""


@dataclass(frozen=True, slots=True)
class Pairs:
    """stamps_ns : (N,), of the estimate. estimate, truth : (N, 3) poses, each in its own frame."""

    stamps_ns: Stamps
    estimate: Array
    truth: Array


def covered(ground_truth: Trajectory, stamps_ns: Stamps) -> npt.NDArray[np.bool_]:
    """Where ground truth can be interpolated: not beyond its ends, and not across its gaps.

    A gap is an interval of more than 0.2 s and more than three usual (median) ones.
    """
    true_ns = ground_truth.stamps_ns
    if true_ns.size == 0:
        return np.zeros(stamps_ns.shape, dtype=np.bool_)
    after = np.searchsorted(true_ns, stamps_ns)
    met = true_ns[np.minimum(after, true_ns.size - 1)] == stamps_ns
    if true_ns.size < 2:
        return met
    intervals_ns = np.diff(true_ns)
    gap_ns = max(LEAST_GAP_S * 1e9, 3.0 * float(np.median(intervals_ns)))
    inside = (after > 0) & (after < true_ns.size)
    interval_ns = intervals_ns[np.clip(after - 1, 0, intervals_ns.size - 1)]
    result: npt.NDArray[np.bool_] = met | (inside & (interval_ns <= gap_ns))
    return result


def associate(estimate: Trajectory, ground_truth: Trajectory, time_offset_s: float) -> Pairs:
    """Interpolate the ground truth at the stamps of the estimate plus the offset.

    Raises TooFewPairsError if fewer than three poses find their partner.
    """
    true_ns = estimate.stamps_ns + round(time_offset_s * 1e9)
    mask = covered(ground_truth, true_ns)
    require_enough(int(mask.sum()), estimate, ground_truth)
    return Pairs(estimate.stamps_ns[mask], estimate.xyyaw[mask], ground_truth.at(true_ns[mask]))


def require_enough(count: int, estimate: Trajectory, ground_truth: Trajectory) -> None:
    """Raises TooFewPairsError, which says where the two lie in time, if the pairs are too few."""
    if count >= LEAST_PAIRS:
        return
    remedy = "Give the ground truth of the same recording, with stamps of the same clock."
    if len(estimate) == 0 or len(ground_truth) == 0:
        empty = "trajectory" if len(estimate) == 0 else "ground truth"
        raise TooFewPairsError(f"the {empty} is empty", where="evaluation", remedy=remedy)
    start_ns = estimate.stamps_ns[0]
    last_s = (estimate.stamps_ns[-1] - start_ns) * 1e-9
    true_first_s, true_last_s = ((ground_truth.stamps_ns[k] - start_ns) * 1e-9 for k in (0, -1))
    raise TooFewPairsError(
        f"only {count} of {len(estimate)} poses have ground truth at their time: counted from the "
        f"first pose, the trajectory lasts to {last_s:.1f} s, the ground truth from "
        f"{true_first_s:.1f} to {true_last_s:.1f} s",
        where="evaluation",
        remedy=remedy,
    )
