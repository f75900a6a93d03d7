"""De-skew against an exact simulation of a moving lidar, and what a prepared scan promises."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import se2, transform
from frontend.prepared import CAMERA_NORMALS, PreparedScan, prepare
from fusion.scan import CAMERA, FusedScan
from tests.frontend.rooms import ROOM, distances_to_walls, fused, moved

POSE = se2(4.5, 3.5, 0.4)
STILL = np.zeros(3)
MIDDLE_S = 0.07


def off_the_walls(scan: PreparedScan, velocity_base: Array) -> Array:
    """How far the points are from the walls, seen from where the base was at their moment."""
    T_world_base = POSE @ moved(velocity_base, (scan.moment_ns - scan.stamp_ns) * 1e-9)
    return distances_to_walls(transform(T_world_base, scan.points_base), ROOM)


@pytest.mark.parametrize("turn_deg_s", [60.0, -60.0])
@pytest.mark.parametrize("speed", [(0.0, 0.0), (0.8, 0.0), (-0.5, 0.3)])
def test_a_scan_smeared_by_motion_falls_back_on_the_walls(
    turn_deg_s: float, speed: tuple[float, float]
) -> None:
    velocity = np.array([*speed, math.radians(turn_deg_s)])
    smeared = fused(ROOM, POSE, velocity_base=velocity, turn_s=1.0 / 7.0, origin_base=(0.3, 0.1))
    assert off_the_walls(prepare(smeared, STILL), velocity).max() > 0.1, "or nothing is tested"
    assert off_the_walls(prepare(smeared, velocity), velocity).max() < 0.001


@settings(deadline=None, max_examples=30)
@given(
    vx=st.floats(-1.5, 1.5),
    vy=st.floats(-0.5, 0.5),
    w=st.floats(-2.0, 2.0),
    turn_s=st.floats(0.02, 0.2),
)
def test_any_constant_twist_is_undone_within_millimetres(
    vx: float, vy: float, w: float, turn_s: float
) -> None:
    velocity = np.array([vx, vy, w])
    smeared = fused(ROOM, POSE, beams=120, velocity_base=velocity, turn_s=turn_s)
    assert off_the_walls(prepare(smeared, velocity), velocity).max() < 0.003


def test_a_de_skewed_scan_shows_the_points_of_the_middle_of_its_turn() -> None:
    """Point by point: each beam's point, by the exact motion from the middle to it."""
    velocity = np.array([0.7, -0.2, 1.0])
    smeared = fused(ROOM, POSE, velocity_base=velocity, turn_s=2.0 * MIDDLE_S * 360 / 359)
    exact = np.array(
        [
            transform(moved(velocity, float(t) - MIDDLE_S), point[None])[0]
            for t, point in zip(smeared.offsets_s, smeared.points_base, strict=True)
        ]
    )
    scan = prepare(smeared, velocity)
    by_angle = np.argsort(np.arctan2(exact[:, 1], exact[:, 0]), kind="stable")
    assert scan.points_base == pytest.approx(exact[by_angle], abs=2e-4)
    assert scan.moment_ns - scan.stamp_ns == pytest.approx(MIDDLE_S * 1e9, abs=2)


def test_without_beam_times_nothing_moves() -> None:
    snapshot = fused(ROOM, POSE)
    scan = prepare(snapshot, np.array([1.0, 0.0, 2.0]))
    assert scan.points_base is snapshot.points_base
    assert scan.moment_ns == scan.stamp_ns


def test_at_rest_nothing_moves() -> None:
    timed = fused(ROOM, POSE, velocity_base=STILL, turn_s=0.1)
    assert (prepare(timed, STILL).points_base == timed.points_base).all()


@settings(deadline=None, max_examples=20)
@given(w=st.floats(-3.0, 3.0), x=st.floats(-0.4, 0.4))
def test_points_come_by_bearing_with_unit_normals_towards_the_sensor(w: float, x: float) -> None:
    velocity = np.array([0.5, 0.0, w])
    smeared = fused(
        ROOM,
        POSE,
        velocity_base=velocity,
        turn_s=0.15,
        origin_base=(x, 0.1),
        stamp_ns=17,
        sensor="high",
    )
    scan = prepare(smeared, velocity)
    assert (scan.stamp_ns, scan.sensor) == (17, "high")
    rays = scan.points_base - scan.origin_base
    assert scan.bearings_rad == pytest.approx(np.arctan2(rays[:, 1], rays[:, 0]))
    assert (np.diff(scan.bearings_rad) >= 0.0).all()
    assert scan.points_base.flags.c_contiguous
    assert scan.points_base.dtype == np.float64
    lengths = np.linalg.norm(scan.normals_base, axis=1)
    known = lengths > 0.0
    assert scan.surface_count == known.sum() > 250
    assert lengths[known] == pytest.approx(np.ones(known.sum()))
    assert (np.einsum("ij,ij->i", scan.normals_base, rays) <= 0.0).all()


def test_normals_are_those_of_the_walls() -> None:
    scan = prepare(fused(ROOM, POSE, beams=720), STILL)
    normals = scan.normals_base @ POSE[:2, :2].T
    edges = ROOM[:, 2:] - ROOM[:, :2]
    across = np.column_stack([-edges[:, 1], edges[:, 0]]) / np.linalg.norm(edges, axis=1)[:, None]
    known = normals.any(axis=1)
    best = np.abs(normals[known] @ across.T).max(axis=1)
    assert known.mean() > 0.85
    assert np.mean(best > math.cos(math.radians(2.0))) > 0.9


def test_a_scan_without_points_is_prepared_too() -> None:
    scan = prepare(fused(ROOM, POSE, max_range_m=0.01), np.array([1.0, 0.0, 1.0]))
    assert scan.points_base.shape == scan.normals_base.shape == (0, 2)
    assert scan.surface_count == 0


def test_normals_are_as_noisy_as_what_measured_them() -> None:
    scan = fused(ROOM, se2(0.3, 0.2, 0.5))
    count = len(scan.points_base)

    def noise(sources: Array, variance_m2: float) -> float:
        measured: FusedScan = replace(
            scan,
            source=sources.astype(np.uint8),
            variance_m2=np.full(count, variance_m2),
        )
        return prepare(measured, np.zeros(3)).noise

    assert noise(np.zeros(count), 0.01) == 1.0  # a lidar's scan, whatever it says of itself
    assert noise(np.full(count, CAMERA), 1e-6) == pytest.approx(CAMERA_NORMALS)
    assert noise(np.full(count, CAMERA), 0.0019) == pytest.approx(CAMERA_NORMALS * 3.0**0.5)
    half = np.arange(count) % 2 * CAMERA
    assert 1.0 < noise(half, 1e-6) < CAMERA_NORMALS
