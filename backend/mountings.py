"""Several lidars: where they stand against each other, as the map shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from backend.graph_arrays import Indices
from datasets.messages import Array
from datasets.se2 import between, compose, inverse, se2, transform, xyyaw_rows
from frontend.nodes import Node
from frontend.prepared import PreparedScan
from fusion.scan import LIDAR_LAYER

BRACKET_S = 1.5
MIN_NODES = 20
SMALL_M, SMALL_RAD, SMALL_S = 0.005, 0.002, 0.01
LARGE_M, LARGE_RAD, LARGE_S = 0.2, 0.1, 0.3


@dataclass(frozen=True, slots=True)
class MountingOffset:
    """How a lidar really stands, and its clock, against what is said of it, as seen from another.

    T_true_said : (3, 3); takes points, placed on the base by the mounting as it is said, to where
                  they belong on the base. The identity where no correction is called for.
    clock_s     : to be added to its stamps; 0 where no correction is called for.
    sigma_m, sigma_rad, sigma_s : standard deviations of position, yaw and clock.
    count       : nodes it was estimated from.
    """

    sensor: str
    T_true_said: Array
    clock_s: float
    sigma_m: float
    sigma_rad: float
    sigma_s: float
    count: int

    @property
    def significant(self) -> bool:
        """Whether there is anything to correct."""
        return self.clock_s != 0.0 or not np.array_equal(self.T_true_said, np.eye(3))


def mounting_offsets(nodes: Sequence[Node], T_map_nodes: Array) -> list[MountingOffset]:
    """Estimate the offset of every lidar against the one with the most nodes.

    A lidar that stands elsewhere than its mounting says is matched, to a map that others see too,
    with its base displaced by the same amount everywhere; one whose clock is off, by its
    amount times the velocity. The base itself is known from the other lidar's nodes before and
    after, interpolated in time. Offsets within their uncertainty, or too small to matter, or too
    large to be believed are left at nothing.
    """
    sensors = sorted({node.scan.sensor for node in nodes})
    if len(sensors) < 2:
        return []
    of = {s: np.array([k for k, n in enumerate(nodes) if n.scan.sensor == s]) for s in sensors}
    reference = max(sensors, key=lambda sensor: len(of[sensor]))
    poses = xyyaw_rows(T_map_nodes)
    moments_s = (np.array([node.scan.moment_ns for node in nodes]) - nodes[0].scan.moment_ns) * 1e-9
    found = []
    for sensor in sensors:
        if sensor != reference:
            samples, velocities = _samples(of[reference], of[sensor], poses, moments_s)
            if len(samples) >= MIN_NODES:
                found.append(_offset(sensor, samples, velocities))
    return found


def _offset(sensor: str, samples: Array, velocities: Array) -> MountingOffset:
    """Robust least squares for position, yaw and clock, sample = (x, y, yaw) + velocity clock."""
    count = len(samples)
    A = np.zeros((count, 3, 4))
    A[:, 0, 0] = A[:, 1, 1] = A[:, 2, 2] = 1.0
    A[:, :, 3] = velocities
    solution = np.append(np.median(samples, axis=0), 0.0)
    scale = np.ones(3)
    normal = np.eye(4)
    for _ in range(10):
        residuals = samples - A @ solution
        scale = 1.48 * np.median(np.abs(residuals), axis=0) + np.array([1e-4, 1e-4, 1e-5])
        weights = 1.0 / (1.0 + (residuals / (2.0 * scale)) ** 2) ** 2 / scale**2
        normal = np.einsum("kri,kr,krj->ij", A, weights, A) + np.diag([0.0, 0.0, 0.0, 1e-3])
        solution = np.linalg.solve(normal, np.einsum("kri,kr,kr->i", A, weights, samples))
    x, y, yaw, clock_s = solution.tolist()
    sigma_x, sigma_y, sigma_rad, sigma_s = np.sqrt(np.diag(np.linalg.inv(normal))).tolist()
    sigma_m = float(np.hypot(sigma_x, sigma_y))
    away_m, turn_rad = float(np.hypot(x, y)), abs(yaw)
    moved = away_m > max(SMALL_M, 3.0 * sigma_m) or turn_rad > max(SMALL_RAD, 3.0 * sigma_rad)
    moved &= away_m < LARGE_M and turn_rad < LARGE_RAD
    late = max(SMALL_S, 3.0 * sigma_s) < abs(clock_s) < LARGE_S
    T_true_said = se2(x, y, yaw) if moved else np.eye(3)
    clock_s = clock_s if late else 0.0
    return MountingOffset(sensor, T_true_said, clock_s, sigma_m, sigma_rad, sigma_s, count)


def _samples(
    reference: Indices, other: Indices, poses: Array, moments_s: Array
) -> tuple[Array, Array]:
    """(K, 3) offsets of the other lidar's nodes against the base that the reference's nodes tell,
    and (K, 3) the base's velocities there, in its own axes."""
    order = reference[np.argsort(moments_s[reference], kind="stable")]
    after = np.searchsorted(moments_s[order], moments_s[other])
    inside = (after > 0) & (after < len(order))
    other, after = other[inside], after[inside]
    first, last = order[after - 1], order[after]
    span_s = moments_s[last] - moments_s[first]
    near = (span_s > 0.0) & (span_s < BRACKET_S)
    other, first, last, span_s = other[near], first[near], last[near], span_s[near]
    share = (moments_s[other] - moments_s[first]) / span_s
    whole = between(poses[first], poses[last])
    base = compose(poses[first], whole * share[:, None])
    velocities = whole / span_s[:, None]
    turned = whole[:, 2] * share
    c, s = np.cos(turned), np.sin(turned)
    vx, vy = velocities[:, 0].copy(), velocities[:, 1].copy()
    velocities[:, 0], velocities[:, 1] = c * vx + s * vy, -s * vx + c * vy
    return between(base, poses[other]), velocities


def corrected(
    nodes: Sequence[Node], T_map_nodes: Array, offsets: Sequence[MountingOffset]
) -> tuple[list[Node], Array]:
    """The nodes with their lidars where they really stand, and the bases' poses that go with it."""
    by_sensor = {offset.sensor: offset for offset in offsets}
    moved: list[Node] = []
    poses = T_map_nodes.copy()
    for k, node in enumerate(nodes):
        offset = by_sensor.get(node.scan.sensor)
        if offset is None:
            moved.append(node)
            continue
        T_said_true = inverse(offset.T_true_said)
        poses[k] = poses[k] @ T_said_true
        scan = remounted(node.scan, offset)
        moved.append(replace(node, scan=scan, T_odom_base=node.T_odom_base @ T_said_true))
    return moved, poses


def remounted(scan: PreparedScan, offset: MountingOffset) -> PreparedScan:
    """A scan as the lidar gives it from where and when it really was taken.

    What a camera alone saw stays where it is on the base.
    """
    main = scan.part(LIDAR_LAYER)
    rotation = offset.T_true_said[:2, :2]
    points, normals = scan.points_base.copy(), scan.normals_base.copy()
    points[main] = transform(offset.T_true_said, points[main])
    normals[main] = normals[main] @ rotation.T
    origin = rotation @ scan.origin_base + offset.T_true_said[:2, 2]
    rays = points - origin
    bearings = np.arctan2(rays[:, 1], rays[:, 0])
    order = np.lexsort((bearings, scan.layer))
    return replace(
        scan,
        moment_ns=scan.moment_ns + round(offset.clock_s * 1e9),
        origin_base=origin,
        points_base=np.ascontiguousarray(points[order]),
        normals_base=np.ascontiguousarray(normals[order]),
        bearings_rad=bearings[order],
        weights=scan.weights[order],
    )


def combined(first: MountingOffset, then: MountingOffset) -> MountingOffset:
    """An offset found after another one of the same lidar was corrected, and both as one."""
    return replace(
        then,
        T_true_said=then.T_true_said @ first.T_true_said,
        clock_s=then.clock_s + first.clock_s,
    )
