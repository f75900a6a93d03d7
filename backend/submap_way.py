"""How far two submaps are apart along the graph: what drift between them can have grown with."""

from __future__ import annotations

import numpy as np

from datasets.messages import Array

CLOSURE_M = 0.5
"""The way that a loop closure counts for: it leaves as much doubt as half a metre driven."""


class SubmapWay:
    """The shortest way between submaps, along the drive and across loop closures."""

    def __init__(self) -> None:
        self._ways_m: list[float] = []
        self._closures: list[tuple[int, int]] = []
        self._known: tuple[int, int, Array] | None = None

    def add(self, way_m: float) -> None:
        """The next submap, and the way to it from the one before."""
        self._ways_m.append(way_m)
        self._known = None

    def close(self, a: int, b: int) -> None:
        """A loop closure between two submaps."""
        self._closures.append((a, b))
        self._known = None

    def since_m(self, submap: int, count: int) -> Array:
        """(count,) the way between a submap and each of the first ``count``, m."""
        if self._known is None or self._known[0] != submap or self._known[1] < count:
            self._known = (submap, len(self._ways_m), self._from(submap))
        return self._known[2][:count]

    def _from(self, submap: int) -> Array:
        from scipy.sparse import coo_matrix  # noqa: PLC0415
        from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

        size = len(self._ways_m)
        ends = np.array(
            [(k - 1, k) for k in range(1, size)] + self._closures, dtype=np.int64
        ).reshape(-1, 2)
        ways = np.concatenate([self._ways_m[1:], np.full(len(self._closures), CLOSURE_M)])
        # several closures between the same two submaps are one; coo_matrix would add them up
        order = np.lexsort((ways, ends[:, 1], ends[:, 0]))
        ends, ways = ends[order], ways[order]
        first = np.ones(len(ends), dtype=bool)
        first[1:] = (ends[1:] != ends[:-1]).any(axis=1)
        graph = coo_matrix((ways[first] + 1e-6, ends[first].T), shape=(size, size)).tocsr()
        found: Array = dijkstra(graph, directed=False, indices=[submap])[0]
        return found
