"""What the tables must reach, and whether they do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from slam.lab.drives.rows import ConstraintRow, Rows
from slam.lab.drives.systems import FUSED, LIDAR
from slam.lab.page import Bar, Value
from slam.lab.tables.spread import mean_of
from slam.lab.tables.table_corridors import low_f1, off_percent
from slam.lab.tables.table_points import mean_error_m
from slam.lab.tables.table_scores import closure_errors, mean_errors, scored_errors

Judged = tuple[Bar, Value]

NOT_WORSE = "not worse than the lidar alone, by more than the standard error of the difference"


def judged(rows: Rows) -> list[Judged]:
    """Every bar whose table was made, from rows without hard conditions.

    The fused system is that of the better mode.
    """
    parts = (_points, _beams, _corridors, _constraints, _obstacles)
    return [each for part in parts for each in part(rows)]


def time_taken(rows: Rows, minutes: float) -> Judged:
    """Wall time of all tables, without hard conditions; the bar is one of ten seeds."""
    seeds = len({row.seed for row in rows.trajectories})
    must, aim = (60.0, 25.0) if seeds == 10 else (None, None)
    bar = Bar("tables 1-5, ten seeds, wall time", "min", must, aim, 1)
    return bar, Value(minutes, f"{seeds} seeds, hard conditions not counted")


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
    """Those of table 5, thousands; the systems' own closures are a dozen, and are told beside."""
    for k, (unit, aim, decimals) in enumerate((("m", 0.02, 4), ("deg", 0.2, 3))):
        fused, lidar = (mean_errors(rows.constraints, each.name)[k] for each in (FUSED, LIDAR))
        if fused is None or lidar is None:
            continue
        what = f"constraints of table 5 against the truth, mean error, fused (aim {aim:g} {unit})"
        bar = Bar(what, unit, NOT_WORSE, aim, decimals)
        mean, error = _difference(rows.constraints, k)
        how = f"the lidar alone {lidar:.{decimals}f} {unit}; from drive to drive the difference is "
        how += f"{mean:+.{decimals}f} ± {error:.{decimals}f} {unit}"
        yield bar, Value(fused, how, met=fused <= lidar or mean <= error)
    (error_m, false), (lidar_m, lidar_false) = (
        scored_errors(rows.constraints, system.name) for system in (FUSED, LIDAR)
    )
    if error_m is not None and lidar_m is not None:
        bar = Bar(
            "the same, with those that slide or fit elsewhere as well, fused", "m", None, None, 4
        )
        how = f"{false} false; the lidar alone {lidar_m:.4f} m, {lidar_false} false"
        yield bar, Value(error_m, how)
    closures, of_lidar_alone = (
        [row for row in rows.closures if row.system == system.name] for system in (FUSED, LIDAR)
    )
    if closures:
        false, kept = (
            sum(getattr(row, name) for row in closures) for name in ("false_kept", "kept")
        )
        bar = Bar("false closures that stay in the graph, fused", "", 0.0, 0.0, 0)
        yield bar, Value(false, f"of {kept} that stay")
    kept_m, lidar_kept_m = closure_errors(closures), closure_errors(of_lidar_alone)
    if kept_m and lidar_kept_m:
        bar = Bar("closures that stay in the graph, mean error, fused", "m", None, None, 4)
        how = f"{_with_error(kept_m)}; the lidar alone {_with_error(lidar_kept_m)}"
        yield bar, Value(sum(kept_m) / len(kept_m), how)


def _difference(rows: Sequence[ConstraintRow], k: int) -> tuple[float, float]:
    """Mean over the drives of fused less lidar alone, and its standard error.

    The two differ by what a handful of false ones among thousands come to: neither is worse by
    less than that. k : 0 of m, 1 of deg.
    """
    both: list[float] = []
    for seed in sorted({row.seed for row in rows}):
        own = [row for row in rows if row.seed == seed]
        fused, lidar = (mean_errors(own, each.name)[k] for each in (FUSED, LIDAR))
        if fused is not None and lidar is not None:
            both.append(fused - lidar)
    if len(both) < 2:
        return sum(both), 0.0
    return float(np.mean(both)), float(np.std(both, ddof=1)) / len(both) ** 0.5


def _with_error(of_drives: Sequence[float]) -> str:
    """Mean over the drives and its standard error."""
    mean, count = sum(of_drives) / len(of_drives), len(of_drives)
    error = f" ± {np.std(of_drives, ddof=1) / count**0.5:.4f}" if count > 1 else ""
    return f"{mean:.4f}{error} m over {count} drives"


def _obstacles(rows: Rows) -> Iterator[Judged]:
    f1 = low_f1(rows.obstacles, FUSED.name)
    if f1 is not None:
        bar = Bar("low obstacles of the ring, F1, fused", "", 0.95, 0.99, 3, at_least=True)
        yield bar, Value(f1)
