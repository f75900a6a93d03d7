"""From messages to fused scans: which sensors take part, and which views go with which scan."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from datasets.messages import Array, DepthImage, LaserScan
from datasets.recording import Calibration, CameraCalibration
from datasets.se2 import transform
from frontend.motion import MotionModel
from fusion.camera_only import camera_scan
from fusion.compensation import Compensation
from fusion.depth_projection import DepthProjection
from fusion.lidar_only import LidarProjection
from fusion.lidar_view import SYSTEMATIC_SHARE, LidarView
from fusion.paper.mode import PaperProjection, paper_fuse
from fusion.placed_points import PlacedView
from fusion.pseudo_scan import PseudoScan
from fusion.scan import BOTH, FusedScan
from fusion.sweep import Sweep
from fusion.union import union
from slam.config import Config
from slam.mapping.camera_records import ViewRecord, beam_record, view_record
from slam.mapping.layers import SAME_HEIGHT_M, layer_names
from slam.mapping.scan_store import LIDAR

VIEW_AGE_S = 0.3
"""A view farther than this from the middle of a scan isn't fused with it; the map takes it."""

Projecting = Callable[[CameraCalibration, Config], Callable[[DepthImage], PseudoScan]]

KEPT_S = 2.0
"""So old views are kept for scans that wait for their odometry, a second at the most."""


class Fusing:
    """Turns scans and depth images into fused scans, and keeps what the map takes of the views."""

    def __init__(
        self,
        config: Config,
        calibration: Calibration,
        motion: MotionModel,
        left_out: Counter[str],
    ) -> None:
        """calibration : may be filled until a sensor's first message comes.

        left_out : where depth images that can't be used are counted.
        """
        self._config = config
        self._calibration = calibration
        self._motion = motion
        self._left_out = left_out
        self._compensation = Compensation(config.compensation)
        self.project: Projecting = depth_projection
        """Makes the projections of cameras: several pipelines may share theirs."""
        self._cameras: dict[str, Callable[[DepthImage], PseudoScan]] = {}
        self._second_lidars: dict[str, LidarView] = {}
        self._recent: dict[str, deque[PseudoScan]] = {}
        self.lidars: dict[str, LidarProjection] = {}
        self.views: list[ViewRecord] = []
        self.view_counts: Counter[str] = Counter()
        self.without_view: Counter[str] = Counter()
        """Scans with which no view of a sensor was fused, by sensor: none was near in time."""
        self.beams: Counter[int] = Counter()
        """Points of the fused scans by ``source``."""
        self._scans = 0
        self.compared = 0
        """Points in whose directions both kinds of sensor measured something."""

    @property
    def awaits_views(self) -> bool:
        """Whether there may be views to fuse a scan with."""
        return self._config.sensors == "fused" and bool(self._recent)

    def cameras_without_view(self) -> list[str]:
        """The depth cameras that were to take part and gave nothing that could be used."""
        if self._config.sensors == "lidar":
            return []
        return [name for name in sorted(self._calibration.cameras) if not self.view_counts[name]]

    @property
    def keeps_layers(self) -> bool:
        """Whether views go to layers of their own in the map: else all lies in a single grid."""
        return self._config.fusion == "better" and self._config.compensation.layers

    def is_scan(self, message: LaserScan | DepthImage) -> bool:
        """Whether the message is matched as a scan of its own."""
        if isinstance(message, DepthImage):
            return self._config.sensors == "camera"
        return self._config.sensors != "camera" and not self.is_lower(message.lidar)

    def is_view(self, message: LaserScan | DepthImage) -> bool:
        """Whether the message is a view that scans are fused with."""
        if self._config.sensors != "fused":
            return False
        return isinstance(message, DepthImage) or self.is_lower(message.lidar)

    def add_view(self, message: LaserScan | DepthImage) -> PseudoScan | None:
        """Take a view for the scans around it and for the map; None if it can't be used."""
        try:
            view = self._view(message)
        except ValueError as error:
            name = message.camera if isinstance(message, DepthImage) else message.lidar
            self._left_out[f"view of {name} left out: {error}"] += 1
            return None
        self.view_counts[view.sensor] += 1
        if self.keeps_layers:
            record = view_record if isinstance(message, DepthImage) else beam_record
            self.views.append(record(view))
        if view.sensor not in self._recent:
            self._recent[view.sensor] = deque()
            self.without_view[view.sensor] = self._scans
        recent = self._recent[view.sensor]
        recent.append(view)
        while recent[0].stamp_ns < view.stamp_ns - KEPT_S * 1e9:
            recent.popleft()
        return view

    def fused(self, scan: LaserScan | DepthImage) -> FusedScan | None:
        """The scan that is matched; None for a depth image that can't be used.

        Raises ValueError if it isn't known where the scan's lidar stands.
        """
        if isinstance(scan, DepthImage):
            view = self.add_view(scan)
            fused = None if view is None else camera_scan(view)
        else:
            sweep = self._lidar(scan.lidar).sweep(scan)
            fused = self._compensated(sweep) if self.awaits_views else sweep.returns()
            self._scans += 1
        if fused is not None:
            counts = np.bincount(fused.source, minlength=BOTH + 1).tolist()
            self.beams.update(dict(enumerate(counts)))
            measured = np.isfinite(fused.lidar_range_m) & np.isfinite(fused.camera_range_m)
            self.compared += int(np.count_nonzero(measured))
        return fused

    def origins_base(self) -> dict[str, Array]:
        """(2,) m by sensor, where those stand whose messages came."""
        lidars = {name: aim.origin_base for name, aim in self.lidars.items()}
        return lidars | {name: views[-1].origin_base for name, views in self._recent.items()}

    def remount(self, sensor: str, T_true_said: Array, clock_s: float) -> None:
        """Put a sensor, and what it gave to the map, where it stands and when it was taken.

        T_true_said, clock_s : as in ``MountingOffset``.
        """
        if sensor in self.lidars:
            aim = self.lidars[sensor]
            aim.origin_base = transform(T_true_said, aim.origin_base[None])[0]
        if recent := self._recent.get(sensor):
            origin_base = transform(T_true_said, recent[-1].origin_base[None])[0]
            recent.append(replace(recent[-1], origin_base=origin_base))
        self.views = [
            view.moved(T_true_said, clock_s) if view.sensor == sensor else view
            for view in self.views
        ]

    def layer_names(self) -> dict[str, str]:
        """The layer of the map for each sensor; one for all in a single grid."""
        names = layer_names(self._calibration)
        return names if self.keeps_layers else dict.fromkeys(names, LIDAR)

    def _compensated(self, sweep: Sweep) -> FusedScan:
        """The sweep with the nearest view of each other sensor in it."""
        views = []
        for sensor, recent in self._recent.items():
            nearest = min(recent, key=lambda view: abs(view.stamp_ns - sweep.moment_ns))
            if abs(nearest.stamp_ns - sweep.moment_ns) > VIEW_AGE_S * 1e9:
                self.without_view[sensor] += 1
                continue
            views.append(nearest)
        if self._config.fusion == "paper":
            return paper_fuse(sweep, views)
        placed = [
            PlacedView(
                view,
                self._motion.between(sweep.moment_ns, view.stamp_ns),
                SYSTEMATIC_SHARE if view.sensor in self._second_lidars else None,
            )
            for view in views
        ]
        velocity = self._motion.velocity(sweep.moment_ns, 2.0 * sweep.middle_s)
        if self._config.fusion == "union":
            return union(sweep, placed, velocity)
        return self._compensation.fuse(sweep, placed, velocity)

    def _view(self, message: LaserScan | DepthImage) -> PseudoScan:
        if isinstance(message, DepthImage):
            return self._camera(message.camera)(message)
        if message.lidar not in self._second_lidars:
            mounting = self._calibration.lidars[message.lidar]
            self._second_lidars[message.lidar] = LidarView(mounting, self._config.beams)
        turn_s = float(message.beam_offsets_s.max(initial=0.0))
        middle_ns = message.stamp_ns + int(0.5e9 * turn_s)
        velocity = self._motion.velocity(middle_ns, turn_s)
        return self._second_lidars[message.lidar](message, velocity)

    def is_lower(self, lidar: str) -> bool:
        """Whether a lidar is taken like a camera below the highest one."""
        heights = {name: c.T_base_lidar[2, 3] for name, c in self._calibration.lidars.items()}
        if self._config.second_lidar == "scan" or lidar not in heights:
            return False
        return bool(heights[lidar] <= max(heights.values()) - SAME_HEIGHT_M)

    def _lidar(self, name: str) -> LidarProjection:
        if name not in self.lidars:
            mounting = self._calibration.lidars.get(name)
            if mounting is None:
                raise ValueError(
                    f"where '{name}' stands is not known: put it into calibration.lidars"
                )
            self.lidars[name] = LidarProjection(mounting, self._config.beams)
        return self.lidars[name]

    def _camera(self, name: str) -> Callable[[DepthImage], PseudoScan]:
        if name not in self._cameras:
            calibration = self._calibration.cameras.get(name)
            if calibration is None:
                raise ValueError("where it stands is not known: put it into calibration.cameras")
            self._cameras[name] = self.project(calibration, self._config)
        return self._cameras[name]


def depth_projection(
    calibration: CameraCalibration, config: Config
) -> Callable[[DepthImage], PseudoScan]:
    """What makes a camera's images into views.

    Raises ValueError, in words for the report, if its mounting or pinhole is unknown.
    """
    if config.fusion == "paper":
        return PaperProjection(calibration, config.paper)
    return DepthProjection(calibration, config.depth)
