"""What moves: speeds, turns, feet that stand, rounds that begin again."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from datasets.errors import InputError
from datasets.messages import Array
from datasets.simulation.place import Mover, load_place
from tests.datasets.simulation.place_meshes import write_place

ROOM = "walls: [{name: room, ring: [[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]], height_m: 2.5}]\n"


def movers(folder: Path, text: str) -> dict[str, Mover]:
    return {mover.name: mover for mover in load_place(write_place(folder, ROOM + text)).movers}


def positions(mover: Mover, times_s: Array) -> Array:
    return np.array([mover.T_map_mover(float(time_s))[:2, 3] for time_s in times_s])


WALKER = "people: [{name: p, path_m: [[1, 1], [6.5, 1]], speed_m_s: 1.1, repeat: once}]"


def test_a_body_walks_at_its_speed_and_stays_at_the_end(tmp_path: Path) -> None:
    body = movers(tmp_path, WALKER)["p/body"]
    np.testing.assert_allclose(positions(body, np.array([0.0, 2.0])), [[1, 1], [3.2, 1]])
    np.testing.assert_allclose(positions(body, np.array([5.0, 99.0])), [[6.5, 1]] * 2)
    assert not body.loop


def test_always_one_foot_stands(tmp_path: Path) -> None:
    both = movers(tmp_path, WALKER)
    times_s = np.linspace(0.3, 4.7, 441)
    left, right = (positions(both[f"p/{side} leg"], times_s) for side in ("left", "right"))
    steps = [np.abs(np.diff(foot[:, 0])) / np.diff(times_s) for foot in (left, right)]
    slow, fast = np.minimum(*steps), np.maximum(*steps)
    # A sample may straddle the moment when the feet change.
    assert np.mean(slow < 1e-6) > 0.95
    assert np.median(fast) == pytest.approx(2.2)
    np.testing.assert_allclose(left[:, 1], 1.1)
    np.testing.assert_allclose(right[:, 1], 0.9)
    body = positions(both["p/body"], times_s)
    assert np.abs(left[:, 0] - body[:, 0]).max() < 0.3


def test_to_and_fro_comes_back_and_begins_again(tmp_path: Path) -> None:
    text = "people: [{name: p, path_m: [[1, 1], [4, 1], [4, 3]], speed_m_s: 1}]"
    for mover in movers(tmp_path, text).values():
        round_s = float(mover.stamps_s[-1])
        # 10 m to walk, half a turn at each end, a quarter at the corner both ways.
        assert round_s == pytest.approx(10 + 3 * math.pi / 2.5)
        times_s = np.array([0.0, 1.3, 4.0, 7.7])
        again = positions(mover, times_s + round_s)
        np.testing.assert_allclose(again, positions(mover, times_s), atol=1e-9)
        just_before = mover.T_map_mover(round_s - 1e-7)
        np.testing.assert_allclose(just_before, mover.T_map_mover(0.0), atol=1e-5)
        speeds = np.linalg.norm(np.diff(mover.xyyaw[:, :2], axis=0), axis=1)
        assert (speeds / np.diff(mover.stamps_s)).max() < 2.2


def test_a_circle_closes(tmp_path: Path) -> None:
    text = (
        "moving_boxes: [{name: cart, path_m: [[2, 2], [6, 2], [6, 6], [2, 6]], speed_m_s: 2,"
        " repeat: circle, size_m: [0.8, 0.5, 1], z_m: 0.1}]"
    )
    cart = movers(tmp_path, text)["cart"]
    assert cart.stamps_s[-1] == pytest.approx(16 / 2 + 2 * math.pi / 2.5)
    assert cart.xyyaw[-1, 2] - cart.xyyaw[0, 2] == pytest.approx(2 * math.pi)
    assert np.abs(np.diff(cart.xyyaw[:, 2])).max() < 0.3
    T = cart.T_map_mover(2.0 + math.pi / 2 / 2.5 + 1.0)
    np.testing.assert_allclose(T[:2], [[0, -1, 0, 6], [1, 0, 0, 4]], atol=1e-9)
    assert cart.solid.vertices[:, 2].min() == pytest.approx(0.1)


def test_who_starts_later_waits(tmp_path: Path) -> None:
    text = "people: [{name: p, path_m: [[1, 1], [4, 1]], start_s: 5}]"
    body = movers(tmp_path, text)["p/body"]
    np.testing.assert_allclose(positions(body, np.array([0.0, 4.9, 6.0])), [[1, 1], [1, 1], [2, 1]])


def test_a_person_is_as_tall_as_told_and_stands_on_the_floor(tmp_path: Path) -> None:
    text = "people: [{name: p, path_m: [[1, 1], [4, 1]], height_m: 1.6}]"
    made = movers(tmp_path, text)
    heights = np.concatenate([mover.solid.vertices[:, 2] for mover in made.values()])
    assert (heights.min(), heights.max()) == pytest.approx((0.0, 1.6))
    assert {mover.solid.material.name for mover in made.values()} == {"cloth"}


@pytest.mark.parametrize("speed_m_s", ["1.0e-9", "1.0e-320"])
def test_a_walk_that_takes_years_is_refused(tmp_path: Path, speed_m_s: str) -> None:
    text = WALKER.replace("speed_m_s: 1.1", f"speed_m_s: {speed_m_s}")
    with pytest.raises(InputError, match="takes more than a day"):
        movers(tmp_path, text)
