"""The scans that a pipeline took in, and what is drawn from them at some poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from datasets.se2 import inverse, transform
from datasets.trajectory import Trajectory
from slam.occupancy import ScanStore


@dataclass(frozen=True, slots=True)
class ScanRecord:
    """A scan that was taken in.

    stamp_ns as recorded; points_base : (N, 2) float32, hits de-skewed to ``moment_ns``, to which
    T_odom_base belongs too.
    """

    stamp_ns: int
    moment_ns: int
    lidar: str
    points_base: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    T_odom_base: Array
    way_m: float
    matched: bool


@dataclass(frozen=True, slots=True)
class Poses:
    """T_map_scans, T_map_nodes : at the moments of the pipeline's records and of its nodes.

    trajectory : T_map_base at the scans' stamps.
    """

    T_map_scans: Array
    T_map_nodes: Array
    trajectory: Trajectory


def scan_store(
    records: Sequence[ScanRecord], origins_base: Mapping[str, Array], poses: Poses
) -> ScanStore:
    """All scans as a run folder keeps them: their points seen from the base at their stamps.

    origins_base : (2,) by lidar, where it stands.
    """
    stamps = np.array([record.stamp_ns for record in records], dtype=np.int64)
    rows = np.searchsorted(poses.trajectory.stamps_ns, stamps)
    T_map_stamps = poses.trajectory.matrices()[rows]
    points = [
        transform(inverse(T_map_stamp) @ T_map_moment, record.points_base.astype(np.float64))
        for record, T_map_stamp, T_map_moment in zip(
            records, T_map_stamps, poses.T_map_scans, strict=True
        )
    ]
    lidars = sorted({record.lidar for record in records})
    origins = {name: origins_base[name] for name in lidars}
    return ScanStore.from_scans(
        stamps.tolist(), [record.lidar for record in records], points, origins
    )
