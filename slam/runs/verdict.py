"""Whether a map can be trusted as a whole: the verdict, and what speaks against it where."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from backend.doubts import Contradiction
from datasets.trajectory import Trajectory
from slam.pipeline import Slam

SHOWN = 5
UNMATCHED_SHARE = 0.5
"""Where more scans than this did not match, the trajectory is the odometry's."""


def doubts_of(pipeline: Slam, trajectory: Trajectory) -> list[dict[str, Any]]:
    """What makes a map doubtful, a row each: what, where, when, why, and what would help.

    after_s, to_s : seconds after the first scan. x_m, y_m : in the map.
    """
    start_ns = int(trajectory.stamps_ns[0])
    doubts: list[dict[str, Any]] = []
    unmatched = sum(pipeline.local.unmatched.values())
    if unmatched > UNMATCHED_SHARE * len(pipeline.records):
        held = "odometry" if pipeline.odometry and pipeline.config.odometry else "a guess"
        doubts.append(
            {
                "what": f"{unmatched} of {len(pipeline.records)} scans matched nothing: "
                f"the trajectory is mostly {held}",
                **_at(trajectory, start_ns, int(trajectory.stamps_ns[-1]), start_ns),
                "why": "the scans do not fit each other under any motion near the expected one",
                "help": "slam check tells of wrong mountings, units and times; try --no-odometry",
            }
        )
    if pipeline.finished is None:
        return doubts
    doubts += [
        _contradiction(place, trajectory, start_ns)
        for place in pipeline.finished.contradictions.places
    ]
    doubts += [
        {
            "what": "how far the base drove here is a guess",
            **_at(
                trajectory,
                pipeline.nodes[step.node - 1].scan.stamp_ns,
                pipeline.nodes[step.node].scan.stamp_ns,
                start_ns,
            ),
            "why": "its scans show no way along, and no odometry held it "
            f"(sigma {step.sigma_m:.2f} m in the final graph)",
            "help": "record odometry, or drive there slower and again",
        }
        for step in pipeline.finished.loose
    ]
    parts = pipeline.finished.parts
    for part in range(1, int(parts.max(initial=0)) + 1):
        submaps = [s for s in pipeline.submaps[: len(parts)] if parts[s.index] == part]
        first_ns = submaps[0].nodes[0].scan.stamp_ns
        last_ns = submaps[-1].nodes[-1].scan.stamp_ns
        doubts.append(
            {
                "what": f"part {part + 1} hangs on by a guess",
                **_at(trajectory, first_ns, last_ns, start_ns),
                "why": "tracking was lost before it, and no place joins it to the rest",
                "help": "drive through a place that both parts show, or record without the gap",
            }
        )
    return doubts


def _contradiction(place: Contradiction, trajectory: Trajectory, start_ns: int) -> dict[str, Any]:
    other_s = (place.other_ns - start_ns) * 1e-9
    against = "another pass" if place.passes == "other" else "the same pass"
    return {
        "what": "walls stand where other scans saw free space",
        "x_m": place.x_m,
        "y_m": place.y_m,
        "after_s": (place.from_ns - start_ns) * 1e-9,
        "to_s": (place.to_ns - start_ns) * 1e-9,
        "why": f"{100 * place.share:.0f} % of what can be compared with {against} "
        f"({other_s:.1f} s) is contradicted",
        "help": "look at the map there: one of the passes lies at a wrong place, or things moved",
    }


def _at(trajectory: Trajectory, first_ns: int, last_ns: int, start_ns: int) -> dict[str, Any]:
    x_m, y_m, _ = trajectory.at(np.array([first_ns], dtype=np.int64))[0].tolist()
    return {
        "x_m": x_m,
        "y_m": y_m,
        "after_s": (first_ns - start_ns) * 1e-9,
        "to_s": (last_ns - start_ns) * 1e-9,
    }


def verdict_lines(metrics: Mapping[str, Any]) -> list[str]:
    """The verdict, and the first few doubts."""
    doubts = metrics["doubts"]
    if not doubts and metrics["final_passes"] is None:
        return ["not judged: without loop closures and final passes nothing was compared"]
    if not doubts:
        return ["good: no scan contradicts another, and every part of the drive is joined"]
    lines = [f"DOUBTFUL: {len(doubts)} {'place' if len(doubts) == 1 else 'places'} to look at"]
    for doubt in doubts[:SHOWN]:
        lines.append(
            f"  near ({doubt['x_m']:.1f}, {doubt['y_m']:.1f}), {doubt['after_s']:.1f} to "
            f"{doubt['to_s']:.1f} s: {doubt['what']}; {doubt['why']}"
        )
    if len(doubts) > SHOWN:
        lines.append(f"  and {len(doubts) - SHOWN} more: see metrics.json")
    return lines
