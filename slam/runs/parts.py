"""A drive that fell into parts whose joint nobody knows: each is delivered by itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam.mapping.scan_records import Poses
from slam.mapping.scan_store import ScanStore
from slam.pipeline import Slam

Labels = npt.NDArray[np.int64]
BETWEEN = -1
"""The label of scans from where tracking was lost to where a new part begins: they lie nowhere."""


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a drive: its poses, and what its sensors saw.

    poses : of its scans alone; of all nodes.
    """

    poses: Poses
    scans: ScanStore


def part_of_scans(pipeline: Slam) -> Labels:
    """(M,) the part of each of the pipeline's scans: 0 is the largest; BETWEEN: of none."""
    labels = np.zeros(len(pipeline.records), dtype=np.int64)
    if pipeline.finished is None or not pipeline.finished.parts.any():
        return labels
    part_of_node: dict[tuple[int, str], tuple[int, bool]] = {}
    for submap in pipeline.submaps[: len(pipeline.finished.parts)]:
        part = int(pipeline.finished.parts[submap.index])
        for node in submap.nodes:
            part_of_node[node.scan.stamp_ns, node.scan.sensor] = (part, node.lost)
    present, since = 0, 0
    for row, record in enumerate(pipeline.records):
        part, is_lost = part_of_node.get((record.stamp_ns, record.sensor), (present, False))
        if is_lost and part != present:
            # nothing says where the base was while tracking was lost
            labels[since:row] = BETWEEN
        if record.matched or part != present:
            since = row + 1
        present = part
        labels[row] = part
    return labels


def parts_of_run(pipeline: Slam, poses: Poses) -> list[Part]:
    """The parts of a drive, the largest first; one, with all there is, where all hangs together."""
    labels = part_of_scans(pipeline)
    if not labels.any():
        return [Part(poses, pipeline.scans(poses))]
    found = []
    for part in range(int(labels.max()) + 1):
        rows = np.flatnonzero(labels == part)
        if rows.size:
            own = pipeline.poses(rows)
            found.append(Part(own, pipeline.scans(own, rows)))
    return found
