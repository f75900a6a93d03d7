"""Stamps that lie: what it costs, in messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import LaserScan, Message, Odometry
from datasets.options import ReadOptions
from datasets.time_order import MOST_HELD, TimeOrder, cut

SECOND = 1_000_000_000
DAY = 86_400 * SECOND


def scan(stamp_ns: int, lidar: str = "front") -> LaserScan:
    return LaserScan(stamp_ns, lidar, np.ones(1), np.zeros(1), np.empty(0), 0.0, 10.0)


def odometry(stamp_ns: int) -> Odometry:
    return Odometry(stamp_ns, np.eye(3))


def order(arriving: Sequence[tuple[str, Message]]) -> tuple[list[Message], Counter[str]]:
    notes: Counter[str] = Counter()
    time_order = TimeOrder(notes)
    out: list[Message] = []
    for name, message in arriving:
        out.extend(time_order.push(name, message))
    out.extend(time_order.flush())
    return out, notes


def stamps_after(stamps_ns: Sequence[int]) -> tuple[list[int], Counter[str]]:
    out, notes = order([("scan", scan(stamp)) for stamp in stamps_ns])
    return [message.stamp_ns for message in out], notes


def regular(count: int, step_ns: int = SECOND // 10, start_ns: int = 1000 * SECOND) -> list[int]:
    return [start_ns + i * step_ns for i in range(count)]


@given(
    st.lists(st.integers(1, 100 * SECOND), min_size=1, max_size=60),
    st.integers(0, 2**60),
)
def test_rising_stamps_all_stay(steps_ns: list[int], start_ns: int) -> None:
    stamps = [start_ns + int(s) for s in np.cumsum(steps_ns)]
    after, notes = stamps_after(stamps)
    assert after == stamps
    assert not notes


@pytest.mark.parametrize("place", [0, 1, 5, 49, 98])
@pytest.mark.parametrize("jump_ns", [DAY, 5 * SECOND, -5 * SECOND, -DAY])
@pytest.mark.parametrize("step_ns", [SECOND // 40, SECOND // 2])
def test_one_wrong_stamp_costs_one_message(place: int, jump_ns: int, step_ns: int) -> None:
    stamps = regular(99, step_ns, 3 * DAY)
    wrong = list(stamps)
    wrong[place] += jump_ns
    after, notes = stamps_after(wrong)
    if place in (0, 98) and abs(jump_ns) < DAY and (place == 0) == (jump_ns < 0):
        assert after == wrong  # nothing contradicts a step at an end
        return
    assert after == stamps[:place] + stamps[place + 1 :]
    assert sum(notes.values()) == 1


def test_a_few_wrong_stamps_in_a_row_cost_themselves() -> None:
    stamps = regular(100)
    wrong = list(stamps)
    for i in (30, 31, 32, 33):
        wrong[i] += DAY
    after, notes = stamps_after(wrong)
    assert after == stamps[:30] + stamps[34:]
    assert notes == {"scan left out: stamp jumps ahead and back": 4}


def test_a_jump_for_good_is_a_gap() -> None:
    stamps = regular(50) + regular(50, start_ns=2000 * SECOND + DAY)
    after, notes = stamps_after(stamps)
    assert after == stamps
    assert notes == {"scan: gap of more than an hour bridged": 1}


def test_a_clock_set_back_for_good_is_bridged_alike_in_all_streams() -> None:
    arriving: list[tuple[str, Message]] = []
    for i in range(600):
        stamp = 5 * DAY + i * SECOND // 50 - (DAY if i >= 300 else 0)
        arriving.append(("odometry", odometry(stamp)))
        if i % 10 == 0:
            arriving.append(("scan", scan(stamp)))
    out, notes = order(arriving)
    assert len(out) >= len(arriving) - 2
    stamps = [message.stamp_ns for message in out]
    assert stamps == sorted(stamps)
    assert stamps[-1] - stamps[0] < 13 * SECOND
    moved = {m.stamp_ns for m in out if isinstance(m, Odometry)}
    scans = [m.stamp_ns for m in out if isinstance(m, LaserScan)]
    assert all(stamp in moved for stamp in scans[-20:])  # as they were to each other before
    assert notes["odometry: clock set back; stamps from there on moved forward"] == 1


def test_one_stream_ahead_for_long_is_known_by_the_others() -> None:
    arriving: list[tuple[str, Message]] = []
    for i in range(1000):
        stamp = 5 * DAY + i * SECOND // 50
        arriving.append(("odometry", odometry(stamp)))
        if i % 10 == 0:
            arriving.append(("scan", scan(stamp + (DAY if i < 300 else 0))))
    out, notes = order(arriving)
    assert notes == {"scan left out: stamp jumps ahead and back": 30}
    assert len(out) == len(arriving) - 30
    assert out[-1].stamp_ns < 5 * DAY + 20 * SECOND


def test_a_sparse_stream_among_a_fast_one_is_kept_whole() -> None:
    arriving: list[tuple[str, Message]] = []
    for i in range(60_000):
        stamp = 5 * DAY + i * SECOND // 400
        arriving.append(("odometry", odometry(stamp)))
        if i % 800 == 799:
            arriving.append(("scan", scan(stamp - 50)))
    out, notes = order(arriving)
    assert not notes
    assert len(out) == len(arriving)


def test_repeated_stamps_cost_the_repetition() -> None:
    stamps = regular(30)
    after, notes = stamps_after(stamps[:10] + [stamps[9]] * 3 + stamps[10:])
    assert after == stamps
    assert notes == {"scan left out: stamp repeated": 3}


def test_odometry_comes_before_the_scan_of_the_same_stamp() -> None:
    arriving: list[tuple[str, Message]] = []
    for stamp in regular(40):
        arriving += [("scan", scan(stamp)), ("odometry", odometry(stamp))]
    out, _ = order(arriving)
    assert [type(m) for m in out] == [Odometry, LaserScan] * 40


@pytest.mark.parametrize("lag_ns", [0, SECOND // 3, 20 * SECOND])
def test_streams_that_lag_are_merged_whole(lag_ns: int) -> None:
    stamps = regular(400)
    arriving: list[tuple[str, Message]] = []
    for stamp in stamps:
        arriving += [("odometry", odometry(stamp)), ("scan", scan(stamp - lag_ns + 7))]
    out, notes = order(arriving)
    assert not notes
    assert len(out) == len(arriving)
    after = [message.stamp_ns for message in out]
    assert after == sorted(after)


def test_a_stream_that_ends_does_not_hold_the_others() -> None:
    notes: Counter[str] = Counter()
    time_order = TimeOrder(notes)
    given_back = 0
    for i, stamp in enumerate(regular(5000)):
        if i < 20:
            given_back += len(list(time_order.push("scan", scan(stamp))))
        given_back += len(list(time_order.push("odometry", odometry(stamp))))
    assert given_back > 4000
    assert given_back + len(list(time_order.flush())) == 5020


def test_memory_is_bounded_even_if_a_stream_waits_for_ever() -> None:
    time_order = TimeOrder(Counter())
    list(time_order.push("scan", scan(5)))
    count = MOST_HELD + 500
    given_back = 0
    for stamp in regular(count, step_ns=1000):
        given_back += len(list(time_order.push("odometry", odometry(stamp))))
    assert given_back >= 400


@settings(max_examples=200)
@given(
    st.lists(
        st.tuples(st.sampled_from(["a", "b"]), st.integers(-5, 40), st.booleans()), max_size=80
    )
)
def test_whatever_arrives_comes_out_in_order(raw: list[tuple[str, int, bool]]) -> None:
    arriving = [
        (name, scan(stamp * SECOND // 4 + (DAY if far else 0), name)) for name, stamp, far in raw
    ]
    out, notes = order(arriving)
    stamps = [message.stamp_ns for message in out]
    assert stamps == sorted(stamps)
    for name in ("a", "b"):
        own = [m.stamp_ns for m in out if isinstance(m, LaserScan) and m.lidar == name]
        assert all(before < after for before, after in pairwise(own))
    left_out = sum(count for note, count in notes.items() if "left out" in note)
    assert len(out) + left_out == len(arriving)


def test_cut_takes_the_part_asked_for() -> None:
    stamps = regular(100)
    part = list(cut((scan(s) for s in stamps), ReadOptions(start_s=2.0, duration_s=3.0)))
    assert [m.stamp_ns for m in part] == stamps[20:51]
    assert len(list(cut((scan(s) for s in stamps), ReadOptions(start_s=99.0)))) == 0


def test_a_clock_that_goes_back_again_and_again_gives_no_stamp_twice() -> None:
    """As in a log whose part was copied many times: each round is seen to be ahead of the next."""
    rounds = [[1, 2, 3, 4, 5, 6], *[[3, 4, 5, 6]] * 50]
    arriving: list[tuple[str, Message]] = []
    for stamps_s in rounds:
        for stamp_s in stamps_s:
            arriving.append(("odometry", odometry(stamp_s * SECOND)))
            arriving.append(("scan", scan(stamp_s * SECOND)))
    out, _ = order(arriving)
    for kind in (LaserScan, Odometry):
        stamps_ns = [message.stamp_ns for message in out if isinstance(message, kind)]
        assert stamps_ns == sorted(set(stamps_ns))
        assert len(stamps_ns) == 6
