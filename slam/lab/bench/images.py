"""What one depth image costs, to simulate and to fuse, and how well it comes out of both."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from datasets.calibration_file import T_BODY_OPTICAL, mounting
from datasets.messages import Array, DepthImage, Float32s, LaserScan, Odometry
from datasets.recording import CameraCalibration, Intrinsics
from datasets.simulation.depth_camera import MODES, DepthModel, simulate_depth
from datasets.simulation.place import MATERIALS, Place, Solid, load_place
from datasets.simulation.place_geometry import cuboid, mesh
from datasets.simulation.robot import DEPTH, ROBOTS
from datasets.simulation.scene import Scene
from datasets.simulation.simulated_drive import SimulatedDrive
from frontend.motion import MotionModel
from fusion.depth_config import DepthConfig
from fusion.depth_projection import DepthProjection
from slam.config import Config
from slam.fusing import Fusing
from slam.lab.bench.jobs import keep_to

LARGE = DepthModel(mode="1280x720")
IMAGES = 40
WARM_UP = 5
"""The first images compile kernels and build the scene."""


@dataclass(frozen=True, slots=True)
class Costs:
    """Of images one after the other, ms."""

    wall_ms: tuple[float, ...]
    cpu_ms: tuple[float, ...]


class _Watch:
    """Adds up what is done between ``start`` and ``stop``."""

    def __init__(self) -> None:
        self.wall_ms = self.cpu_ms = 0.0

    def start(self) -> None:
        self._began = time.perf_counter_ns(), time.process_time_ns()

    def stop(self) -> None:
        wall_ns, cpu_ns = self._began
        self.wall_ms += (time.perf_counter_ns() - wall_ns) * 1e-6
        self.cpu_ms += (time.process_time_ns() - cpu_ns) * 1e-6


def _costs(watches: list[_Watch]) -> Costs:
    counted = watches[WARM_UP:]
    return Costs(tuple(w.wall_ms for w in counted), tuple(w.cpu_ms for w in counted))


def _drive(place: str) -> SimulatedDrive:
    where = load_place(place)
    spec = next(iter(where.drives.values()))
    return SimulatedDrive(where, spec, ROBOTS["paper"].seeing(LARGE, 5.0), 1)


def cost_of_simulating(cores: int) -> Costs:
    """Images of 1280 x 720, evenly spread over a circle of `ring-corridor`."""
    keep_to(cores)
    drive = _drive("ring-corridor")
    watches = []
    for index in np.linspace(0, drive.image_count(DEPTH) - 1, IMAGES + WARM_UP).astype(int):
        watches.append(_Watch())
        watches[-1].start()
        drive.image(DEPTH, int(index))
        watches[-1].stop()
    return _costs(watches)


def cost_of_fusing(cores: int) -> Costs:
    """Images of 1280 x 720 from `office`: each to a view, and the next scan fused with it."""
    keep_to(cores)
    config, drive = Config(), _drive("office")
    motion = MotionModel(config.motion)
    fusing = Fusing(config, drive.calibration, motion, Counter())
    watches: list[_Watch] = []
    waiting: LaserScan | None = None
    fused = True
    for message in _first_images(drive, IMAGES + WARM_UP + 1):
        if isinstance(message, Odometry):
            motion.add_odometry(message)
            if waiting is None or message.stamp_ns < _end_ns(waiting):
                continue
            watches[-1].start()
            fusing.fused(waiting)
            watches[-1].stop()
            waiting, fused = None, True
        elif isinstance(message, DepthImage):
            watches.append(_Watch())
            watches[-1].start()
            fusing.add_view(message)
            watches[-1].stop()
            fused = False
        elif not fused and waiting is None:
            waiting = message
    return _costs(watches[:-1])


def _first_images(
    drive: SimulatedDrive, images: int
) -> Iterator[LaserScan | DepthImage | Odometry]:
    seen = 0
    for message in drive:
        yield message
        seen += isinstance(message, DepthImage)
        if seen == images:
            return


def _end_ns(scan: LaserScan) -> int:
    return scan.stamp_ns + int(1e9 * float(scan.beam_offsets_s.max(initial=0.0)))


# ---- planes ------------------------------------------------------------------------------------


def stands(height_m: float, roll_rad: float = 0.0, down_rad: float = 0.0) -> Array:
    """T_base_camera, (4, 4), over the base's origin."""
    T: Array = mounting((0.0, 0.0, height_m), (roll_rad, down_rad, 0.0)) @ T_BODY_OPTICAL
    return T


def slab(name: str, low: tuple[float, float, float], high: tuple[float, float, float]) -> Solid:
    """A box along the axes between two corners."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    centre, size = ((x0 + x1) / 2, (y0 + y1) / 2), (x1 - x0, y1 - y0, z1 - z0)
    vertices, triangles = mesh([cuboid(centre, size, z0)])
    return Solid(name, vertices, triangles, MATERIALS["wall"])


FLOOR = slab("floor", (-60.0, -60.0, -1.0), (60.0, 60.0, 0.0))


def shot(model: DepthModel, T_base_camera: Array, seed: int, *solids: Solid) -> Float32s:
    """A simulated image of solids, (H, W) m, 0 for holes."""
    scene = Scene(Place("benchmark", solids, floor=False))
    return simulate_depth(scene, T_base_camera, model, np.random.default_rng(seed), 0.0)


def noise_against_formula(mode: str, z_m: float) -> float:
    """Residual of a plane through a wall square to the camera, over z^2 s / (f B), less one."""
    model = DepthModel.model_validate({"mode": mode, "wave_px": 0})
    wall = slab("wall", (z_m, -60.0, -60.0), (z_m + 1.0, 60.0, 60.0))
    residuals_m = [_off_plane(shot(model, stands(0.0), seed, wall), model.K) for seed in range(4)]
    rms_m = float(np.concatenate(residuals_m).std())
    return rms_m / (z_m**2 * model.subpixel_px / model.focal_baseline) - 1.0


def _off_plane(depth_m: Float32s, K: Array) -> Array:
    """z of each valid pixel less that of the plane z = a x + b y + c through them all."""
    v, u = np.nonzero(depth_m)
    z = depth_m[v, u].astype(np.float64)
    design = np.column_stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z**0])
    return np.asarray(z - design @ np.linalg.lstsq(design, z, rcond=None)[0])


def wall_offsets_m(mode: str, distance_m: float, *, waves: bool) -> Array:
    """How far the pseudo-laser's points lie behind a wall straight ahead, of four images."""
    model = DepthModel.model_validate({"mode": mode})
    if not waves:
        model = model.model_copy(update={"wave_px": 0.0})
    T = stands(0.25)
    wall = slab("wall", (distance_m, -60.0, -1.0), (distance_m + 1.0, 60.0, 3.0))
    project = DepthProjection(_calibrated(T, model), DepthConfig())
    off = []
    for seed in range(4):
        view = project(_read(shot(model, T, seed, FLOOR, wall)))
        off.append(view.points_base[:, 0] - distance_m)
    return np.concatenate(off)


def false_beams_on_floor(mode: str, height_m: float, tilt_deg: float) -> tuple[int, int]:
    """(beams with an obstacle, beams) of bare floor.

    The camera stands half a degree otherwise than its calibration says, four ways.
    """
    model, down_rad = DepthModel.model_validate({"mode": mode}), math.radians(tilt_deg)
    project = DepthProjection(_calibrated(stands(height_m, 0.0, down_rad), model), DepthConfig())
    false, beams = 0, 0
    wrong_rad = math.radians(0.5)
    ways = [(wrong_rad, 0.0), (-wrong_rad, 0.0), (0.0, wrong_rad), (0.0, -wrong_rad)]
    for seed, (roll_rad, nod_rad) in enumerate(ways):
        really = stands(height_m, roll_rad, down_rad + nod_rad)
        view = project(_read(shot(model, really, seed, FLOOR)))
        false += int(np.isfinite(view.ranges_m).sum())
        beams += view.ranges_m.size
    return false, beams


def _calibrated(T_base_camera: Array, model: DepthModel) -> CameraCalibration:
    mode = MODES[model.mode]
    return CameraCalibration(T_base_camera, Intrinsics(model.K, mode.width, mode.height))


def _read(depth_m: Float32s) -> DepthImage:
    """As a reader gives it: holes are NaN."""
    return DepthImage(0, "camera", np.where(depth_m > 0.0, depth_m, np.nan).astype(np.float32))
