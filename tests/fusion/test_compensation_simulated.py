"""The compensation on simulated sensors with all their errors, in the paper's places."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from datasets.messages import Array, DepthImage
from datasets.recording import CameraCalibration, Intrinsics, LidarCalibration
from datasets.se2 import inverse, se2, transform
from datasets.simulation.depth_camera import MODES, DepthModel, simulate_depth
from datasets.simulation.lidar import G4, simulate_turn
from datasets.simulation.place import load_place
from datasets.simulation.scene import Scene
from fusion.compensation import Compensation, CompensationConfig
from fusion.depth_config import DepthConfig
from fusion.depth_projection import DepthProjection
from fusion.deskew import deskew
from fusion.lidar_only import BeamLimits, LidarProjection
from fusion.paper.mode import PaperConfig, PaperProjection, paper_fuse
from fusion.placed_points import PlacedView
from fusion.scan import CAMERA, FusedScan
from fusion.sweep import Sweep
from tests.fusion.paper.test_paper_mode import OPTICAL

CAMERA_MODEL = DepthModel(mode="640x480")
STILL = np.zeros(3)
PoseAt = Callable[[Array], Array]


def mounted(x: float, z: float, rotation: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, (x, 0.0, z)
    return T


T_BASE_LIDAR = mounted(0.0, 0.895, np.eye(3))
T_BASE_CAMERA = mounted(0.15, 0.25, OPTICAL)
MODE = MODES["640x480"]
CALIBRATION = CameraCalibration(T_BASE_CAMERA, Intrinsics(CAMERA_MODEL.K, MODE.width, MODE.height))


def seen(
    scene: Scene, pose: PoseAt, random: np.random.Generator, late_s: float = 0.0
) -> tuple[Sweep, DepthImage, Array]:
    """A turn from time 0, an image so long after its middle, and T_base_view of that image."""
    turn = simulate_turn(scene, pose, T_BASE_LIDAR, G4, 0.0, random)
    scan = turn.normalised(start_ns=0, lidar="lidar", notes=Counter())
    sweep = LidarProjection(LidarCalibration(T_BASE_LIDAR), BeamLimits()).sweep(scan)
    middle_s = sweep.moment_ns * 1e-9
    then, now = pose(np.array([middle_s + late_s]))[0], pose(np.array([middle_s]))[0]
    T_map_base = np.eye(4)
    T_map_base[np.ix_([0, 1, 3], [0, 1, 3])] = se2(*then)
    depth = simulate_depth(
        scene, T_map_base @ T_BASE_CAMERA, CAMERA_MODEL, random, middle_s + late_s
    )
    image = DepthImage(
        round(1e9 * (middle_s + late_s)), "camera", np.where(depth > 0.0, depth, np.float32(np.nan))
    )
    return sweep, image, inverse(se2(*now)) @ se2(*then)


def at_rest(x: float, y: float, yaw: float) -> PoseAt:
    return lambda times_s: np.tile([x, y, yaw], (len(times_s), 1))


def beams(scan: FusedScan, degrees: Array) -> Array:
    """Mean range over 1 deg around directions, counted from backwards: as table 3 counts."""
    rays = scan.points_base - scan.origin_base
    turned = np.degrees(np.arctan2(rays[:, 1], rays[:, 0])) + 180.0
    away = np.abs((turned[:, None] - degrees + 180.0) % 360.0 - 180.0)
    near = [np.hypot(*rays[column < 0.5].T) for column in away.T]
    return np.array([each.mean() for each in near])


ACTUAL = np.array([0.720, 0.781, 0.838, 0.776, 1.135, 1.013, 2.041, 1.303, 1.234, 0.862])
"""Table 3, at 0, 36, .. 324 deg."""


@pytest.mark.parametrize("paper", [False, True])
def test_the_low_object_before_the_robot_is_in_the_scan(paper: bool) -> None:
    scene, random = Scene(load_place("beam-room")), np.random.default_rng(2)
    angles = 36.0 * np.arange(10)
    for _ in range(3):
        sweep, image, T_base_view = seen(scene, at_rest(0.0, 0.0, 0.0), random)
        if paper:
            scan = paper_fuse(sweep, [PaperProjection(CALIBRATION, PaperConfig())(image)])
        else:
            view = PlacedView(DepthProjection(CALIBRATION, DepthConfig())(image), T_base_view)
            one_grid = CompensationConfig(layers=False)
            scan = Compensation(one_grid).fuse(sweep, [view], STILL)
        assert beams(scan, angles) == pytest.approx(ACTUAL, abs=0.04)
        assert beams(sweep.returns(), angles)[5] == pytest.approx(2.06, abs=0.04)
        ahead = scan.points_base[scan.source == CAMERA]
        on_object = (np.abs(ahead[:, 0] - 1.013) < 0.05) & (np.abs(ahead[:, 1]) < 0.25)
        assert np.count_nonzero(on_object) > 60


def test_on_the_move_a_low_obstacle_of_the_ring_stands_where_it_is() -> None:
    """Turning at 0.5 rad/s and driving 0.5 m/s past it, with an image 80 ms late."""
    scene, random = Scene(load_place("ring-corridor")), np.random.default_rng(4)

    def pose(times_s: Array) -> Array:
        yaw = 0.1 + 0.5 * times_s  # an arc of 1 m radius
        return np.column_stack([13.5 + np.sin(yaw), 0.6 - np.cos(yaw), yaw])

    twist = np.array([0.5, 0.0, 0.5])
    sweep, image, T_base_view = seen(scene, pose, random, late_s=0.08)
    view = PlacedView(DepthProjection(CALIBRATION, DepthConfig())(image), T_base_view)
    scan = Compensation(CompensationConfig()).fuse(sweep, [view], twist)
    middle_s = sweep.middle_s
    T_map_base = se2(*pose(np.array([middle_s]))[0])
    points = transform(T_map_base, deskew(scan.points_base, scan.offsets_s - middle_s, twist))
    added, kept = points[scan.layer == 1], points[scan.layer == 0]
    # obstacle 1: its front at x = 15.95, its side at y = 0.35, both 0.328 m high
    on_front = (np.abs(added[:, 0] - 15.95) < 0.05) & (added[:, 1] > 0.3) & (added[:, 1] < 0.8)
    on_side = (np.abs(added[:, 1] - 0.35) < 0.05) & (added[:, 0] > 15.9) & (added[:, 0] < 16.5)
    assert np.count_nonzero(on_front | on_side) > 25
    elsewhere = added[~on_front & ~on_side]
    beside_walls = np.abs(np.abs(elsewhere[:, 1]) - 1.2) < 0.3
    assert np.count_nonzero(beside_walls) <= 3  # no second wall
    near = kept[(kept[:, 0] > 12.0) & (kept[:, 0] < 17.0)]
    off = np.abs(np.abs(near[:, 1]) - 1.2)
    assert np.median(off) < 0.02
