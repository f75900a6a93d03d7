"""How far measured constraints are from the true relative poses (beside the paper's table 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from datasets.se2 import between
from datasets.trajectory import Stamps, Trajectory
from slam.evaluation.surfaces import Mask

FALSE_M = 0.5
FALSE_DEG = 5.0


@dataclass(frozen=True, slots=True)
class ConstraintErrors:
    """Errors of constraints, >= 0, in the order they were given.

    translation_m, rotation_deg : (N,). false : (N,) beyond ``false_m`` or ``false_deg``.
    left_out : constraints whose stamps lie outside the true trajectory, NaN in the errors.
    """

    translation_m: Array
    rotation_deg: Array
    false: Mask
    false_m: float
    false_deg: float
    left_out: int

    @property
    def count(self) -> int:
        """How many were compared."""
        return int(np.isfinite(self.translation_m).sum())

    def __str__(self) -> str:
        if not self.count:
            return f"no constraint was compared with the truth, {self.left_out} left out"
        known = np.isfinite(self.translation_m)
        metres, degrees = self.translation_m[known], self.rotation_deg[known]
        return (
            f"constraints against the truth: {metres.mean():.4f} m (max {metres.max():.4f}), "
            f"{degrees.mean():.3f} deg (max {degrees.max():.3f}); false (beyond "
            f"{self.false_m:g} m or {self.false_deg:g} deg): {int(self.false.sum())}; "
            f"n = {self.count}, {self.left_out} left out"
        )


def constraint_errors(
    from_stamps_ns: Stamps,
    to_stamps_ns: Stamps,
    T_from_to: Array,
    truth: Trajectory,
    *,
    false_m: float = FALSE_M,
    false_deg: float = FALSE_DEG,
) -> ConstraintErrors:
    """Compare relative poses of the base between two stamps with the truth.

    T_from_to : (N, 3) x m, y m, yaw rad, pose at the second stamp in the base frame of the first.
    truth     : interpolated at the stamps; what lies beyond its ends is left out.

    error = inverse(true T_from_to) * T_from_to. Raises ValueError if shapes disagree.
    """
    stamps = np.stack([from_stamps_ns, to_stamps_ns])
    if T_from_to.shape != (stamps.shape[1], 3):
        raise ValueError(f"relative poses {T_from_to.shape} for {stamps.shape[1]} stamps")
    true_pose = between(truth.at(stamps[0]), truth.at(stamps[1]))
    error = between(true_pose, T_from_to)
    translation_m, rotation_deg = np.hypot(error[:, 0], error[:, 1]), np.degrees(error[:, 2])
    rotation_deg = np.abs(rotation_deg)
    inside = ((stamps >= truth.stamps_ns[0]) & (stamps <= truth.stamps_ns[-1])).all(axis=0)
    translation_m[~inside] = np.nan
    rotation_deg[~inside] = np.nan
    with np.errstate(invalid="ignore"):
        false = (translation_m > false_m) | (rotation_deg > false_deg)
    return ConstraintErrors(
        translation_m, rotation_deg, false, false_m, false_deg, int((~inside).sum())
    )
