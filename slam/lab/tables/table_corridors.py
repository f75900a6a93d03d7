"""Table 4 beside the paper's: how long the corridors came out; and the obstacles in the maps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.lab.drives.rows import ObstacleRow, RestorationRow
from slam.lab.page import table
from slam.lab.tables import paper_tables as paper
from slam.lab.tables.spread import NOTHING, by_system, mean_of, mean_spread


def corridors_table(rows: Sequence[RestorationRow]) -> str:
    """gamma of the four corridors, in percent: mean and spread over the seeds."""
    of_system = by_system(rows)
    head = ["", "paper, lidar", "paper, fused", *of_system]
    body = []
    for number, printed in enumerate(paper.RESTORATION, start=1):
        cells = [f"gamma_{number}", f"{printed.lidar_percent:g}", f"{printed.fused_percent:g}"]
        for own in of_system.values():
            values = [row.gamma_percent for row in own if row.structure == printed.name]
            cells.append(mean_spread(values))
        body.append(cells)
    lidar, fused = (
        [abs(100.0 - gamma) for gamma in column]
        for column in zip(
            *((row.lidar_percent, row.fused_percent) for row in paper.RESTORATION), strict=True
        )
    )
    off = {name: off_percent(own) for name, own in of_system.items()}
    body += [
        [
            "**mean of abs(100 - gamma)**",
            f"{sum(lidar) / len(lidar):.2f}",
            f"{sum(fused) / len(fused):.2f}",
            *(f"**{mean_spread(off_by_seed(own))}**" for own in of_system.values()),
        ],
        [
            "**largest**",
            f"{max(lidar):.2f}",
            f"{max(fused):.2f}",
            *(f"**{max(each):.3f}**" if each else NOTHING for each in off.values()),
        ],
        [
            "spread of the four in a drive",
            *(f"{np.std(each, ddof=1):.2f}" for each in (lidar, fused)),
            *(mean_spread(spread_by_seed(own)) for own in of_system.values()),
        ],
        ["ghosted", "", "", *(_count(own, "ghosted") for own in of_system.values())],
        ["not found", "", "", *(_count(own, "not found") for own in of_system.values())],
    ]
    return table(head, body)


def off_percent(rows: Sequence[RestorationRow]) -> list[float]:
    """abs(100 - gamma) of every corridor that was measured."""
    return [abs(100.0 - row.gamma_percent) for row in rows if row.gamma_percent is not None]


def off_by_seed(rows: Sequence[RestorationRow]) -> list[float | None]:
    """The mean of abs(100 - gamma) over the corridors of each drive."""
    seeds = sorted({row.seed for row in rows})
    return [mean_of(off_percent([row for row in rows if row.seed == seed])) for seed in seeds]


def spread_by_seed(rows: Sequence[RestorationRow]) -> list[float | None]:
    """Standard deviation of gamma over the corridors of each drive: no lidar's scale is in it."""
    spreads: list[float | None] = []
    for seed in sorted({row.seed for row in rows}):
        own = [r.gamma_percent for r in rows if r.seed == seed and r.gamma_percent is not None]
        spreads.append(float(np.std(own, ddof=1)) if len(own) > 1 else None)
    return spreads


def _count(rows: Sequence[RestorationRow], what: str) -> str:
    return f"{sum(row.note.startswith(what) for row in rows)} of {len(rows)}"


def obstacles_table(rows: Sequence[ObstacleRow]) -> str:
    """Recall, precision and F1 of each system's map: all obstacles, and the low ones."""
    head = ["", "recall", "precision", "F1", "low: recall", "precision", "F1", "low objects found"]
    body = []
    for name, own in by_system(rows).items():
        cells = [name]
        for what in ("all", "low"):
            some = [row for row in own if row.what == what]
            cells += [
                mean_spread(row.recall for row in some),
                mean_spread(row.precision for row in some),
                f"**{mean_spread(row.f1 for row in some)}**",
            ]
        low = [row for row in own if row.what == "low"]
        found = f"{sum(row.objects_found for row in low)} of {sum(row.objects for row in low)}"
        missed = sorted({each for row in low for each in row.missed.split(", ") if each})
        cells.append(found + (f"; missed at least once: {', '.join(missed)}" if missed else ""))
        body.append(cells)
    return table(head, body)


def low_f1(rows: Sequence[ObstacleRow], system: str) -> float | None:
    """Mean F1 of the low obstacles over the seeds."""
    return mean_of(row.f1 for row in rows if row.system == system and row.what == "low")
