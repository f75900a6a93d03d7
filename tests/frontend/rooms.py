"""Places with known walls, and what a lidar sees in them: exact, noisy, or smeared by motion."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from datasets.messages import Array
from datasets.se2 import se2, transform
from frontend.prepared import PreparedScan, prepare
from fusion.scan import FusedScan

Line = tuple[tuple[float, float], ...]


def walls(*lines: Line) -> Array:
    """(S, 4) segments x0 y0 x1 y1, m, of lines through corners."""
    return np.array([(*a, *b) for line in lines for a, b in pairwise(line)], dtype=np.float64)


def box(x: float, y: float, width: float, height: float) -> Line:
    """The four sides of an upright rectangle."""
    return ((x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y))


ROOM = walls(
    (
        *((0, 0), (6, 0), (6, -1.5), (7.5, -1.5), (7.5, 0), (10, 0), (10, 4.5)),
        *((8, 7), (3, 7), (3, 6), (0, 6), (0, 0)),
    ),
    box(2.0, 2.0, 0.8, 1.2),
    ((6.5, 4.2), (6.5, 5.5)),
)
"""Like no other under any turn or mirror; x 0..10, y -1.5..7, a slanted wall."""

OTHER_ROOM = walls(
    ((0, 0), (4.5, 0), (4.5, 2), (9, 2), (9, 9), (2, 9), (2, 6), (0, 6), (0, 0)),
    box(5.5, 4.0, 1.5, 0.6),
)

RING = walls(
    (
        *((0, 0), (5, 0), (5, -0.8), (6.2, -0.8), (6.2, 0), (12, 0), (12, 3), (12.7, 3)),
        *((12.7, 4.5), (12, 4.5), (12, 9), (9, 9), (7.5, 9.6), (4, 9.6), (4, 9), (0, 9), (0, 0)),
    ),
    ((2, 2), (7, 2), (7, 2.5), (8, 2.5), (8, 2), (10, 2), (10, 7), (3.5, 7), (2, 6), (2, 2)),
)
"""Corridors 2 m wide round a block, each of its sides with a mark of its own."""

SQUARE = walls(box(-3.0, -3.0, 6.0, 6.0))
CORRIDOR = walls(((-200, -1), (200, -1)), ((-200, 1), (200, 1)))
CABINETS = np.concatenate(
    [CORRIDOR, walls(*[box(-30 + 1.2 * k, 0.6, 0.6, 0.4) for k in range(50)])]
)
"""All alike, along one side."""
MARKED_CABINETS = np.concatenate([CABINETS, walls(box(1.0, -0.7, 0.5, 0.4))])
"""One more, like no other, on the other side."""


def cast(origins: Array, directions_rad: Array, segments: Array) -> Array:
    """(N,) distance along each ray to the first wall, m; inf where there is none.

    origins : (N, 2), directions_rad : (N,), both in the frame of the walls.
    """
    dx, dy = np.cos(directions_rad)[:, None], np.sin(directions_rad)[:, None]
    start_x = segments[:, 0] - origins[:, :1]
    start_y = segments[:, 1] - origins[:, 1:]
    edge_x, edge_y = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = dx * edge_y - dy * edge_x
        r = (start_x * edge_y - start_y * edge_x) / cross
        u = (start_x * dy - start_y * dx) / cross
        hit = (r > 0.0) & (u >= 0.0) & (u <= 1.0)
    nearest: Array = np.where(hit, r, np.inf).min(axis=1)
    return nearest


def moved(velocity_base: Array, seconds: float) -> Array:
    """The pose after a constant twist (m/s, m/s, rad/s), exactly: the exponential."""
    vx, vy, w = velocity_base
    turn = w * seconds
    if abs(turn) < 1e-12:
        return se2(vx * seconds, vy * seconds, 0.0)
    a, b = math.sin(turn) / w, (1.0 - math.cos(turn)) / w
    return se2(a * vx - b * vy, b * vx + a * vy, turn)


def fused(
    segments: Array,
    T_world_base: Array,
    *,
    beams: int = 360,
    first_rad: float = -math.pi,
    fov_rad: float = 2.0 * math.pi,
    origin_base: tuple[float, float] = (0.0, 0.0),
    noise_m: float = 0.0,
    random: np.random.Generator | None = None,
    velocity_base: Array | None = None,
    turn_s: float = 0.0,
    max_range_m: float = 12.0,
    stamp_ns: int = 0,
    sensor: str = "lidar",
) -> FusedScan:
    """One turn of a lidar whose axes are the base's.

    With velocity_base and turn_s the base moves during the turn, from T_world_base on, and each
    point is in the base frame of its own time.
    """
    spacing = fov_rad / beams
    bearings = first_rad + (np.arange(beams) + 0.5) * spacing
    offsets = np.linspace(0.0, turn_s, beams, endpoint=False) if turn_s else np.empty(0)
    origin = np.array(origin_base)
    if velocity_base is None or not turn_s:
        poses = np.broadcast_to(T_world_base, (beams, 3, 3))
    else:
        poses = np.array([T_world_base @ moved(velocity_base, float(t)) for t in offsets])
    yaws = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    ranges = cast(poses[:, :2, :2] @ origin + poses[:, :2, 2], bearings + yaws, segments)
    seen = ranges <= max_range_m
    ranges, bearings = ranges[seen], bearings[seen]
    if noise_m and random is not None:
        ranges = ranges + noise_m * random.standard_normal(ranges.size)
    points = origin + ranges[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    times = offsets[seen] if offsets.size else offsets
    variance = np.full(len(points), max(noise_m, 0.01) ** 2)
    return FusedScan.of_lidar(stamp_ns, sensor, origin, points, times, spacing, variance)


def prepared(segments: Array, T_world_base: Array, **how: object) -> PreparedScan:
    """A scan without motion, ready for matching; keywords as for ``fused``."""
    return prepare(fused(segments, T_world_base, **how), np.zeros(3))  # type: ignore[arg-type]


def distances_to_walls(points: Array, segments: Array) -> Array:
    """(N,) from each point to the nearest wall, m, both in one frame."""
    start, edge = segments[:, :2], segments[:, 2:] - segments[:, :2]
    along = ((points[:, None] - start) * edge).sum(axis=2) / (edge**2).sum(axis=1)
    nearest = start + np.clip(along, 0.0, 1.0)[..., None] * edge
    away: Array = np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1)
    return away


def turned(segments: Array, T_new_old: Array) -> Array:
    """The same walls in another frame."""
    return np.column_stack(
        [transform(T_new_old, segments[:, :2]), transform(T_new_old, segments[:, 2:])]
    )


def way_through(corners: Line, step_m: float) -> list[Array]:
    """Poses T_world_base along straight legs, turning on the spot by at most 0.15 rad a pose."""
    poses: list[Array] = []
    yaw = None
    for a, b in pairwise(corners):
        heading = math.atan2(b[1] - a[1], b[0] - a[0])
        if yaw is not None:
            turn = math.atan2(math.sin(heading - yaw), math.cos(heading - yaw))
            steps = max(1, math.ceil(abs(turn) / 0.15))
            poses += [se2(*a, yaw + turn * k / steps) for k in range(1, steps)]
        yaw = heading
        length = math.hypot(b[0] - a[0], b[1] - a[1])
        count = max(1, round(length / step_m))
        poses += [
            se2(a[0] + (b[0] - a[0]) * k / count, a[1] + (b[1] - a[1]) * k / count, heading)
            for k in range(count)
        ]
    return poses


def off_by(T_true: Array, T_found: Array) -> tuple[float, float]:
    """(m, rad) between two poses."""
    T = np.linalg.inv(T_true) @ T_found
    return math.hypot(T[0, 2], T[1, 2]), abs(math.atan2(T[1, 0], T[0, 0]))
