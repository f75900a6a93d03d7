"""Simulated drives mapped by the whole application, and how much of the obstacles the maps show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from datasets.messages import DepthImage
from datasets.simulation.depth_camera import MODES
from datasets.simulation.place import Place, load_place
from datasets.simulation.robot import ROBOTS
from datasets.simulation.simulated_drive import SimulatedDrive
from datasets.trajectory import Stamps, Trajectory
from slam.config import Config, load_config
from slam.evaluation.obstacle_score import ObstacleScore, Share, score_obstacles
from slam.evaluation.obstacle_truth import CameraView, ObstacleTruth, obstacle_truth
from slam.evaluation.trajectory_error import trajectory_error
from slam.mapping.layers import draw_map
from slam.mapping.occupancy import occupied_cells
from slam.mapping.scan_store import ScanStore
from slam.pipeline import Slam

SYSTEMS: Mapping[str, tuple[str, ...]] = {
    "fused": (),
    "lidar alone": ("sensors=lidar",),
    "paper mode": ("fusion=paper",),
}


@dataclass(frozen=True, slots=True)
class Tour:
    """One of a place's drives, by the robot that it names."""

    place: str
    drive: str
    seed: int
    laps: int = 1
    depth_rate_hz: float = 5.0

    def simulated(self) -> tuple[Place, SimulatedDrive]:
        """The drive, ready to be iterated."""
        place = load_place(self.place)
        spec = place.drives[self.drive]
        robot = ROBOTS[spec.robot].seeing(None, self.depth_rate_hz)
        return place, SimulatedDrive(place, spec, robot, self.seed, laps=self.laps)


@dataclass(frozen=True, slots=True)
class Shown:
    """What a map shows of the obstacles.

    recall, precision, objects : of what lies below the lidar's plane; all_objects : of all.
    lost : the low objects that are not in the map.
    """

    recall: Share
    precision: Share
    objects: Share
    all_objects: Share
    lost: tuple[str, ...]
    ate_m: float

    @classmethod
    def of(cls, score: ObstacleScore, ate_m: float) -> Shown:
        """In short."""
        lost = tuple(each.name for each in score.objects if each.is_low and not each.found)
        return cls(
            score.low.recall,
            score.low.precision,
            score.low_objects_found,
            score.objects_found,
            lost,
            ate_m,
        )


def map_tour(tour: Tour) -> dict[str, Shown]:
    """The final maps of all ``SYSTEMS`` from one simulated drive; SLAM's own poses."""
    place, drive = tour.simulated()
    slams = {
        name: Slam(load_config(None, settings), drive.calibration)
        for name, settings in SYSTEMS.items()
    }
    images = _drive_through(drive, list(slams.values()))
    truth = _truth(place, drive, images)
    shown = {}
    for name, slam in slams.items():
        poses = slam.poses()
        drawn = slam.map()
        cells = occupied_cells(drawn, drawn.classes(slam.config.map))
        score = score_obstacles(truth, cells, poses.trajectory)
        error = trajectory_error(poses.trajectory, truth.T_map_base)
        shown[name] = Shown.of(score, error.translation_m.rmse)
    return shown


def map_laps(tour: Tour) -> tuple[Shown, Shown]:
    """The fused maps after the first lap and after all, at the poses known in the end.

    Both are asked for what was seen in the first lap.
    """
    place, drive = tour.simulated()
    slam = Slam(Config(), drive.calibration)
    images = _drive_through(drive, [slam])
    truth = drive.ground_truth()
    end_ns = end_of_first_lap(truth, tour.laps)
    first = {camera: stamps[stamps <= end_ns] for camera, stamps in images.items()}
    seen = _truth(place, drive, first)
    poses = slam.poses()
    store = slam.scans(poses)
    ate_m = trajectory_error(poses.trajectory, truth).translation_m.rmse
    shown = []
    for scans in (until(store, end_ns), store):
        drawn = draw_map(scans, poses.trajectory, slam.config.map)
        cells = occupied_cells(drawn, drawn.classes(slam.config.map))
        shown.append(Shown.of(score_obstacles(seen, cells, poses.trajectory), ate_m))
    return shown[0], shown[1]


def until(scans: ScanStore, end_ns: int) -> ScanStore:
    """The scans stamped no later than that."""
    count = int(np.searchsorted(scans.stamps_ns, end_ns, side="right"))
    points = int(scans.offsets[count])
    return ScanStore(
        scans.stamps_ns[:count],
        scans.sensor_index[:count],
        scans.offsets[: count + 1],
        scans.points_base[:points],
        scans.roles[:points],
        scans.sensors,
        scans.layers,
        scans.origins_base,
        scans.clear_from_m,
    )


def _drive_through(drive: SimulatedDrive, slams: list[Slam]) -> dict[str, Stamps]:
    """Simulate a drive once for all. Returns when each camera took its images."""
    stamps: dict[str, list[int]] = {name: [] for name in drive.robot.cameras}
    for message in drive:
        if isinstance(message, DepthImage):
            stamps[message.camera].append(message.stamp_ns)
        for slam in slams:
            slam.add(message)
    for slam in slams:
        slam.finish()
    return {name: np.array(taken, dtype=np.int64) for name, taken in stamps.items()}


def _truth(place: Place, drive: SimulatedDrive, images: Mapping[str, Stamps]) -> ObstacleTruth:
    views = []
    for name, camera in drive.robot.cameras.items():
        intrinsics = drive.calibration.cameras[name].intrinsics
        assert intrinsics is not None  # a simulated camera has them
        nearest_m = MODES[camera.model.mode].nearest_m
        views.append(CameraView(camera.T_base_camera, intrinsics, images[name], nearest_m))
    heights_m = [float(lidar.T_base_lidar[2, 3]) for lidar in drive.robot.lidars.values()]
    return obstacle_truth(place, drive.ground_truth(), views, heights_m, drive.start_ns)


def end_of_first_lap(truth: Trajectory, laps: int) -> int:
    """When so many of the whole way's metres were driven."""
    way_m = np.cumsum(np.hypot(*np.diff(truth.xyyaw[:, :2], axis=0).T))
    driven = int(np.searchsorted(way_m, way_m[-1] / laps, side="right"))
    return int(truth.stamps_ns[min(1 + driven, len(way_m))])
