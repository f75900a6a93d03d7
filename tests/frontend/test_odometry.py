"""Odometry at any stamp: exact at its messages, straight between them, silent beyond its reach."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datasets.messages import Odometry
from datasets.se2 import se2, xyyaw
from frontend.odometry import KEPT, OdometryTrack

S = 1_000_000_000
START_NS = 1_700_000_000 * S


def track(*messages: tuple[float, float, float, float], reach_s: float = 0.5) -> OdometryTrack:
    """Messages as (seconds, x, y, yaw)."""
    made = OdometryTrack(reach_s)
    for seconds, *pose in messages:
        assert made.add(Odometry(START_NS + round(seconds * S), se2(*pose)))
    return made


def at(odometry: OdometryTrack, seconds: float) -> tuple[float, float, float] | None:
    T = odometry.at(START_NS + round(seconds * S))
    return None if T is None else xyyaw(T)


def test_nothing_is_known_before_a_message_comes() -> None:
    assert OdometryTrack(1.0).at(START_NS) is None
    assert OdometryTrack(1.0).last_ns is None


def test_between_messages_it_goes_straight_and_turns_the_shorter_way() -> None:
    odometry = track((0.0, 0.0, 0.0, 3.0), (0.4, 1.0, -2.0, -3.0))
    assert at(odometry, 0.0) == pytest.approx((0.0, 0.0, 3.0))
    assert at(odometry, 0.4) == pytest.approx((1.0, -2.0, -3.0))
    x, y, yaw = at(odometry, 0.1) or (0.0, 0.0, 0.0)
    assert (x, y) == pytest.approx((0.25, -0.5))
    assert yaw == pytest.approx(3.0 + 0.25 * (2.0 * math.pi - 6.0))


def test_it_goes_on_as_it_went_but_not_for_long() -> None:
    odometry = track((0.0, 0.0, 0.0, 0.0), (0.2, 0.2, 0.0, 0.1))
    assert at(odometry, 0.4) == pytest.approx((0.4, 0.0, 0.2))
    assert at(odometry, -0.2) == pytest.approx((-0.2, 0.0, -0.1))
    assert at(odometry, 0.69) is not None
    assert at(odometry, 0.71) is None
    assert at(odometry, -0.51) is None


def test_after_a_gap_the_speed_across_it_is_not_gone_on_with() -> None:
    odometry = track((0.0, 0.0, 0.0, 0.0), (10.0, 50.0, 0.0, 0.0))
    assert at(odometry, 10.3) == pytest.approx((50.0, 0.0, 0.0))
    assert at(odometry, -0.3) == pytest.approx((0.0, 0.0, 0.0))


def test_a_single_message_stands_for_its_neighbourhood() -> None:
    odometry = track((1.0, 3.0, 2.0, 1.0))
    assert at(odometry, 1.4) == pytest.approx((3.0, 2.0, 1.0))
    assert at(odometry, 0.6) == pytest.approx((3.0, 2.0, 1.0))
    assert at(odometry, 1.6) is None


def test_what_is_not_newer_is_left_out() -> None:
    odometry = track((0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0))
    assert not odometry.add(Odometry(START_NS + S, se2(9.0, 0.0, 0.0)))
    assert not odometry.add(Odometry(START_NS + S // 2, se2(9.0, 0.0, 0.0)))
    assert at(odometry, 1.0) == pytest.approx((1.0, 0.0, 0.0))
    assert odometry.last_ns == START_NS + S


def test_the_past_is_forgotten_but_not_the_last_messages() -> None:
    count = 2 * KEPT + 10
    odometry = track(*((0.1 * k, 0.1 * k, 0.0, 0.0) for k in range(count)))
    first = 0.1 * (count - KEPT)
    for seconds in (first, first + 1.03, 0.1 * (count - 1)):
        assert at(odometry, seconds) == pytest.approx((seconds, 0.0, 0.0))
    assert at(odometry, 1.0) is None


@given(
    steps=st.lists(st.floats(0.01, 0.45), min_size=2, max_size=20),
    query=st.floats(0.0, 1.0),
    speed=st.floats(-2.0, 2.0),
    turn=st.floats(-3.0, 3.0),
)
def test_a_constant_motion_is_interpolated_wherever_it_is_asked(
    steps: list[float], query: float, speed: float, turn: float
) -> None:
    stamps = np.cumsum(steps)
    odometry = track(*((float(t), speed * t, -t, turn * t) for t in stamps))
    seconds = float(stamps[0] + query * (stamps[-1] - stamps[0]))
    x, y, yaw = at(odometry, seconds) or (math.nan,) * 3
    assert (x, y) == pytest.approx((speed * seconds, -seconds), abs=1e-6)
    assert math.cos(yaw - turn * seconds) == pytest.approx(1.0)


def test_deep_inside_a_gap_nothing_is_known() -> None:
    odometry = track((0.0, 0.0, 0.0, 0.0), (60.0, 20.0, 0.0, 0.0))
    assert at(odometry, 30.0) is None
    near = at(odometry, 0.3)
    assert near is not None
    assert near[0] == pytest.approx(0.1)
    assert at(odometry, 59.7) is not None
