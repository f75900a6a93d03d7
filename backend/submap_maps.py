"""The maps of finished submaps, drawn when they are first asked for, the latest used kept."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np

from datasets.messages import Array
from frontend.local_map import LocalMap
from frontend.nodes import Node, Submap

MEMORY_BYTES = 40 * 1024 * 1024
NEIGHBOURS = 10


class SubmapMaps:
    """Draws submaps on demand within a bound of memory, and knows where their nodes are."""

    def __init__(self, nodes: list[Node], submaps: list[Submap]) -> None:
        self._nodes = nodes
        self._submaps = submaps
        self._maps: OrderedDict[int, LocalMap] = OrderedDict()
        self._positions: dict[int, Array] = {}
        self._radii: list[float] = []

    def drawn(self, submap: Submap) -> bool:
        """Whether a submap's map is at hand."""
        return submap.index in self._maps

    def get(self, submap: Submap) -> LocalMap:
        """The map of a submap, in its anchor's frame, with a few nodes before and after it."""
        found = self._maps.get(submap.index)
        if found is not None:
            self._maps.move_to_end(submap.index)
            return found
        first, last = submap.nodes[0].index, submap.nodes[-1].index
        before: list[Node] = []
        for node in reversed(self._nodes[max(0, first - NEIGHBOURS) : first]):
            if submap.nodes[0].lost or (before and before[-1].lost):
                break
            before.append(node)
        after: list[Node] = []
        for node in self._nodes[last + 1 : last + 1 + NEIGHBOURS]:
            if node.lost:
                break
            after.append(node)
        drawn = submap.draw([*before, *after])
        self._maps[submap.index] = drawn
        while len(self._maps) > 1 and self._size() > MEMORY_BYTES:
            self._maps.popitem(last=False)
        return drawn

    def clear(self) -> None:
        """Forget all maps; those asked for again are drawn again."""
        self._maps.clear()

    def distances_m(self, submap: Submap, position_anchor: Array) -> Array:
        """(K,) from a position to each of the submap's nodes."""
        if submap.index not in self._positions:
            places = [submap.T_anchor_base(node)[:2, 2] for node in submap.nodes]
            self._positions[submap.index] = np.array(places)
        away: Array = np.linalg.norm(self._positions[submap.index] - position_anchor, axis=1)
        return away

    def nearest_bound_m(self, T_map_anchors: Array, position_map: Array) -> Array:
        """(n,) lower bounds of the distance from a position to the nodes of the first n submaps."""
        while len(self._radii) < len(T_map_anchors):
            submap = self._submaps[len(self._radii)]
            self._radii.append(float(self.distances_m(submap, np.zeros(2)).max()))
        away = np.linalg.norm(T_map_anchors[:, :2, 2] - position_map, axis=1)
        bound: Array = away - np.array(self._radii[: len(T_map_anchors)])
        return bound

    def _size(self) -> int:
        return sum(drawn.memory_bytes for drawn in self._maps.values())
