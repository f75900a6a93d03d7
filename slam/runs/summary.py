"""What a run came to: as data (metrics.json, timing.json) and in words a map can be judged by."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from backend.loop_attempt import ACCEPTED
from backend.mountings import MountingOffset
from datasets.errors import InputError
from datasets.messages import Array
from datasets.recording import Recording
from datasets.se2 import xyyaw
from datasets.trajectory import Trajectory
from slam.evaluation.trajectory_error import trajectory_error
from slam.mapping.layers import LayeredMap
from slam.mapping.occupancy import FREE, OCCUPIED, Raster
from slam.pipeline import Slam
from slam.runs.cost import cost_lines
from slam.runs.evaluate import EvaluationReport
from slam.runs.fusion_summary import fusion_data, fusion_lines
from slam.runs.graph_table import kept_closures
from slam.runs.verdict import doubts_of, verdict_lines

Data = dict[str, Any]

COUNTED_M = 0.1
TELLING_WAY_M = 1.0
"""A clock offset is believed only if the base moved."""


def metrics_of(
    recording: Recording,
    pipeline: Slam,
    T_map_scans: Array,
    trajectory: Trajectory,
    grid: LayeredMap,
) -> Data:
    """What metrics.json holds: the same for the same input, so no times of the machine."""
    records = pipeline.records
    stamps = trajectory.stamps_ns
    T_odom = np.array([record.T_odom_base for record in records])
    corrected_m = np.hypot(*(T_map_scans[:, :2, 2] - T_odom[:, :2, 2]).T)
    wheels = pipeline.local.motion.errors
    used = bool(pipeline.odometry) and pipeline.config.odometry
    doubts = doubts_of(pipeline, trajectory)
    return {
        "verdict": "doubtful" if doubts else "good" if pipeline.finished else "not judged",
        "doubts": doubts,
        "recording": recording.name,
        "duration_s": float(stamps[-1] - stamps[0]) * 1e-9,
        "way_m": driven_m(trajectory),
        "unobserved_way_m": pipeline.local.unobserved_m,
        "scans": len(records),
        "scans_by_sensor": _scans_by_sensor(recording, pipeline),
        "scans_unmatched": _sorted(pipeline.local.unmatched),
        "lost": _lost(pipeline, trajectory),
        "left_out": _sorted(pipeline.left_out + _not_believed(pipeline)),
        "reader_notes": _sorted(recording.notes),
        "fusion": fusion_data(pipeline),
        "odometry_messages": len(pipeline.odometry),
        "odometry_used": used,
        "odometry_turn_bias_rad_per_m": wheels.turn_rad_per_m if used else None,
        "odometry_scale_error": wheels.scale_error if used else None,
        "odometry_slip_scans": pipeline.local.motion.slip.scans if used else None,
        "nodes": len(pipeline.nodes),
        "submaps": len(pipeline.submaps),
        "loops": _loops(pipeline),
        "final_passes": _final_passes(pipeline),
        "correction_m": {
            "mean": float(corrected_m.mean()),
            "maximum": float(corrected_m.max()),
            "end": float(corrected_m[-1]),
        },
        "map": _map(pipeline, grid),
        "ground_truth": ground_truth_of(recording, trajectory),
    }


def _not_believed(pipeline: Slam) -> Counter[str]:
    limit_m_s = pipeline.config.motion.speed_limit_m_s
    reason = f"odometry between two scans not believed: faster than {limit_m_s:g} m/s"
    return Counter({reason: pipeline.local.motion.implausible})


def _scans_by_sensor(recording: Recording, pipeline: Slam) -> dict[str, int]:
    """A lidar without one scan counts 0: that may be news. Lower ones give views, not scans."""
    alone = pipeline.config.sensors == "camera"
    lidars = () if alone else recording.calibration.lidars
    counts = Counter({name: 0 for name in lidars if not pipeline.fusing.is_lower(name)})
    counts.update(record.sensor for record in pipeline.records)
    return _sorted(counts)


def driven_m(trajectory: Trajectory) -> float:
    """The way of the base, m: a place counts when it is ``COUNTED_M`` from the last that did.

    Otherwise the noise of the poses of a standing robot would add up to metres.
    """
    xy = trajectory.xyyaw[:, :2].tolist()
    way_m, last = 0.0, xy[0]
    for place in xy:
        step_m = math.dist(last, place)
        if step_m >= COUNTED_M:
            way_m, last = way_m + step_m, place
    return way_m


def _sorted(counts: Counter[str]) -> dict[str, int]:
    """The most frequent first; equals by name, so that the order is always the same."""
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _loops(pipeline: Slam) -> Data:
    attempts = pipeline.global_slam.search.attempts
    refused = Counter(attempt.result for attempt in attempts if attempt.result != ACCEPTED)
    accepted = len(attempts) - refused.total()
    taken_back = sum(not kept for kept in kept_closures(pipeline).values())
    return {
        "searched": len(attempts),
        "closed": accepted - taken_back,
        "taken_back": taken_back,
        "refused": _sorted(refused),
    }


def _lost(pipeline: Slam, trajectory: Trajectory) -> list[Data]:
    """When (since the first scan) and where in the map local SLAM lost the thread."""
    stamps = np.array(pipeline.local.lost_ns, dtype=np.int64)
    poses = trajectory.at(stamps) if stamps.size else np.empty((0, 3))
    after_s = (stamps - trajectory.stamps_ns[0]) * 1e-9
    return [
        {"after_s": float(s), "x_m": float(pose[0]), "y_m": float(pose[1])}
        for s, pose in zip(after_s, poses, strict=True)
    ]


def _final_passes(pipeline: Slam) -> Data | None:
    if pipeline.finished is None:
        return None
    refined = pipeline.finished.refined
    rms_m = float(np.median(refined.rms_m)) if refined.rms_m.size else None
    return {
        "moved_m": list(refined.moved_m),
        "undone": pipeline.finished.undone,
        "lidar_offsets": [_lidar_offset(offset) for offset in refined.offsets],
        "pairs": len(refined.pairs),
        "pairs_tried": refined.tried,
        "median_rms_m": rms_m,
    }


def _lidar_offset(offset: MountingOffset) -> Data:
    x_m, y_m, yaw_rad = xyyaw(offset.T_true_said)
    return {
        "lidar": offset.sensor,
        "x_m": x_m,
        "y_m": y_m,
        "yaw_deg": math.degrees(yaw_rad),
        "clock_s": offset.clock_s,
        "sigma_m": offset.sigma_m,
        "sigma_deg": math.degrees(offset.sigma_rad),
        "sigma_s": offset.sigma_s,
    }


def _map(pipeline: Slam, grid: LayeredMap) -> Data:
    def area(raster: Raster) -> Data:
        classes = raster.classes(pipeline.config.map)
        return {
            "occupied_cells": int(np.count_nonzero(classes == OCCUPIED)),
            "free_m2": float(np.count_nonzero(classes == FREE)) * grid.resolution_m**2,
        }

    height, width = grid.shape
    return {
        "resolution_m": grid.resolution_m,
        "width_cells": width,
        "height_cells": height,
        **area(grid),
        "layers": {name: area(layer) for name, layer in grid.layers.items()},
    }


def ground_truth_of(recording: Recording, trajectory: Trajectory) -> Data | None:
    """How far a trajectory is from the recording's ground truth; None where there is none."""
    truth = recording.ground_truth()
    if truth is None:
        return None
    try:
        error = trajectory_error(trajectory, truth, "auto")
        if not error.time_offset.telling or driven_m(trajectory) < TELLING_WAY_M:
            error = trajectory_error(trajectory, truth)
    except InputError as reason:
        return {"error": None, "words": [f"not compared: {reason.what}"]}
    report = EvaluationReport(relations=None, trajectory=error)
    words = [line for line in report.lines() if not line.startswith("RPE")]
    return {"error": report.as_dict()["trajectory"], "words": words}


def summary_lines(
    metrics: Mapping[str, Any], timing: Mapping[str, Any], folder: Path, *, partial: bool
) -> list[str]:
    """The summary that a run ends with, a line each."""
    sections = [
        ("verdict", verdict_lines(metrics)),
        ("recording", _recording_lines(metrics, partial)),
        ("fusion", fusion_lines(metrics)),
        ("matching", _matching_lines(metrics)),
        ("loops", _loop_lines(metrics)),
        ("map", _map_lines(metrics)),
        ("left out", _counts({**metrics["left_out"], **metrics["reader_notes"]})),
        ("ground truth", (metrics["ground_truth"] or {}).get("words", [])),
        ("cost", cost_lines(timing)),
        ("files", _files(folder)),
    ]
    return [
        f"{title if not row else '':<13} {line}".rstrip()
        for title, lines in sections
        for row, line in enumerate(lines)
    ]


def _recording_lines(metrics: Mapping[str, Any], partial: bool) -> list[str]:
    lidars = ", ".join(f"{count} of {name}" for name, count in metrics["scans_by_sensor"].items())
    lines = [
        f"{metrics['recording']}: {metrics['way_m']:.1f} m driven in {metrics['duration_s']:.1f} s",
        f"{metrics['scans']} scans mapped ({lidars}), {metrics['odometry_messages']} odometry "
        f"messages{'' if metrics['odometry_used'] else ', not used'}",
    ]
    if partial:
        lines.insert(0, "PARTIAL: interrupted, this is what was mapped so far")
    return lines


def _matching_lines(metrics: Mapping[str, Any]) -> list[str]:
    held = "odometry" if metrics["odometry_used"] else "the last velocity"
    lines = [
        f"{metrics['unobserved_way_m']:.1f} m driven where the scans did not show the way along; "
        f"{held} held it",
    ]
    bias, scale = metrics["odometry_turn_bias_rad_per_m"], metrics["odometry_scale_error"]
    if bias is not None:
        lines.append(
            f"odometry corrected by {bias:+.4f} rad/m and {100.0 * scale:+.2f} % of its way, "
            "learned from the matches"
        )
    slipped = metrics["odometry_slip_scans"]
    if slipped:
        lines.append(
            f"the base turned otherwise than its wheels say during {slipped} scans, as slip makes "
            "it; their matches showed by how much"
        )
    unmatched = metrics["scans_unmatched"]
    if unmatched:
        lines.append(f"scans without a match: {sum(unmatched.values())}")
        lines += [f"  {line}" for line in _counts(unmatched)]
        lines += [
            f"lost {lost['after_s']:.1f} s after the start, near ({lost['x_m']:.1f}, "
            f"{lost['y_m']:.1f}) in the map"
            for lost in metrics["lost"]
        ]
    else:
        lines.append("every scan matched")
    return lines


def _loop_lines(metrics: Mapping[str, Any]) -> list[str]:
    loops, refused = metrics["loops"], metrics["loops"]["refused"]
    lines = [
        f"{loops['closed']} closed, {sum(refused.values())} refused, "
        f"{loops['taken_back']} taken back in the end"
    ]
    lines += [f"  {line}" for line in _counts(refused)]
    correction, passes = metrics["correction_m"], metrics["final_passes"]
    lines.append(
        f"scans moved by {correction['mean']:.2f} m on average, {correction['maximum']:.2f} m at "
        "most, against local SLAM"
    )
    if passes is not None and passes["moved_m"]:
        undone = "; UNDONE, as scans contradicted each other more" if passes["undone"] else ""
        moves = ", ".join(f"{moved * 1000:.1f} mm" for moved in passes["moved_m"])
        lines.append(
            f"final passes moved the nodes by {moves}; {passes['pairs']} of "
            f"{passes['pairs_tried']} pairs of scans agree{undone}"
        )
        lines += [_offset_line(offset) for offset in passes["lidar_offsets"]]
    return lines


def _offset_line(offset: Mapping[str, Any]) -> str:
    away_cm = 100.0 * math.hypot(offset["x_m"], offset["y_m"])
    return (
        f"{offset['lidar']} corrected: it stands {away_cm:.1f} cm (+- "
        f"{100.0 * offset['sigma_m']:.1f}) and {offset['yaw_deg']:+.2f} deg (+- "
        f"{offset['sigma_deg']:.2f}) from where its mounting says, its clock "
        f"{offset['clock_s']:+.3f} s"
    )


def _map_lines(metrics: Mapping[str, Any]) -> list[str]:
    drawn = metrics["map"]
    side_m = drawn["resolution_m"]
    return [
        f"{drawn['width_cells'] * side_m:.1f} x {drawn['height_cells'] * side_m:.1f} m in cells of "
        f"{side_m:g} m, {drawn['free_m2']:.0f} m2 free, {drawn['occupied_cells']} cells occupied"
    ]


def _counts(counts: Mapping[str, int]) -> list[str]:
    return [f"{reason}: {count}" for reason, count in counts.items()]


def _files(folder: Path) -> list[str]:
    names = sorted(path.name for path in folder.iterdir())
    return [f"in {folder}:", f"  {', '.join(names)}"]
