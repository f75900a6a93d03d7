"""What a run tells of its fusion: as data for metrics.json and in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fusion.scan import BOTH, CAMERA, LIDAR
from slam.pipeline import Slam

Data = dict[str, Any]

LEAST_AGREEING = 0.1
"""Of the points that views add to scans or share with them, fewer are shared only where a mounting
or a clock is wrong: low things that fill most of a view leave some share of it to walls."""


def fusion_data(pipeline: Slam) -> Data:
    """Which sensors took part, how, and how many points came of each."""
    fusing, config = pipeline.fusing, pipeline.config
    viewed = sorted(fusing.view_counts)
    return {
        "sensors": config.sensors,
        "mode": config.fusion,
        "single_grid": not fusing.keeps_layers,
        "views": {name: fusing.view_counts[name] for name in viewed},
        "cameras_without_view": fusing.cameras_without_view(),
        "scans_without_view": {name: fusing.without_view[name] for name in viewed},
        "view_clocks_s": {
            name: pipeline.view_clocks[name].offset_s for name in sorted(pipeline.view_clocks)
        },
        "points": {
            "lidar": fusing.beams[LIDAR],
            "camera": fusing.beams[CAMERA],
            "both": fusing.beams[BOTH],
            "compared": fusing.compared,
        },
    }


def fusion_lines(metrics: Mapping[str, Any]) -> list[str]:
    """The same for people; nothing where there was nothing to fuse."""
    fusion = metrics["fusion"]
    unused = [
        f"no image of {name} could be used: see 'left out'"
        for name in fusion["cameras_without_view"]
    ]
    if not fusion["views"]:
        return [*unused, "mapped by the lidar alone"] if unused else []
    views = ", ".join(f"{count} of {name}" for name, count in fusion["views"].items())
    lines = [f"views taken in: {views}", *unused]
    if fusion["sensors"] == "camera":
        return [*lines, "mapped by depth cameras alone"]
    points = fusion["points"]
    total = max(points["lidar"] + points["camera"] + points["both"], 1)
    shares = {name: 100.0 * points[name] / total for name in ("camera", "both")}
    grid = "a single grid" if fusion["single_grid"] else "layers"
    lines.append(
        f"{fusion['mode']} mode, {grid}: of the scans' points {shares['both']:.1f} % were seen by "
        f"both, {shares['camera']:.1f} % by the views alone"
    )
    lines += _doubts(fusion)
    for name, count in fusion["scans_without_view"].items():
        if count:
            lines.append(f"scans without a view of {name} near in time, lidar alone there: {count}")
    for name, offset_s in fusion["view_clocks_s"].items():
        lines.append(
            f"the clock of {name} is off: {offset_s:+.3f} s added to its stamps make the map "
            "sharpest and were added there; put it into the calibration (clock_offset_s)"
        )
    return lines


def _doubts(fusion: Mapping[str, Any]) -> list[str]:
    """Whether lidar and views say different things. A union joins none of their points."""
    points = fusion["points"]
    viewed = points["camera"] + points["both"]
    if fusion["mode"] == "union" or not viewed:
        return []
    if not points["compared"]:
        return [
            "lidar and views measured in no common direction: the views lie in the map as their "
            "mountings and clocks say, unchecked"
        ]
    agreeing = points["both"] / viewed
    if agreeing >= LEAST_AGREEING:
        return []
    return [
        f"lidar and views agree on only {100.0 * agreeing:.1f} % of what the views saw: unless low "
        "things stand all around, a mounting or a clock is wrong ('slam calibrate' estimates a "
        "camera's)"
    ]
