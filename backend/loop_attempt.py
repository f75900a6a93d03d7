"""One search for a place in an earlier submap: what was asked, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from datasets.messages import Array
from frontend.match import Match
from frontend.nodes import Node, Submap

ACCEPTED: Final = "accepted"
ALONE: Final = "alone: from a large window, and no other place bears it out"
TOO_FAR: Final = "too far: the base can't have come there while tracking was lost"
SLIDING: Final = "the way along is not shown, and the window is large"
AMBIGUOUS: Final = "ambiguous: another place fits nearly as well"
CONTRADICTED: Final = "contradicted: its walls stand where the other scans saw free space"
NEAR_M: Final = 2.0
WIDE_M: Final = 4.0
"""Windows: below NEAR_M a pose is nearly known; those above WIDE_M are searched for one place of a
submap only, and what they show must be borne out by another place."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopAttempt:
    """One search of one place in one submap: accepted, or why not.

    query, own, submap : the node asked about, the submap it is of, and the submap searched.
    window_m, window_rad : how far from the guess was searched.
    result        : ACCEPTED or the reason against it.
    score, second_score, inlier_ratio : of the best pose; of the best pose elsewhere (0: none).
    T_anchor_base : (3, 3), the query's base in the submap's frame.
    information   : (3, 3) of that pose in the query's base axes.
    contradiction : share of the query's points that the submap's scans saw through.
    of            : the attempt that this one was to bear out, if it was made for that.
    """

    query: Node
    own: Submap
    submap: Submap
    window_m: float
    window_rad: float
    result: str
    score: float
    second_score: float
    inlier_ratio: float
    T_anchor_base: Array
    information: Array
    contradiction: float = 0.0
    of: LoopAttempt | None = None

    @property
    def stamp_ns(self) -> int:
        """Of the query."""
        return self.query.scan.stamp_ns


@dataclass(frozen=True, slots=True)
class PlaceTask:
    """One search to be done: a place in one submap, about a guess (3, 3) in the submap's frame."""

    query: Node
    own: Submap
    submap: Submap
    T_anchor_guess: Array
    window_m: float
    window_rad: float
    of: LoopAttempt | None = None


def attempted(
    task: PlaceTask,
    result: str,
    score: float = 0.0,
    second_score: float = 0.0,
    match: Match | None = None,
    contradiction: float = 0.0,
) -> LoopAttempt:
    """What came of a task; without a match the guess stands in, without any information."""
    return LoopAttempt(
        task.query,
        task.own,
        task.submap,
        task.window_m,
        task.window_rad,
        result,
        score,
        second_score,
        match.inlier_ratio if match else 0.0,
        match.T_frame_base if match else task.T_anchor_guess,
        match.information if match else np.zeros((3, 3)),
        contradiction,
        task.of,
    )
