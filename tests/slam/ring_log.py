"""A recording of a ring of corridors to try runs on, drawn by a seed: a CARMEN log, and its truth.

A robot with a 360 deg lidar drives once round a ring of corridors, through a room with two doors,
and some metres further on its own tracks. The place has no symmetry, so a mirrored or turned map
shows. The lidar's noise is that of a YDLIDAR G4, every scan a snapshot (a CARMEN log has no beam
times); the wheels' errors are those of such a base, so that the raw odometry does not close
the loop.
"""

from __future__ import annotations

import gzip
import math
import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from datasets.messages import Array
from datasets.trajectory import Stamps, Trajectory
from datasets.tum import format_stamp, write_tum

# ---- the place, metres; corners of walls, a gap between two lines is a door --------------------
WALLS_M: tuple[tuple[tuple[float, float], ...], ...] = (
    # the outer side of the ring, counter-clockwise from the south-west, with two niches
    ((6.5, 0), (11, 0), (11, -0.5), (12.2, -0.5), (12.2, 0), (18, 0)),
    ((19.2, 0), (26, 0), (26, 5), (26.6, 5), (26.6, 6.5), (26, 6.5), (26, 15), (14.5, 15)),
    ((10, 15), (4, 15)),
    ((3, 15), (0, 15), (0, 9)),
    ((0, 8), (0, 0), (5.5, 0)),
    # rooms outside it, and a lobby open to it with a slanted corner
    ((3, 0), (3, -4), (8, -4), (8, 0)),
    ((15, 0), (15, -3.2), (21, -3.2), (21, 0)),
    ((14.5, 15), (14.5, 18.5), (11.2, 18.5), (10, 17.3), (10, 15)),
    ((1.5, 15), (1.5, 18.2), (6, 18.2), (6, 15)),
    ((0, 10.5), (-4, 10.5), (-4, 6), (0, 6)),
    # the inner side of the ring
    ((8, 2.2), (2.4, 2.2), (2.4, 13), (7.3, 13), (7.3, 12.4), (8.5, 12.4), (8.5, 13), (19.4, 13)),
    ((9, 2.2), (14, 2.2)),
    ((15.2, 2.2), (24.2, 2.2), (24.2, 8.9)),
    ((24.2, 10.1), (24.2, 13), (20.6, 13)),
    # rooms inside it; the last has the two doors
    ((6, 2.2), (6, 7), (11, 7), (11, 2.2)),
    ((12.5, 2.2), (12.5, 6.5), (17, 6.5), (17, 2.2)),
    ((18, 13), (18, 8), (24.2, 8)),
    # a cupboard in the corridor, a table, a pillar
    ((0, 3), (0.4, 3), (0.4, 4.4), (0, 4.4)),
    ((22, 11), (23, 11), (23, 12), (22, 12), (22, 11)),
    ((12, 16.4), (12.4, 16.4), (12.4, 16.8), (12, 16.8), (12, 16.4)),
)
WAY_M = ((6, 1.1), (25.1, 1.1), (25.1, 9.5), (20, 9.5), (20, 14), (1.2, 14), (1.2, 1.1), (15, 1.1))
TURN_LENGTH_M = 1.6  # of the way a quarter turn takes

# ---- the robot -------------------------------------------------------------------------------
SPEED_MAX_M_S, ACCELERATION_M_S2, TURN_RATE_MAX_RAD_S = 0.8, 0.4, 0.7
LIDAR_AHEAD_M = 0.12  # of the base, on its x axis
BEAMS = 360
RANGE_MAX_M, NOISE_M, NOISE_PER_M = 16.0, 0.010, 0.003
TICK_NS, TICKS_PER_SCAN, TICKS_PER_ODOMETRY = 24_000_000, 6, 3
START_NS = 1_700_000_000_000_000_000
# One sigma after a metre (way in m, turn in rad) and after a turn of one radian.
WAY_NOISE, TURN_NOISE_PER_WAY, TURN_NOISE = 0.01, 0.006, 0.02


@dataclass(frozen=True, slots=True)
class DemoFiles:
    """recording : a CARMEN log, gzipped. ground_truth : the base at every scan, TUM form."""

    recording: Path
    ground_truth: Path


def write_demo_recording(folder: Path, seed: int) -> DemoFiles:
    """Write ``demo.log.gz`` and ``demo_ground_truth.tum`` into a folder, which is made if missing.

    The same seed gives the same bytes. Raises OSError if the folder cannot be written to.
    """
    random = np.random.default_rng(seed)
    true_drive = drive_the_way()
    odometry = dead_reckoning(true_drive, random)
    scans = true_drive.xyyaw[::TICKS_PER_SCAN]
    ranges_m = measure(scans, random)

    folder.mkdir(parents=True, exist_ok=True)
    files = DemoFiles(folder / "demo.log.gz", folder / "demo_ground_truth.tum")
    text = _carmen_log(true_drive.stamps_ns, odometry, ranges_m)
    partial = files.recording.with_name(files.recording.name + ".part")
    # Neither name nor time in the gzip header: the same recording is the same bytes.
    partial.write_bytes(gzip.compress(text.encode("ascii"), mtime=0))
    os.replace(partial, files.recording)
    write_tum(files.ground_truth, Trajectory(true_drive.stamps_ns[::TICKS_PER_SCAN], scans))
    return files


def wall_segments() -> Array:
    """The walls as (S, 4) segments x0 y0 x1 y1, m, map frame."""
    return np.array([(*a, *b) for line in WALLS_M for a, b in pairwise(line)])


def drive_the_way() -> Trajectory:
    """T_map_base at every tick: along ``WAY_M`` with rounded corners, within the base's limits."""
    corners = np.array(WAY_M, dtype=np.float64)
    legs = np.diff(corners, axis=0)
    headings = np.arctan2(legs[:, 1], legs[:, 0])
    turns = np.arctan2(np.sin(np.diff(headings)), np.cos(np.diff(headings)))

    # Curvature over the way: straight, then a turn that swells and fades, so that the yaw rate
    # doesn't jump. A turn leaves its first leg and joins the second `cut` metres from the corner.
    step_m = 0.01
    swell = 1.0 - np.cos(2.0 * math.pi * (np.arange(0.0, TURN_LENGTH_M, step_m) / TURN_LENGTH_M))
    swell /= swell.sum() * step_m
    cuts = np.array([0.0, *(_cut_m(swell * turn, step_m) for turn in turns), 0.0])
    straights = np.hypot(*legs.T) - cuts[:-1] - cuts[1:]
    parts = [np.zeros(round(straights[0] / step_m))]
    for turn, straight in zip(turns, straights[1:], strict=True):
        parts += [swell * turn, np.zeros(round(straight / step_m))]
    curvature = np.concatenate(parts)

    # The highest speed that every later and earlier limit can be braked for or reached from.
    way_m = np.arange(curvature.size) * step_m
    limit = np.minimum(SPEED_MAX_M_S, TURN_RATE_MAX_RAD_S / np.maximum(np.abs(curvature), 1e-9))
    square = limit**2
    square[[0, -1]] = 0.05**2
    ramp = 2.0 * ACCELERATION_M_S2 * way_m
    square = np.minimum.accumulate(square - ramp) + ramp
    square = np.minimum.accumulate((square + ramp)[::-1])[::-1] - ramp

    at_s = np.concatenate([[0.0], np.cumsum(step_m / np.sqrt(square))])
    start = np.array([*WAY_M[0], headings[0]])
    poses = _driven(np.full(curvature.size, step_m), curvature * step_m, start)
    ticks = np.arange(int(at_s[-1] * 1e9 / TICK_NS) + 1, dtype=np.int64) * TICK_NS
    columns = [np.interp(ticks * 1e-9, at_s, values) for values in poses.T]
    return Trajectory(START_NS + ticks, np.column_stack(columns))


def _cut_m(curvature: Array, step_m: float) -> float:
    """How far from its corner a turn begins and ends, for a curvature that is symmetric."""
    yaw = np.cumsum(curvature * step_m)
    chord_m = math.hypot(float(np.cos(yaw).sum()), float(np.sin(yaw).sum())) * step_m
    return chord_m / (2.0 * math.cos(float(yaw[-1]) / 2.0))


def dead_reckoning(true_drive: Trajectory, random: np.random.Generator) -> Array:
    """T_odom_base at every tick as (N, 3) x m, y m, yaw rad, beginning at 0.

    Scale error 1-2 %, a heading bias of 0.015-0.02 rad/m (unequal wheels; two logs of the
    literature have 0.014 and 0.08), and noise whose variance grows with the way and the turn.
    """
    side = random.choice([-1.0, 1.0], size=2)
    scale = 1.0 + side[0] * random.uniform(0.01, 0.02)
    bias_rad_per_m = side[1] * random.uniform(0.015, 0.020)
    way = np.hypot(*np.diff(true_drive.xyyaw[:, :2], axis=0).T)
    turn = np.diff(true_drive.xyyaw[:, 2])
    noise = random.standard_normal((3, way.size))
    seen_way = scale * way + WAY_NOISE * np.sqrt(way) * noise[0]
    seen_turn = turn + bias_rad_per_m * way + TURN_NOISE_PER_WAY * np.sqrt(way) * noise[1]
    seen_turn += TURN_NOISE * np.sqrt(np.abs(turn)) * noise[2]
    return _driven(seen_way, seen_turn, np.zeros(3))


def _driven(way: Array, turn: Array, start: Array) -> Array:
    """Where steps of way (m) and turn (rad), (N,) each, lead from a start: (N + 1, 3) x, y, yaw."""
    yaw = start[2] + np.concatenate([[0.0], np.cumsum(turn)])
    middle = (yaw[:-1] + yaw[1:]) / 2.0
    x = start[0] + np.concatenate([[0.0], np.cumsum(way * np.cos(middle))])
    y = start[1] + np.concatenate([[0.0], np.cumsum(way * np.sin(middle))])
    poses: Array = np.column_stack([x, y, yaw])
    return poses


def measure(bases_map: Array, random: np.random.Generator) -> Array:
    """Noisy ranges, m, (N, BEAMS) from (N, 3) poses of the base; RANGE_MAX_M is no return."""
    walls = wall_segments()
    bearings = beam_bearings_rad()
    ranges_m = np.empty((len(bases_map), BEAMS))
    for row, (x, y, yaw) in zip(ranges_m, bases_map, strict=True):
        lidar = np.array([x + LIDAR_AHEAD_M * math.cos(yaw), y + LIDAR_AHEAD_M * math.sin(yaw)])
        row[:] = cast(lidar, bearings + yaw, walls)
    sigma_m = NOISE_M + NOISE_PER_M * np.minimum(ranges_m, RANGE_MAX_M)
    ranges_m += random.standard_normal(ranges_m.shape) * sigma_m
    return np.clip(ranges_m, 0.0, RANGE_MAX_M, out=ranges_m)


def beam_bearings_rad() -> Array:
    """(BEAMS,) counter-clockwise from behind, lidar frame."""
    bearings: Array = -math.pi + np.arange(BEAMS, dtype=np.float64) * (2.0 * math.pi / BEAMS)
    return bearings


def cast(origin_map: Array, directions_rad: Array, walls: Array) -> Array:
    """Distance along each ray to the first wall, m, inf where there is none.

    origin_map : (2,). directions_rad : (N,), map frame. walls : (S, 4) segments x0 y0 x1 y1.
    Solves origin + r d = start + u edge for every ray and wall. O(N S).
    """
    direction_x, direction_y = np.cos(directions_rad)[:, None], np.sin(directions_rad)[:, None]
    start_x, start_y = walls[:, 0] - origin_map[0], walls[:, 1] - origin_map[1]
    edge_x, edge_y = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):  # rays along a wall: inf or NaN, no hit
        cross = direction_x * edge_y - direction_y * edge_x
        r = (start_x * edge_y - start_y * edge_x) / cross
        u = (start_x * direction_y - start_y * direction_x) / cross
        hit = (r > 0.0) & (u >= 0.0) & (u <= 1.0)
    nearest: Array = np.where(hit, r, np.inf).min(axis=1)
    return nearest


def _carmen_log(stamps_ns: Stamps, odometry: Array, ranges_m: Array) -> str:
    """ODOM and ROBOTLASER1 lines in order of time; CARMEN's logger writes the formats so."""
    resolution = 2.0 * math.pi / BEAMS
    lidar_head = (
        f"ROBOTLASER1 99 {-math.pi:.9f} {resolution * (BEAMS - 1):.9f} {resolution:.9f} "
        f"{RANGE_MAX_M:.3f} {NOISE_M:.3f} 0 {BEAMS}"
    )
    lines = ["# CARMEN Logfile, generated: a demo, not a real robot"]
    rates = np.gradient(odometry, TICK_NS * 1e-9, axis=0)
    for tick in range(0, len(odometry), TICKS_PER_ODOMETRY):
        x, y, yaw = odometry[tick]
        speed, turn_rate = math.hypot(*rates[tick, :2]), rates[tick, 2]
        seconds = (int(stamps_ns[tick]) - START_NS) / 1e9
        when = f"{format_stamp(int(stamps_ns[tick]))} demo {seconds:.3f}"
        base = f"{x:.6f} {y:.6f} {yaw:.6f}"
        if tick % TICKS_PER_SCAN:
            lines.append(f"ODOM {base} {speed:.4f} {turn_rate:.4f} 0 {when}")
            continue
        ranges = " ".join(f"{r:.3f}" for r in ranges_m[tick // TICKS_PER_SCAN].tolist())
        lidar_x, lidar_y = x + LIDAR_AHEAD_M * math.cos(yaw), y + LIDAR_AHEAD_M * math.sin(yaw)
        lines.append(
            f"{lidar_head} {ranges} 0 {lidar_x:.6f} {lidar_y:.6f} {yaw:.6f} {base} "
            f"{speed:.4f} {turn_rate:.4f} 0.3 0.3 0.5 {when}"
        )
    return "\n".join(lines) + "\n"
