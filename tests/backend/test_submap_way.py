"""The shortest way between submaps, against trying every way."""

from __future__ import annotations

import heapq

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.submap_way import CLOSURE_M, SubmapWay


def shortest(ways_m: list[float], closures: list[tuple[int, int]], start: int) -> list[float]:
    """Dijkstra by the book."""
    links: list[list[tuple[int, float]]] = [[] for _ in ways_m]
    for a, b, length in [
        *((k - 1, k, ways_m[k]) for k in range(1, len(ways_m))),
        *((a, b, CLOSURE_M) for a, b in closures),
    ]:
        links[a].append((b, length))
        links[b].append((a, length))
    found = [np.inf] * len(ways_m)
    queue = [(0.0, start)]
    while queue:
        length, at = heapq.heappop(queue)
        if length >= found[at]:
            continue
        found[at] = length
        for other, more in links[at]:
            heapq.heappush(queue, (length + more, other))
    return found


def made(ways_m: list[float], closures: list[tuple[int, int]]) -> SubmapWay:
    way = SubmapWay()
    for length in ways_m:
        way.add(length)
    for a, b in closures:
        way.close(a, b)
    return way


@settings(deadline=None, max_examples=100)
@given(data=st.data())
def test_is_the_shortest_of_all_ways(data: st.DataObject) -> None:
    ways_m = data.draw(st.lists(st.floats(0.0, 30.0), min_size=1, max_size=12))
    places = st.integers(0, len(ways_m) - 1)
    pairs = st.tuples(places, places).filter(lambda pair: pair[0] != pair[1])
    closures = data.draw(st.lists(pairs, max_size=8)) if len(ways_m) > 1 else []
    start = data.draw(places)
    found = made(ways_m, closures).since_m(start, len(ways_m))
    assert found == pytest.approx(shortest(ways_m, closures, start), abs=1e-4)


def test_a_single_submap_is_at_itself() -> None:
    assert made([0.0], []).since_m(0, 1) == pytest.approx([0.0])


def test_a_closure_twice_is_no_longer_than_once() -> None:
    ways_m = [0.0, 10.0, 10.0, 10.0]
    once, thrice = made(ways_m, [(0, 3)]), made(ways_m, [(0, 3), (0, 3), (3, 0)])
    assert once.since_m(3, 4) == pytest.approx([CLOSURE_M, 10.0 + CLOSURE_M, 10.0, 0.0], abs=1e-4)
    assert thrice.since_m(3, 4) == pytest.approx(once.since_m(3, 4))


def test_a_closure_between_neighbours_never_lengthens_their_way() -> None:
    assert made([0.0, 0.2], [(0, 1)]).since_m(1, 1) == pytest.approx([0.2], abs=1e-4)
    assert made([0.0, 9.0], [(0, 1)]).since_m(1, 1) == pytest.approx([CLOSURE_M], abs=1e-4)


def test_what_comes_later_counts_at_once() -> None:
    way = made([0.0, 5.0, 5.0, 5.0], [])
    assert way.since_m(3, 2) == pytest.approx([15.0, 10.0], abs=1e-4)
    way.close(0, 3)
    assert way.since_m(3, 2) == pytest.approx([CLOSURE_M, 5.0 + CLOSURE_M], abs=1e-4)
    way.add(2.0)
    assert way.since_m(4, 2) == pytest.approx([2.0 + CLOSURE_M, 7.0 + CLOSURE_M], abs=1e-4)
    assert way.since_m(3, 4).shape == (4,)
