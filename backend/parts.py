"""Which submaps hang together, by tracking or by closures: the parts of a drive."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from frontend.nodes import Submap

Labels = npt.NDArray[np.int64]


def parts_of(submaps: Sequence[Submap], closures: Iterable[tuple[int, int]]) -> Labels:
    """(S,) the part of each submap; part 0 is the longest, the others follow by their length.

    closures : pairs of submaps that a loop closure joins.

    Consecutive submaps belong together unless tracking was lost between them.
    """
    parent = list(range(len(submaps)))

    def root(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    for submap in submaps[1:]:
        if not submap.nodes[0].lost:
            parent[root(submap.index)] = root(submap.index - 1)
    for a, b in closures:
        parent[root(a)] = root(b)
    roots = [root(k) for k in range(len(submaps))]
    counts: dict[int, int] = {}
    for submap, part in zip(submaps, roots, strict=True):
        counts[part] = counts.get(part, 0) + len(submap.nodes)
    order = sorted(counts, key=lambda part: (-counts[part], roots.index(part)))
    number = {part: k for k, part in enumerate(order)}
    return np.array([number[part] for part in roots], dtype=np.int64)
