"""One simulated drive through several systems at once: it is simulated once, for all of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from datasets.messages import Array, DepthImage
from datasets.recording import CameraCalibration
from datasets.se2 import placed
from datasets.simulation.simulated_drive import SimulatedDrive
from datasets.trajectory import Trajectory
from fusion.pseudo_scan import PseudoScan
from slam.config import Config
from slam.fusing import depth_projection
from slam.lab.drives.systems import System
from slam.mapping.layers import LayeredMap, draw_map
from slam.mapping.occupancy import OCCUPIED, Classes, occupied_cells
from slam.mapping.scan_records import Poses
from slam.mapping.scan_store import CLEAR, ScanStore
from slam.pipeline import Slam


class Clock:
    """CPU seconds of this process, by stage."""

    def __init__(self) -> None:
        self.cpu_s: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what is done within to a stage."""
        started = time.process_time()
        try:
            yield
        finally:
            self.cpu_s[name] = self.cpu_s.get(name, 0.0) + time.process_time() - started


class SharedProjections:
    """Depth images are projected once for all systems that do it in the same way."""

    def __init__(self) -> None:
        self._made: dict[str, Callable[[DepthImage], PseudoScan]] = {}

    def __call__(
        self, calibration: CameraCalibration, config: Config
    ) -> Callable[[DepthImage], PseudoScan]:
        """In place of ``slam.fusing.depth_projection``. For the cameras of one robot."""
        section = config.paper if config.fusion == "paper" else config.depth
        key = f"{id(calibration)} {section!r}"
        if key not in self._made:
            self._made[key] = _OnceAnImage(depth_projection(calibration, config))
        return self._made[key]


class _OnceAnImage:
    """Keeps what came of the last image, by the image itself."""

    def __init__(self, project: Callable[[DepthImage], PseudoScan]) -> None:
        self._project = project
        self._image: DepthImage | None = None
        self._view: PseudoScan | None = None

    def __call__(self, image: DepthImage) -> PseudoScan:
        if image is not self._image or self._view is None:
            self._view = self._project(image)
            self._image = image
        return self._view


@dataclass
class Mapped:
    """A system that has been through a drive. cpu_s : of the system itself."""

    system: System
    slam: Slam
    poses: Poses
    store: ScanStore
    cpu_s: float

    @cached_property
    def map(self) -> LayeredMap:
        """Its map, drawn when it is first asked for."""
        return draw_map(self.store, self.poses.trajectory, self.slam.config.map)

    @cached_property
    def classes(self) -> Classes:
        """Of the whole map, as a robot uses it."""
        return self.map.classes(self.slam.config.map)

    def occupied_map(self) -> Array:
        """(N, 2) m, the centres of the occupied cells."""
        return occupied_cells(self.map, self.classes)

    def points_map(self, layer: str) -> tuple[Array, Array]:
        """(points (N, 2), where the sensor stood (N, 2)), m: what a layer of the map is made of.

        Those points only that lie in occupied cells of that layer: what the map doesn't show
        any more, since something freed it, is not in the map.
        """
        store, grid = self.store.of_layer(layer), self.map.layers.get(layer)
        if grid is None:
            return np.empty((0, 2)), np.empty((0, 2))
        counts = np.diff(store.offsets)
        rows = np.repeat(self.poses.trajectory.at(store.stamps_ns), counts, axis=0)
        origins = np.repeat(store.origins_base[store.sensor_index], counts, axis=0)
        hit = store.roles != CLEAR
        points = placed(rows[hit], store.points_base[hit].astype(np.float64))
        cells = np.floor((points - grid.corner_map_m) / grid.resolution_m).astype(np.int64)
        height, width = grid.shape
        inside = ((cells >= 0) & (cells < (width, height))).all(axis=1)
        shown = np.zeros(len(points), dtype=np.bool_)
        classes = grid.classes(self.slam.config.map)
        shown[inside] = classes[cells[inside, 1], cells[inside, 0]] == OCCUPIED
        return points[shown], placed(rows[hit][shown], origins[hit][shown])


@dataclass
class DriveMapped:
    """What came of a drive: each system by its name, mapped or the reason why not."""

    drive: SimulatedDrive
    truth: Trajectory
    mapped: dict[str, Mapped] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)


def map_drive(drive: SimulatedDrive, systems: Sequence[System], clock: Clock) -> DriveMapped:
    """Simulate a drive once and feed it to every system; one that fails costs itself only."""
    shared = SharedProjections()
    out = DriveMapped(drive, drive.ground_truth())
    running = {system.name: Slam(system.config(), drive.calibration) for system in systems}
    for slam in running.values():
        slam.fusing.project = shared
    messages = iter(drive)
    while True:
        with clock.stage("simulation"):
            message = next(messages, None)
        if message is None:
            break
        for name in list(running):
            with clock.stage(name):
                try:
                    running[name].add(message)
                except ValueError as error:  # one scan lost, as in ``slam run``
                    running[name].left_out[f"scan left out: {error}"] += 1
                except Exception as error:
                    out.failed[name] = _reason(error)
                    del running[name]
    by_name: Mapping[str, System] = {system.name: system for system in systems}
    for name, slam in running.items():
        with clock.stage(name):
            try:
                slam.finish()
                poses = slam.poses()
                store = slam.scans(poses)
            except Exception as error:
                out.failed[name] = _reason(error)
                continue
        out.mapped[name] = Mapped(by_name[name], slam, poses, store, clock.cpu_s[name])
    return out


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
