"""A stamp from the far future costs itself; a real gap costs nothing."""

from __future__ import annotations

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from datasets.messages import Odometry
from slam.leap import FAR_NS, LeapGuard

S = 1_000_000_000


def passed(stamps_ns: list[int]) -> tuple[list[int], int]:
    """The stamps that come through, and how many messages were counted as left out."""
    left_out: Counter[str] = Counter()
    guard = LeapGuard(left_out)
    through = [m.stamp_ns for ns in stamps_ns for m in guard.passed(Odometry(ns, np.eye(3)))]
    guard.end()
    return through, left_out.total()


def test_one_stamp_ahead_is_left_out_and_counted() -> None:
    assert passed([0, S, 10**6 * S, 2 * S, 3 * S]) == ([0, S, 2 * S, 3 * S], 1)


def test_after_a_real_gap_all_goes_on() -> None:
    late = [10**6 * S, 10**6 * S + S, 10**6 * S + 2 * S]
    assert passed([0, S, *late]) == ([0, S, *late], 0)


def test_two_stamps_ahead_that_disagree_are_both_left_out() -> None:
    assert passed([0, 10**6 * S, 10**8 * S, S]) == ([0, S], 2)


def test_a_stamp_ahead_at_the_end_is_left_out() -> None:
    assert passed([0, S, 10**6 * S]) == ([0, S], 1)


@given(st.lists(st.integers(-(10**6), 10**6).map(lambda s: s * S), max_size=30))
def test_every_message_comes_through_or_is_counted(stamps_ns: list[int]) -> None:
    through, count = passed(stamps_ns)
    assert len(through) + count == len(stamps_ns)
    remaining = iter(stamps_ns)
    assert all(any(ns == other for other in remaining) for ns in through), "in their order"


@given(st.lists(st.integers(0, FAR_NS), min_size=1, max_size=30))
def test_steps_that_are_not_far_all_pass(steps_ns: list[int]) -> None:
    stamps_ns = np.cumsum(steps_ns).tolist()
    assert passed(stamps_ns) == (stamps_ns, 0)
