"""The page of results: every table beside the paper's, the bars, and how all of it was made."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

from datasets.simulation.place import load_place
from datasets.simulation.robot import ROBOTS
from slam.lab.drives.constraints import PROTOCOL
from slam.lab.drives.drives import DRIVES
from slam.lab.drives.rows import CostRow, FailureRow, Rows
from slam.lab.drives.systems import every_system
from slam.lab.page import table
from slam.lab.tables.bars import Judged, judged, time_taken
from slam.lab.tables.findings import findings
from slam.lab.tables.page_words import (
    BEAMS,
    CLOSURES,
    CORRIDORS,
    INTRODUCTION,
    OBSTACLES,
    POINTS,
    SCORES,
    WORTH,
)
from slam.lab.tables.spread import by_system, mean_spread
from slam.lab.tables.table_beams import beams_table
from slam.lab.tables.table_corridors import corridors_table, obstacles_table
from slam.lab.tables.table_hard import conditions_list, hard_table
from slam.lab.tables.table_points import points_table
from slam.lab.tables.table_scores import closures_table, scores_table, worth_table


def page(
    rows: Rows,
    tables: Collection[int],
    facts: Mapping[str, str],
    pictures: Sequence[str],
    minutes: float,
) -> str:
    """The whole page as Markdown.

    pictures : names of those that lie beside it. minutes : wall time of what the tables need.
    """
    parts = ["# Results", INTRODUCTION, table(("", ""), list(facts.items()))]
    usual = standard(rows)
    bars = judged(usual)
    if bars and set(tables) == {1, 2, 3, 4, 5}:
        bars.append(time_taken(usual, minutes))
    if bars:
        parts += ["## What was to be reached", bars_table(bars)]
    said = findings(usual)
    if said:
        parts += ["## What does not favour fusion, and why", *said]
    parts += _points(rows, tables, pictures)
    if 3 in tables and rows.beam_errors:
        parts += ["## Table 3: ten beams", BEAMS, beams_table(rows.beams, rows.beam_errors)]
    parts += _ring(usual, tables, pictures)
    driven_hard = {row.condition for row in rows.cost} - {""}
    if driven_hard:
        parts += ["## Hard conditions", conditions_list(), hard_table(rows)]
    if rows.failures:
        parts += ["## What failed", failures_table(rows.failures)]
    parts += ["## What was compared, and on which drives", systems_table(), drives_table()]
    parts += ["## What it cost", cost_table(rows.cost)]
    return "\n\n".join(parts) + "\n"


def bars_table(bars: Sequence[Judged]) -> str:
    """Each bar, what was measured, and the verdict."""
    body = [
        [
            bar.what,
            bar.words(bar.must).strip(),
            bar.words(bar.aim).strip(),
            bar.words(value.value, bar.decimals).strip(),
            _emphasised(bar.verdict(value)),
            value.how,
        ]
        for bar, value in bars
    ]
    return table(("what", "must", "aim", "measured", "verdict", ""), body)


def failures_table(rows: Sequence[FailureRow]) -> str:
    """Drives and systems without figures."""
    body = [
        [row.condition, row.place, str(row.seed), row.system, row.what, row.reason] for row in rows
    ]
    return table(("condition", "place", "seed", "system", "what", "why"), body)


def systems_table() -> str:
    """How each system differs from the default configuration."""
    body = [
        [system.name, " ".join(f"`--set {each}`" for each in system.settings) or "the defaults"]
        for system in every_system()
    ]
    return table(("system", "differs from the defaults of `slam config` by"), body)


def drives_table() -> str:
    """The drives of the tables, and what their robots see with."""
    body = []
    for place, drive in DRIVES.items():
        spec = load_place(place).drives[drive]
        robot = ROBOTS[spec.robot]
        (lidar,), (camera,) = robot.lidars.values(), robot.cameras.values()
        body.append(
            [
                f"`{place}`, `{drive}`",
                f"`{spec.robot}`",
                f"{lidar.T_base_lidar[2, 3]:g} m high, {lidar.model.turn_rate_hz:g} Hz",
                f"{camera.T_base_camera[2, 3]:g} m high, "
                f"{camera.model.mode}, {camera.rate_hz:g} Hz",
            ]
        )
    return table(("place and drive", "robot", "lidar", "depth camera"), body)


def cost_table(rows: Sequence[CostRow]) -> str:
    """CPU seconds of one seed by place and stage, hard conditions left out."""
    stages: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        if not row.condition:
            stages.setdefault((row.place, row.stage), []).append(row.cpu_s)
    body = [[place, stage, mean_spread(cpu_s, 1)] for (place, stage), cpu_s in stages.items()]
    seeds = {row.seed for row in rows if not row.condition}
    total_s = sum(row.cpu_s for row in rows if not row.condition)
    if seeds:
        body.append(["**all**", "", f"**{total_s / len(seeds):.0f}**"])
    return table(("place", "stage", "CPU seconds of one seed"), body)


def _points(rows: Rows, tables: Collection[int], pictures: Sequence[str]) -> Iterator[str]:
    asked = [which for which in (1, 2) if which in tables and rows.points]
    if not asked:
        return
    yield "## Tables 1 and 2: low obstacles in the map of a room"
    yield POINTS
    for which, title in ((1, "camera only"), (2, "fused")):
        if which in asked:
            yield f"### Table {which}, {title}"
            yield points_table(which, rows.points)
    yield from _shown("results-room.png", pictures, "The maps of the room, of the first seed")
    yield trajectories(rows, "room")


def _ring(rows: Rows, tables: Collection[int], pictures: Sequence[str]) -> Iterator[str]:
    if 4 in tables and rows.restoration:
        yield "## Table 4: scene restoration degree"
        yield CORRIDORS
        yield corridors_table(rows.restoration)
        yield "### Obstacles in these maps"
        yield OBSTACLES
        yield obstacles_table(rows.obstacles)
        yield from _shown("results-ring.png", pictures, "The maps of the ring, of the first seed")
    if 5 in tables and rows.constraints:
        yield "## Table 5: constraint matching score"
        yield SCORES
        yield scores_table(rows.constraints)
        yield f"Equal over the rows: {PROTOCOL}."
        yield "### What the constraints are worth"
        yield WORTH
        yield worth_table(rows.constraints)
    if {4, 5} & set(tables) and rows.closures:
        yield "### Closures in the graphs, and trajectories"
        yield CLOSURES
        ways = [row for row in rows.trajectories if row.place == "ring-corridor"]
        yield closures_table(rows.closures, ways)


def trajectories(rows: Rows, place: str) -> str:
    """ATE of each system in one place."""
    ways = [row for row in rows.trajectories if row.place == place and not row.condition]
    body = [
        [
            name,
            mean_spread((row.ate_m for row in own), 4),
            mean_spread(row.ate_deg for row in own),
            mean_spread((row.cpu_s for row in own), 1),
        ]
        for name, own in by_system(ways).items()
    ]
    return table((place, "ATE rmse, m", "ATE, deg", "CPU, s"), body)


def _shown(name: str, pictures: Sequence[str], caption: str) -> Iterator[str]:
    if name in pictures:
        yield f"![{caption}]({name})"


def standard(rows: Rows) -> Rows:
    """Without the hard conditions."""
    return Rows(
        points=rows.points,
        beams=rows.beams,
        beam_errors=rows.beam_errors,
        restoration=[row for row in rows.restoration if not row.condition],
        constraints=rows.constraints,
        closures=[row for row in rows.closures if not row.condition],
        obstacles=[row for row in rows.obstacles if not row.condition],
        trajectories=[row for row in rows.trajectories if not row.condition],
    )


def _emphasised(verdict: str) -> str:
    return f"**{verdict}**" if verdict == "MISSED" else verdict
