"""What the tables must reach, and whether they do."""

from __future__ import annotations

from collections.abc import Iterator

from slam.benchmark_page import Bar, Value
from slam.experiments.rows import Rows
from slam.experiments.spread import mean_of
from slam.experiments.systems import FUSED, LIDAR
from slam.experiments.table_corridors import low_f1, off_percent
from slam.experiments.table_points import mean_error_m
from slam.experiments.table_scores import mean_errors, scored_errors

Judged = tuple[Bar, Value]


def judged(rows: Rows) -> list[Judged]:
    """Every bar whose table was made, from rows without hard conditions.

    The fused system is that of the better mode.
    """
    parts = (_points, _beams, _corridors, _constraints, _obstacles)
    return [each for part in parts for each in part(rows)]


def _points(rows: Rows) -> Iterator[Judged]:
    error_m, missing = mean_error_m(rows.points, FUSED.name)
    if error_m is not None:
        bar = Bar("table 2, mean map point error, fused", "m", 0.08, 0.04, 3)
        how = f"{missing} corners not found" if missing else "every corner found"
        yield bar, Value(error_m, how, met=not missing)


def _beams(rows: Rows) -> Iterator[Judged]:
    own = [row for row in rows.beam_errors if row.system == FUSED.name]
    mae_m, rmse_m = mean_of(row.mae_m for row in own), mean_of(row.rmse_m for row in own)
    if mae_m is not None and rmse_m is not None:
        scans = f"{sum(row.scans for row in own)} scans"
        yield Bar("table 3, MAE, fused", "m", 0.030, 0.015, 4), Value(mae_m, scans)
        yield Bar("table 3, RMSE, fused", "m", 0.035, 0.020, 4), Value(rmse_m, scans)


def _corridors(rows: Rows) -> Iterator[Judged]:
    own = {
        name: [row for row in rows.restoration if row.system == name]
        for name in (FUSED.name, LIDAR.name)
    }
    off, lidar_off = off_percent(own[FUSED.name]), off_percent(own[LIDAR.name])
    if not off or not lidar_off:
        return
    missing = sum(row.gamma_percent is None for row in own[FUSED.name])
    how = f"{len(own[FUSED.name])} corridors, {missing} ghosted or not found"
    worst = Bar("table 4, largest abs(100 - gamma), fused", "%", 0.5, 0.2, 3)
    yield worst, Value(max(off), how, met=not missing)
    mean, lidar_mean = sum(off) / len(off), sum(lidar_off) / len(lidar_off)
    words = "not worse than the lidar alone"
    yield (
        Bar("the same, mean", "%", words, None, 4),
        Value(mean, f"the lidar alone {lidar_mean:.4f} %", met=mean <= lidar_mean),
    )


def _constraints(rows: Rows) -> Iterator[Judged]:
    """Those that stay in the systems' graphs, and all that table 5 scores."""
    kinds = (
        ("constraints that stay in the graph", _kept_errors(rows)),
        (
            "constraints of table 5",
            (mean_errors(rows.constraints, FUSED.name), mean_errors(rows.constraints, LIDAR.name)),
        ),
    )
    for what, (of_fused, of_lidar) in kinds:
        for k, (unit, aim, decimals) in enumerate((("m", 0.02, 4), ("deg", 0.2, 3))):
            fused, lidar = of_fused[k], of_lidar[k]
            if fused is None or lidar is None:
                continue
            bar = Bar(
                f"{what} against the truth, mean error, fused (aim {aim:g} {unit})",
                unit,
                "not worse than the lidar alone",
                aim,
                decimals,
            )
            how = f"the lidar alone {lidar:.{decimals}f} {unit}"
            yield bar, Value(fused, how, met=fused <= lidar)
    (error_m, false), (lidar_m, lidar_false) = (
        scored_errors(rows.constraints, system.name) for system in (FUSED, LIDAR)
    )
    if error_m is not None and lidar_m is not None:
        bar = Bar("the same, with those that slide along a wall, fused", "m", None, None, 4)
        how = f"{false} false; the lidar alone {lidar_m:.4f} m, {lidar_false} false"
        yield bar, Value(error_m, how)
    own = [row for row in rows.closures if row.system == FUSED.name]
    if own:
        false = sum(row.false_kept for row in own)
        kept = sum(row.kept for row in own)
        bar = Bar("false closures that stay in the graph, fused", "", 0.0, 0.0, 0)
        yield bar, Value(false, f"of {kept} that stay")


Errors = tuple[float | None, float | None]


def _kept_errors(rows: Rows) -> tuple[Errors, Errors]:
    """(m, deg) of all closures that stay, of the fused system and of the lidar alone."""

    def of(system: str) -> Errors:
        own = [row for row in rows.closures if row.system == system and row.kept]
        kept = sum(row.kept for row in own)
        if not kept:
            return None, None
        metres = sum(row.kept * (row.kept_error_m or 0.0) for row in own) / kept
        degrees = sum(row.kept * (row.kept_error_deg or 0.0) for row in own) / kept
        return metres, degrees

    return of(FUSED.name), of(LIDAR.name)


def _obstacles(rows: Rows) -> Iterator[Judged]:
    f1 = low_f1(rows.obstacles, FUSED.name)
    if f1 is not None:
        bar = Bar("low obstacles of the ring, F1, fused", "", 0.95, 0.99, 3, at_least=True)
        yield bar, Value(f1)
