"""What a run tells of its fusion: as data for metrics.json and in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fusion.scan import BOTH, CAMERA, LIDAR
from slam.pipeline import Slam

Data = dict[str, Any]


def fusion_data(pipeline: Slam) -> Data:
    """Which sensors took part, how, and how many points came of each."""
    fusing, config = pipeline.fusing, pipeline.config
    viewed = sorted(fusing.view_counts)
    return {
        "sensors": config.sensors,
        "mode": config.fusion,
        "single_grid": not fusing.keeps_layers,
        "views": {name: fusing.view_counts[name] for name in viewed},
        "scans_without_view": {name: fusing.without_view[name] for name in viewed},
        "view_clocks_s": {
            name: pipeline.view_clocks[name].offset_s for name in sorted(pipeline.view_clocks)
        },
        "points": {
            "lidar": fusing.beams[LIDAR],
            "camera": fusing.beams[CAMERA],
            "both": fusing.beams[BOTH],
        },
    }


def fusion_lines(metrics: Mapping[str, Any]) -> list[str]:
    """The same for people; nothing where there was nothing to fuse."""
    fusion = metrics["fusion"]
    if not fusion["views"]:
        return []
    views = ", ".join(f"{count} of {name}" for name, count in fusion["views"].items())
    lines = [f"views taken in: {views}"]
    if fusion["sensors"] == "camera":
        return [*lines, "mapped by depth cameras alone"]
    points = fusion["points"]
    total = max(sum(points.values()), 1)
    shares = {name: 100.0 * count / total for name, count in points.items()}
    grid = "a single grid" if fusion["single_grid"] else "layers"
    lines.append(
        f"{fusion['mode']} mode, {grid}: of the scans' points {shares['both']:.1f} % were seen by "
        f"both, {shares['camera']:.1f} % by the views alone"
    )
    for name, count in fusion["scans_without_view"].items():
        if count:
            lines.append(f"{count} scans had no view of {name} near in time: lidar alone there")
    for name, offset_s in fusion["view_clocks_s"].items():
        lines.append(
            f"the clock of {name} is off: {offset_s:+.3f} s added to its stamps make the map "
            "sharpest and were added there; put it into the calibration (clock_offset_s)"
        )
    return lines
