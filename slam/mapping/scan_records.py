"""The scans and views that a pipeline took in, and what is drawn from them at some poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.se2 import inverse, transform
from datasets.trajectory import Trajectory
from slam.mapping.camera_records import ViewRecord
from slam.mapping.scan_store import BEAM, ScanStore


@dataclass(frozen=True, slots=True)
class ScanRecord:
    """A scan that was taken in.

    stamp_ns as recorded; points_base : (N, 2) float32, hits de-skewed to ``moment_ns``, to which
    T_odom_base belongs too.
    """

    stamp_ns: int
    moment_ns: int
    sensor: str
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
    records: Sequence[ScanRecord],
    origins_base: Mapping[str, Array],
    poses: Poses,
    layers: Mapping[str, str],
    views: Sequence[ViewRecord] = (),
) -> ScanStore:
    """All scans as a run folder keeps them: their points seen from the base at their stamps.

    origins_base : (2,) by sensor, where it stands. layers : of the map, by sensor.
    views        : of the cameras. Those from before the trajectory's first pose and after its last
                   are left out: nothing says where they were taken.
    """
    stamps = np.array([record.stamp_ns for record in records], dtype=np.int64)
    rows = np.searchsorted(poses.trajectory.stamps_ns, stamps)
    T_map_stamps = poses.trajectory.matrices()[rows]
    points: list[npt.NDArray[np.floating]] = [
        transform(inverse(T_map_stamp) @ T_map_moment, record.points_base.astype(np.float64))
        for record, T_map_stamp, T_map_moment in zip(
            records, T_map_stamps, poses.T_map_scans, strict=True
        )
    ]
    origins = {record.sensor: origins_base[record.sensor] for record in records}
    sensors = [record.sensor for record in records]
    roles = [np.full(len(each), BEAM, np.uint8) for each in points]
    first_ns, last_ns = poses.trajectory.stamps_ns[[0, -1]]
    placed = [view for view in views if first_ns <= view.stamp_ns <= last_ns]
    all_stamps = np.concatenate([stamps, np.array([v.stamp_ns for v in placed], np.int64)])
    order = np.argsort(all_stamps, kind="stable").tolist()
    sensors += [view.sensor for view in placed]
    points += [view.points_base for view in placed]
    roles += [view.roles for view in placed]
    return ScanStore.from_scans(
        all_stamps[order].tolist(),
        [sensors[i] for i in order],
        [points[i] for i in order],
        origins | {view.sensor: view.origin_base for view in placed},
        roles=[roles[i] for i in order],
        layers=layers,
        clear_from_m={view.sensor: view.clear_from_m for view in placed},
    )
