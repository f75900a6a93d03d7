"""How far two submaps are apart along the graph: what drift between them can have grown with."""

from __future__ import annotations

import heapq

import numpy as np

from datasets.messages import Array

CLOSURE_M = 0.5
"""The way that a loop closure counts for: it leaves as much doubt as half a metre driven."""

LOST_M = 300.0
"""The way that losing track counts for: mostly the odometry led on, and the place is found near
where it is expected. Where it is not, the search after the last scan looks everywhere."""


class SubmapWay:
    """The shortest way between submaps, along the drive and across loop closures."""

    def __init__(self) -> None:
        self._edges: list[dict[int, float]] = []
        self._known: tuple[int, int, Array] | None = None

    def add(self, way_m: float) -> None:
        """The next submap, and the way to it from the one before."""
        self._edges.append({})
        if len(self._edges) > 1:
            self._join(len(self._edges) - 2, len(self._edges) - 1, way_m)
        self._known = None

    def close(self, a: int, b: int) -> None:
        """A loop closure between two submaps."""
        self._join(a, b, CLOSURE_M)
        self._known = None

    def since_m(self, submap: int, count: int) -> Array:
        """(count,) the way between a submap and each of the first ``count``, m."""
        if self._known is None or self._known[0] != submap or self._known[1] < count:
            self._known = (submap, len(self._edges), self._from(submap))
        return self._known[2][:count]

    def _join(self, a: int, b: int, way_m: float) -> None:
        shortest = min(way_m, self._edges[a].get(b, way_m))
        self._edges[a][b] = self._edges[b][a] = shortest

    def _from(self, submap: int) -> Array:
        """Dijkstra's algorithm; the graph changes too often to be worth a matrix."""
        found = [0.0 if k == submap else np.inf for k in range(len(self._edges))]
        front = [(0.0, submap)]
        while front:
            way_m, k = heapq.heappop(front)
            if way_m > found[k]:
                continue
            for other, edge_m in self._edges[k].items():
                if way_m + edge_m < found[other]:
                    found[other] = way_m + edge_m
                    heapq.heappush(front, (found[other], other))
        return np.array(found)
