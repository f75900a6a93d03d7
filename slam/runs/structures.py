"""The lengths of structures in the map of a run (paper, table 4), from its scans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from datasets.messages import Array
from datasets.se2 import compose
from datasets.simulation.place import Structure
from datasets.trajectory import Trajectory
from slam.evaluation.restoration import Ghosted, NotRestored, Restoration, restoration
from slam.evaluation.structures_file import MeasuredStructure
from slam.mapping.scan_store import CLEAR, LIDAR, ScanStore

Ends = tuple[Array, Array]


def measured(
    structures: Sequence[tuple[Structure, Ends, float]], scans: ScanStore, T_map_base: Trajectory
) -> list[Restoration]:
    """Measure structures, each with where its ends should be in the map and its width, m.

    The points are those of the highest lidar's layer; of a run without a lidar, the cameras'.
    """
    points_map, origins_map = _points(scans, T_map_base)
    return [
        restoration(
            structure, points_map, origins_map=origins_map, ends_map=ends_map, width_m=width_m
        )
        for structure, ends_map, width_m in structures
    ]


def measured_of_file(
    structures: Sequence[MeasuredStructure], scans: ScanStore, T_map_base: Trajectory
) -> list[Restoration]:
    """The structures of a user's file, whose ends lie in this map."""
    wanted = [
        (each.structure, (np.array(each.structure.start_m), np.array(each.structure.end_m)),
         each.width_m)
        for each in structures
    ]  # fmt: skip
    return measured(wanted, scans, T_map_base)


def restoration_line(result: Restoration) -> str:
    """A structure in words."""
    if isinstance(result, NotRestored):
        return f"{result.name}: not found: {result.reason}"
    if isinstance(result, Ghosted):
        lengths = " or ".join(f"{each:.3f}" for each in result.measured_m)
        gammas = " or ".join(f"{each:.2f}" for each in result.gamma_percent)
        ends = " and ".join(result.ends)
        return (
            f"{result.name}: ghosted, the wall at its {ends} is there twice: "
            f"{lengths} m of {result.true_m:.3f} m, gamma {gammas} %"
        )
    doubt = 100.0 * result.std_m / result.true_m
    return (
        f"{result.name}: {result.measured_m:.3f} m +/- {result.std_m:.3f} of "
        f"{result.true_m:.3f} m, gamma {result.gamma_percent:.2f} % +/- {doubt:.2f}"
    )


def restoration_dict(result: Restoration) -> dict[str, Any]:
    """A structure as plain data; ``found`` is "yes", "ghosted" or "no"."""
    if isinstance(result, NotRestored):
        return {"name": result.name, "found": "no", "reason": result.reason}
    common = {"name": result.name, "true_m": result.true_m}
    if isinstance(result, Ghosted):
        return {
            **common,
            "found": "ghosted",
            "ends": list(result.ends),
            "measured_m": list(result.measured_m),
            "gamma_percent": list(result.gamma_percent),
        }
    return {
        **common,
        "found": "yes",
        "measured_m": result.measured_m,
        "std_m": result.std_m,
        "gamma_percent": result.gamma_percent,
        "gamma_std_percent": 100.0 * result.std_m / result.true_m,
        "residual_m": list(result.residual_m),
    }


def measured_layer(scans: ScanStore) -> ScanStore:
    """The scans of the highest lidar's layer; of a run without a lidar, the cameras'."""
    names = scans.layer_names
    if not names:
        return scans
    lidars = [name for name in names if name == LIDAR or name.startswith(f"{LIDAR} ")]
    # A layer's name ends in its height, if there are several: the highest is the last.
    return scans.of_layer(lidars[-1] if lidars else names[0])


def _points(scans: ScanStore, T_map_base: Trajectory) -> tuple[Array, Array]:
    """(N, 2) points that were hit, in the map, and (N, 2) where the sensor stood for each."""
    own = measured_layer(scans)
    hit = own.roles != CLEAR
    scan = np.repeat(np.arange(len(own)), np.diff(own.offsets))[hit]
    poses = T_map_base.at(own.stamps_ns)[scan]
    here = own.origins_base[own.sensor_index[scan]]

    def placed(points_base: Array) -> Array:
        flat = np.column_stack([points_base, np.zeros(len(points_base))])
        return compose(poses, flat)[:, :2]

    return placed(own.points_base[hit].astype(np.float64)), placed(here)
