"""The drives under hard conditions, condition by condition, system by system."""

from __future__ import annotations

from slam.lab.drives.conditions import CONDITIONS
from slam.lab.drives.rows import Rows
from slam.lab.page import table
from slam.lab.tables.spread import NOTHING, by_system, mean_of, mean_spread, number
from slam.lab.tables.table_corridors import off_percent


def hard_table(rows: Rows) -> str:
    """Corridors, trajectory, low obstacles and closures under each condition that was driven."""
    head = ["condition", "", "abs(100 - gamma), %: mean", "largest", "ghosted or not found"]
    head += ["ATE rmse, m", "low obstacles: F1", "objects found", "false closures kept"]
    body = []
    for condition in CONDITIONS:
        ways = [row for row in rows.trajectories if row.condition == condition.name]
        lengths = by_system([r for r in rows.restoration if r.condition == condition.name])
        low = by_system(
            [r for r in rows.obstacles if r.condition == condition.name and r.what == "low"]
        )
        closures = by_system([r for r in rows.closures if r.condition == condition.name])
        for name, own in by_system(ways).items():
            measured = lengths.get(name, [])
            off, things = off_percent(measured), low.get(name, [])
            missing = sum(row.gamma_percent is None for row in measured)
            found = sum(row.objects_found for row in things)
            body.append(
                [
                    condition.name,
                    name,
                    number(mean_of(off)),
                    number(max(off)) if off else NOTHING,
                    f"{missing} of {len(measured)}",
                    mean_spread(row.ate_m for row in own),
                    mean_spread(row.f1 for row in things),
                    f"{found} of {sum(row.objects for row in things)}",
                    str(sum(row.false_kept for row in closures.get(name, []))),
                ]
            )
    return table(head, body)


def conditions_list() -> str:
    """What each condition is."""
    return "\n".join(f"- **{condition.name}**: {condition.what}" for condition in CONDITIONS)
