"""Tables 1 and 2 beside the paper's: where the maps have the corners of the low obstacles."""

from __future__ import annotations

from collections.abc import Sequence

from slam.lab.drives.rows import PointRow
from slam.lab.drives.systems import CAMERA, CAMERA_PAPER, FUSED, FUSED_PAPER, LIDAR
from slam.lab.page import table
from slam.lab.tables import paper_tables as paper
from slam.lab.tables.spread import NOTHING, by_system, mean_of, mean_spread, number

COLUMNS = {
    1: (LIDAR.name, CAMERA_PAPER.name, CAMERA.name),
    2: (LIDAR.name, FUSED_PAPER.name, FUSED.name),
}


def points_table(which: int, rows: Sequence[PointRow]) -> str:
    """Table 1 or 2: in each cell the mean place, and the error's mean and spread over the seeds."""
    columns = [name for name in COLUMNS[which] if any(row.system == name for row in rows)]
    head = ["", "true, m", "paper, m", "paper's error", *columns]
    body = []
    for printed in paper.MAP_POINTS:
        found_m, error_m = printed.camera_m, printed.camera_error_m
        if which == 2:
            found_m, error_m = printed.fused_m, printed.fused_error_m
        cells = [printed.name, _place(printed.true_m), _place(found_m), number(error_m)]
        for name in columns:
            own = [row for row in rows if row.system == name and row.point == printed.name]
            cells.append(_cell(own))
        body.append(cells)
    mean_m = paper.MAP_POINT_MEAN_CAMERA_M if which == 1 else paper.MAP_POINT_MEAN_FUSED_M
    errors = paper.map_point_errors_m()[which - 1]
    printed_mean = f"{mean_m:g} (recomputed {errors.mean():.3f})"
    of_system = by_system(rows)
    means = [f"**{_mean_cell(of_system[name])}**" for name in columns]
    body.append(["**mean**", "", "", printed_mean, *means])
    return table(head, body)


def mean_error_m(rows: Sequence[PointRow], system: str) -> tuple[float | None, int]:
    """(mean error of the corners that were found, how many were not)."""
    own = [row for row in rows if row.system == system]
    return mean_of(row.error_m for row in own), sum(row.error_m is None for row in own)


def _cell(rows: Sequence[PointRow]) -> str:
    found = [row for row in rows if row.error_m is not None]
    share = f"in {len(found)} of {len(rows)} maps"
    if not found:
        return share
    x_m, y_m = mean_of(row.found_x_m for row in found), mean_of(row.found_y_m for row in found)
    assert x_m is not None  # some were found
    assert y_m is not None
    error = mean_spread(row.error_m for row in found)
    return f"{_place((x_m, y_m))}, error {error}, {share}"


def _mean_cell(rows: Sequence[PointRow]) -> str:
    seeds = sorted({row.seed for row in rows})
    means = [mean_of(row.error_m for row in rows if row.seed == seed) for seed in seeds]
    found = sum(row.error_m is not None for row in rows)
    if not found:
        return NOTHING
    return f"{mean_spread(means)}, {found} of {len(rows)} found"


def _place(point_m: tuple[float, float]) -> str:
    return f"({point_m[0]:.3f}, {point_m[1]:.3f})"
