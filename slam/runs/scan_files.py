"""The file of a run folder that holds all its scans: arrays, as NumPy writes them."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from datasets.bounds import FARTHEST_M
from slam.mapping.scan_store import BEAM, LIDAR, ScanStore


def write_scans(path: Path, scans: ScanStore) -> None:
    """Write a store. Equal stores give equal bytes. Raises OSError where it cannot be written."""
    # Stored, not deflated: ranges hardly shrink, and the bytes do not depend on zlib's version.
    np.savez(
        path,
        stamps_ns=scans.stamps_ns,
        sensor_index=scans.sensor_index,
        offsets=scans.offsets,
        points_base=scans.points_base,
        roles=scans.roles,
        sensors=np.array(scans.sensors, dtype=np.str_),
        layers=np.array(scans.layers, dtype=np.str_),
        origins_base=scans.origins_base,
        clear_from_m=scans.clear_from_m,
    )


def read_scans(path: Path) -> ScanStore:
    """Read a store back. Earlier versions knew lidars only, in one layer: so their files are read.

    Raises an error of some kind if it is not the file of a store: ``run_folder`` says so.
    """
    # What it holds would be unpacked into memory: no more than is there, as ``write_scans`` writes.
    with zipfile.ZipFile(path) as members:
        if sum(member.file_size for member in members.infolist()) > path.stat().st_size:
            raise ValueError("its arrays unpack to more than it can hold")
    with np.load(path, allow_pickle=False) as arrays:
        earlier = "lidars" in arrays
        sensors = tuple(str(name) for name in arrays["lidars" if earlier else "sensors"])
        count = len(arrays["points_base"])
        layers = [LIDAR] * len(sensors) if earlier else arrays["layers"]
        store = ScanStore(
            stamps_ns=arrays["stamps_ns"],
            sensor_index=arrays["lidar_index" if earlier else "sensor_index"],
            offsets=arrays["offsets"],
            points_base=arrays["points_base"],
            roles=np.full(count, BEAM, np.uint8) if earlier else arrays["roles"],
            sensors=sensors,
            layers=tuple(str(name) for name in layers),
            origins_base=arrays["origins_base"],
            clear_from_m=np.zeros(len(sensors)) if earlier else arrays["clear_from_m"],
        )
    for name in ("points_base", "origins_base", "clear_from_m"):
        if np.abs(getattr(store, name)).max(initial=0.0) > FARTHEST_M:
            raise ValueError(f"{name} is out of range")
    return store
