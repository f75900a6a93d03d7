"""What wheels get wrong all the time, learned from the matches while running."""

from __future__ import annotations

import math
from typing import Final

from datasets.messages import Array
from datasets.se2 import se2, xyyaw

TURN_STEP_M: Final = 0.2
SCALE_STEP_M: Final = 1.0
"""Each error is taken over so much way: over less it drowns in the noise of the matches, and in
the jumps between two lidars whose mountings don't agree."""

TURN_MEMORY: Final = 0.99
"""What is left of a learning step after the next: some twenty metres of way."""

UNBIASED_M2: Final = 25.0
"""The turning error is learned as if squared steps of this sum had shown none."""

SCALE_MEMORY_M: Final = 50.0
"""Way after which a step counts by 1/e: wheels keep their size, floors and loads change."""

UNSCALED_M: Final = 5.0
"""The scale is learned as if this way had shown no error."""

MOST_SCALE: Final = 0.05
"""No step teaches a larger error: what errs by more than that is slip, or a false match."""


SPREAD_MEMORY: Final = 0.95
"""What is left of a step's share in the spread after the next."""

SPREAD_STEP_RAD: Final = 0.06
"""Steps whose yaw is predicted to be off by less are short, and show the noise of the matches."""

SPREAD_LEAST: Final = (0.2, 0.1)
"""No spread is taken to be a smaller share (position, yaw) of what a prediction may be off."""


class OdometryErrors:
    """A steady turn for each metre, and a scale: learned by running least squares, and undone.

    A base whose wheels differ turns by some rad for each metre, 0.08 in one of the recordings of
    the literature; wheels of another size than the driver believes make each metre longer or
    shorter, by a per cent or two. Where the matches see them, both are learned; where they don't,
    along a bare corridor, what was learned holds.
    """

    def __init__(self) -> None:
        self._turn_ways_m2 = UNBIASED_M2
        self._turn_products = 0.0
        self._scale_way_m = UNSCALED_M
        self._scale_excess_m = 0.0
        self._spread = (1.0, 1.0)
        self.pause()

    @property
    def turn_rad_per_m(self) -> float:
        """How much the base turns more, for each metre forwards, than its odometry says."""
        return self._turn_products / self._turn_ways_m2

    @property
    def scale_error(self) -> float:
        """By which share of what its odometry says the base's way is longer."""
        return self._scale_excess_m / self._scale_way_m

    def corrected(self, T_wheel_step: Array) -> Array:
        """A step (3, 3) of the odometry without what is known of its errors."""
        x, y, yaw = xyyaw(T_wheel_step)
        bias = self.turn_rad_per_m * x
        c, s = math.cos(0.5 * bias), math.sin(0.5 * bias)
        longer = 1.0 + self.scale_error
        return se2(longer * (c * x - s * y), longer * (s * x + c * y), yaw + bias)

    def learn(self, T_wheel_step: Array, T_matched_step: Array, *, forward_seen: bool) -> None:
        """Compare a step (3, 3) of the odometry with what the matches say of it.

        forward_seen : the match observed the way along; otherwise it has it from the odometry.
        """
        forward_m, _, yaw = xyyaw(T_wheel_step)
        matched_m, _, matched_yaw = xyyaw(T_matched_step)
        self._learn_turn(forward_m, matched_yaw - yaw)
        if forward_seen:
            self._learn_scale(forward_m, matched_m)
        else:
            self._scale_forward_m = self._scale_matched_m = 0.0

    @property
    def usual_share(self) -> tuple[float, float]:
        """Of what a prediction may be off, position and yaw: how much it usually is off."""
        first, second = (math.sqrt(square) for square in self._spread)
        return max(SPREAD_LEAST[0], first), max(SPREAD_LEAST[1], second)

    def learn_spread(self, T_predicted_matched: Array, sigma_m: float, sigma_rad: float) -> None:
        """Compare how far a match (3, 3) is from its prediction with how far that may be off.

        A running mean of squares, an outlier counting as three times what is usual.
        """
        x, y, yaw = xyyaw(T_predicted_matched)
        squares = (0.5 * (x * x + y * y) / sigma_m**2, (yaw / sigma_rad) ** 2)
        first, second = (
            min(1.0, SPREAD_MEMORY * usual + (1.0 - SPREAD_MEMORY) * min(square, 9.0 * usual))
            for usual, square in zip(self._spread, squares, strict=True)
        )
        self._spread = first, second

    def pause(self) -> None:
        """The thread is broken: the next step doesn't join the last."""
        self._forward_m = self._turned_rad = 0.0
        self._scale_forward_m = self._scale_matched_m = 0.0

    def _learn_scale(self, forward_m: float, matched_m: float) -> None:
        self._scale_forward_m += forward_m
        self._scale_matched_m += matched_m
        way_m = abs(self._scale_forward_m)
        if way_m < SCALE_STEP_M:
            return
        excess_m = math.copysign(1.0, self._scale_forward_m) * self._scale_matched_m - way_m
        excess_m = min(max(excess_m, -MOST_SCALE * way_m), MOST_SCALE * way_m)
        kept = math.exp(-way_m / SCALE_MEMORY_M)
        self._scale_way_m = kept * self._scale_way_m + way_m
        self._scale_excess_m = kept * self._scale_excess_m + excess_m
        self._scale_forward_m = self._scale_matched_m = 0.0

    def _learn_turn(self, forward_m: float, error_rad: float) -> None:
        self._forward_m += forward_m
        self._turned_rad += math.atan2(math.sin(error_rad), math.cos(error_rad))
        if abs(self._forward_m) < TURN_STEP_M:
            return
        # a single outlier must not turn the model
        most = 0.3 * abs(self._forward_m) + 0.02
        error = min(max(self._turned_rad, -most), most)
        self._turn_ways_m2 = TURN_MEMORY * self._turn_ways_m2 + self._forward_m**2
        self._turn_products = TURN_MEMORY * self._turn_products + self._forward_m * error
        self._forward_m = self._turned_rad = 0.0
