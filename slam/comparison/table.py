"""The table of a comparison: Markdown and terminal (a measure a line), CSV (a map a line)."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from slam.evaluation.match_scores import ScoreGridConfig

Row = Mapping[str, Any]

GRIDS = ScoreGridConfig()
COUNTED = f"""\
* **map size**: the rectangle around all cells that are known. **free**, **occupied**: by the
  thresholds of the map.
* **groups the other map lacks**: connected groups of occupied cells (corners included, two cells
  or more), each cell farther than 15 cm from every occupied cell of the lidar's map, after the
  difference between the two trajectories at the nearest pose was taken out. For the lidar's own
  map the other one is the fused. **in its free space**: those groups of which the other map calls
  half or more free: a robot that trusts it would drive into them.
* **obstacles**: recall is the share of what the cameras could have seen of the place's surfaces
  between 0.05 and 1 m that has an occupied cell within 10 cm; precision is the share of the
  occupied cells in the cameras' view that lie within 10 cm of something. Low ones lie below the
  lidars' planes.
* **match score**: the mean probability of a submap's grid under the scan that a constraint joins
  to it, as in docs/measures.md: of steps from one submap to the next, and of loops that stayed. In
  the highest lidar's layer, on equal grids ({GRIDS}).
  Scores of a camera and of a lidar are not comparable; nor is a single grid with a layer.
* **way not observed**: driven where the scans did not show the way along. **ATE**: against the
  ground truth, SE(2) aligned.
* **CPU, wall time**: of reading, mapping, finishing, drawing and writing this one; the first may
  hold the compiling of kernels.
"""


def measures(rows: Sequence[Row]) -> list[tuple[str, list[str]]]:
    """(measure with its unit, a cell for each row); without those that no row has."""
    lines: list[tuple[str, Callable[[Row], str]]] = [
        ("state", lambda row: row["status"]),
        ("way driven, m", lambda row: _number(row.get("way_m"), 1)),
        ("scans, without a match", _scans),
        ("times lost", lambda row: _number(row.get("lost"), 0)),
        ("way not observed, m", lambda row: _number(row.get("unobserved_way_m"), 1)),
        ("map size, m", _size),
        ("free, m2", lambda row: _number(_of(row, "map", "free_m2"), 1)),
        ("occupied cells", lambda row: _number(_of(row, "map", "occupied_cells"), 0)),
        ("groups the other map lacks", lambda row: _groups(row, "groups")),
        ("their area, m2", lambda row: _number(_of(row, "lacked", "area_m2"), 2)),
        ("in its free space", lambda row: _number(_of(row, "lacked", "free_groups"), 0)),
        *_obstacle_lines(),
        ("loops kept / accepted / searched", _loops),
        ("match score of steps: min / mean / max", lambda row: _scores(row, "steps")),
        ("match score of loops: min / mean / max", lambda row: _scores(row, "loops")),
        ("ATE rmse, m", lambda row: _number(row.get("ate_m"), 4)),
        ("ATE rmse, deg", lambda row: _number(row.get("ate_deg"), 3)),
        *_structure_lines(rows),
        ("CPU, s", lambda row: _number(row.get("cpu_s"), 1)),
        ("wall time, s", lambda row: _number(row.get("wall_s"), 1)),
    ]
    table = [(name, [cell(row) for row in rows]) for name, cell in lines]
    return [(name, cells) for name, cells in table if any(cells)]


def table_markdown(name: str, rows: Sequence[Row], *, partial: bool) -> str:
    """The whole page: table, picture, why parts are missing, what is counted."""
    lines = [f"# {name}: its maps compared", ""]
    if partial:
        lines += ["**PARTIAL**: interrupted, this is what was mapped so far.", ""]
    lines += [
        "| | " + " | ".join(str(row["name"]) for row in rows) + " |",
        "|---" * (len(rows) + 1) + "|",
        *("| " + " | ".join([measure, *cells]) + " |" for measure, cells in measures(rows)),
        "",
    ]
    lines += [f"* **{row['name']}**: {row['words']}" for row in rows]
    lines += [f"* {line}" for line in missing_lines(rows)]
    return "\n".join([*lines, "", "![The maps](compare.png)", "", COUNTED])


def missing_lines(rows: Sequence[Row]) -> list[str]:
    """Why some rows have no map, and which structures were not measured, a line each."""
    lines = [f"no map of {row['name']}: {row['why']}" for row in rows if row["why"]]
    for row in rows:
        for each in row.get("structures", ()):
            if each["found"] == "no":
                lines.append(f"{each['name']} not measured in {row['name']}: {each['reason']}")
            elif each["found"] == "ghosted":
                lines.append(
                    f"{each['name']} ghosted in {row['name']}: the wall at its "
                    f"{' and '.join(each['ends'])} is there twice"
                )
    return lines


def table_csv(rows: Sequence[Row]) -> str:
    """One line a map; nested data in columns of their own, ``obstacles.low.recall``."""
    flat = [_flat(row) for row in rows]
    columns = list(dict.fromkeys(key for row in flat for key in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerows(flat)
    return buffer.getvalue()


def panel_words(row: Row) -> str:
    """What stands above a map in the picture, or in its place where there is none."""
    if "map" not in row:
        return f"no map: {row['why']}"
    words = [f"{_number(_of(row, 'map', 'free_m2'), 0)} m2 free"]
    recall = _of(row, "obstacles", "low", "recall")
    if recall is not None:
        words.append(f"low obstacles {recall:.0%}")
    elif _of(row, "lacked", "groups") is not None:
        words.append(f"{row['lacked']['groups']} things that {row['lacked']['by']} lacks")
    if row.get("ate_m") is not None:
        words.append(f"ATE {row['ate_m']:.3f} m")
    if row["status"] == "partial":
        words.insert(0, "PARTIAL")
    return ", ".join(words)


def _flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            out |= _flat(value, f"{prefix}{key}.")
        elif key == "structures":
            for each in value:
                name = f"{prefix}gamma_percent.{each['name']}"
                gamma = each.get("gamma_percent")
                out[name] = " or ".join(map(str, gamma)) if isinstance(gamma, list) else gamma
        else:
            out[f"{prefix}{key}"] = value
    return out


def _of(row: Row, *keys: str) -> float | None:
    """A number that may not be there, or at any depth nothing to hold it."""
    value: object = row
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value if isinstance(value, int | float) else None


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100.0 * value:.1f} %"


def _scans(row: Row) -> str:
    return f"{row['scans']}, {row['scans_unmatched']}" if "scans" in row else ""


def _size(row: Row) -> str:
    size = row.get("map")
    return f"{size['width_m']:.1f} x {size['height_m']:.1f}" if size else ""


def _groups(row: Row, key: str) -> str:
    lacked = row.get("lacked")
    return f"{lacked[key]} ({lacked['by']})" if lacked else ""


def _loops(row: Row) -> str:
    if "loops_kept" not in row:
        return ""
    return f"{row['loops_kept']} / {row['loops_accepted']} / {row['loops_searched']}"


def _scores(row: Row, of: str) -> str:
    found = row.get("match_scores", {}).get(of)
    if not found or not found["accepted"]:
        return ""
    values = " / ".join(f"{found[key]:.3f}" for key in ("minimum", "mean", "maximum"))
    return f"{values} (n = {found['accepted']})"


def _obstacle_lines() -> list[tuple[str, Callable[[Row], str]]]:
    def line(of: str, measure: str) -> Callable[[Row], str]:
        return lambda row: _percent(_of(row, "obstacles", of, measure))

    def objects(row: Row) -> str:
        found = row.get("obstacles")
        return f"{found['low_objects_found']} of {found['low_objects']}" if found else ""

    return [
        ("low obstacles: objects found", objects),
        *(
            (f"{word}: {measure}", line(of, measure))
            for of, word in (("low", "low obstacles"), ("all", "all obstacles"))
            for measure in ("recall", "precision", "f1")
        ),
    ]


def _structure_lines(rows: Sequence[Row]) -> list[tuple[str, Callable[[Row], str]]]:
    names = dict.fromkeys(each["name"] for row in rows for each in row.get("structures", ()))

    def line(name: str) -> Callable[[Row], str]:
        return lambda row: next(
            (_gamma(each) for each in row.get("structures", ()) if each["name"] == name), ""
        )

    return [(f"gamma of {name}, %", line(name)) for name in names]


def _gamma(structure: Mapping[str, Any]) -> str:
    if structure["found"] == "yes":
        return f"{structure['gamma_percent']:.2f} +/- {structure['gamma_std_percent']:.2f}"
    if structure["found"] == "ghosted":
        return "ghosted: " + " or ".join(f"{each:.2f}" for each in structure["gamma_percent"])
    return "not found"
