"""The drives of the tables: each is simulated once, and gives rows of several tables."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datasets.simulation.place import DriveSpec, Place, load_place
from datasets.simulation.robot import DEPTH, ROBOTS, SCAN, Robot
from datasets.simulation.simulated_drive import SimulatedDrive
from slam.evaluation.obstacle_truth import CameraView, ObstacleTruth, obstacle_truth
from slam.lab.drives import systems as all_systems
from slam.lab.drives.beams import beam_drive
from slam.lab.drives.conditions import Condition, setting_of
from slam.lab.drives.constraints import LidarScans, constraint_rows
from slam.lab.drives.map_pictures import write_side_by_side
from slam.lab.drives.map_tables import (
    closure_row,
    obstacle_rows,
    point_rows,
    restoration_rows,
    trajectory_row,
)
from slam.lab.drives.mapping import Clock, DriveMapped, map_drive
from slam.lab.drives.rows import CostRow, FailureRow, Rows
from slam.lab.drives.systems import (
    CAMERA,
    CAMERA_PAPER,
    FUSED,
    FUSED_PAPER,
    LIDAR,
    UNION,
    System,
)

ROOM, BEAM_ROOM, RING = "room", "beam-room", "ring-corridor"
DRIVES = {ROOM: "tour", BEAM_ROOM: "stand", RING: "circle"}


@dataclass(frozen=True, slots=True)
class Job:
    """One drive to simulate. pictures : a folder for pictures of its maps, or None for none."""

    place: str
    seed: int
    tables: tuple[int, ...]
    condition: Condition | None = None
    pictures: Path | None = None


def jobs_of(tables: Collection[int], seeds: Sequence[int], pictures: Path) -> list[Job]:
    """The drives that the tables need, seed by seed; pictures are drawn for the first seed."""
    needed = [
        (place, tuple(sorted(own & set(tables))))
        for place, own in ((RING, {4, 5}), (ROOM, {1, 2}), (BEAM_ROOM, {3}))
        if own & set(tables)
    ]
    return [
        Job(place, seed, own, None, pictures if seed == seeds[0] else None)
        for seed in seeds
        for place, own in needed
    ]


def hard_jobs(conditions: Sequence[Condition], seeds: Sequence[int]) -> list[Job]:
    """The drives under hard conditions; the longest first, so that no worker is left alone."""
    ordered = sorted(conditions, key=lambda condition: -condition.laps)
    return [Job(each.place, seed, (), each) for each in ordered for seed in seeds]


def run_job(job: Job) -> Rows:
    """Simulate a drive, map it with all systems, and measure."""
    if job.condition is not None:
        return hard_drive(job.seed, job.condition)
    place = load_place(job.place)
    spec = place.drives[DRIVES[job.place]]
    if job.place == ROOM:
        return room_drive(job.seed, place, spec, job.tables, job.pictures)
    if job.place == BEAM_ROOM:
        return beams_drive(job.seed, place, spec)
    return ring_drive(job.seed, place, spec, job.tables, job.pictures)


def room_drive(
    seed: int, place: Place, spec: DriveSpec, tables: Collection[int], pictures: Path | None = None
) -> Rows:
    """Tables 1 and 2: camera alone, fused, and the lidar alone."""
    chosen: list[System] = [LIDAR]
    if 1 in tables:
        chosen += [CAMERA_PAPER, CAMERA]
    if 2 in tables:
        chosen += [FUSED_PAPER, FUSED]
    clock, rows = Clock(), Rows()
    done = map_drive(SimulatedDrive(place, spec, ROBOTS[spec.robot], seed), chosen, clock)
    with clock.stage("measures"):
        for mapped in done.mapped.values():
            rows.points += point_rows(seed, place, mapped)
    _finish(rows, done, place.name, seed, clock)
    if pictures is not None:
        write_side_by_side(pictures / "results-room.png", list(done.mapped.values()))
    return rows


def beams_drive(seed: int, place: Place, spec: DriveSpec) -> Rows:
    """Table 3: the lidar alone, and fused in both modes."""
    clock = Clock()
    drive = SimulatedDrive(place, spec, ROBOTS[spec.robot], seed)
    rows = beam_drive(seed, drive, (LIDAR, FUSED_PAPER, FUSED), clock)
    _count_cost(rows, "", place.name, seed, clock)
    return rows


def ring_drive(
    seed: int, place: Place, spec: DriveSpec, tables: Collection[int], pictures: Path | None = None
) -> Rows:
    """Tables 4 and 5, the low obstacles, and the systems' own closures."""
    chosen: list[System] = [LIDAR, FUSED_PAPER, FUSED]
    if 4 in tables:
        chosen.append(UNION)
    if 5 in tables:
        chosen += [CAMERA, *all_systems.others_systems()]
    clock, rows = Clock(), Rows()
    drive = SimulatedDrive(place, spec, ROBOTS[spec.robot], seed)
    done = map_drive(drive, chosen, clock)
    by_name = done.mapped
    if 4 in tables:
        with clock.stage("obstacle truth"):
            truth = true_obstacles(place, drive)
        for system in (LIDAR, FUSED_PAPER, FUSED, UNION):
            if system.name not in by_name:
                continue
            mapped = by_name[system.name]
            with clock.stage("obstacles"):
                rows.obstacles += obstacle_rows("", seed, mapped, truth, bayes=system is FUSED)
            if system is UNION:
                continue
            with clock.stage("restoration"):
                rows.restoration += restoration_rows("", seed, place, mapped, done.truth)
    if 5 in tables:
        with clock.stage("constraints"):
            lidar = None
            if LIDAR.name in by_name:
                lidar = LidarScans.of(by_name[LIDAR.name], done.truth)
            for system in chosen:
                if system is not UNION and system.name in by_name:
                    mapped = by_name[system.name]
                    rows.constraints += constraint_rows(seed, mapped, lidar, done.truth)
    for mapped in by_name.values():
        rows.closures.append(closure_row("", seed, mapped, done.truth))
    _finish(rows, done, place.name, seed, clock)
    if pictures is not None:
        shown = (LIDAR, FUSED_PAPER, FUSED, CAMERA)
        maps = [by_name[system.name] for system in shown if system.name in by_name]
        write_side_by_side(pictures / "results-ring.png", maps)
    return rows


def hard_drive(seed: int, condition: Condition) -> Rows:
    """A drive under a hard condition: corridors, obstacles, closures, trajectories."""
    place, spec, robot = setting_of(condition)
    chosen = [system.but(*condition.settings) for system in (LIDAR, FUSED_PAPER, FUSED)]
    return hard_drive_of(seed, condition, place, spec, robot, chosen)


def hard_drive_of(
    seed: int,
    condition: Condition,
    place: Place,
    spec: DriveSpec,
    robot: Robot,
    chosen: Sequence[System],
) -> Rows:
    """The same on any place and drive."""
    clock, rows = Clock(), Rows()
    drive = SimulatedDrive(place, spec, robot, seed, laps=condition.laps)
    done = map_drive(drive, chosen, clock)
    truth = true_obstacles(place, drive)
    for mapped in done.mapped.values():
        rows.restoration += restoration_rows(condition.name, seed, place, mapped, done.truth)
        rows.obstacles += obstacle_rows(condition.name, seed, mapped, truth)
        rows.closures.append(closure_row(condition.name, seed, mapped, done.truth))
    _finish(rows, done, place.name, seed, clock, condition.name)
    return rows


def true_obstacles(place: Place, drive: SimulatedDrive) -> ObstacleTruth:
    """What the camera could have seen on a drive.

    At even times, whenever the seed lets the camera begin: so it is one truth for all seeds.
    """
    camera = drive.calibration.cameras[DEPTH]
    assert camera.T_base_camera is not None  # a simulated robot's cameras are known
    assert camera.intrinsics is not None
    rate_hz = drive.robot.cameras[DEPTH].rate_hz
    times_s = np.arange(int(drive.drive.duration_s * rate_hz) + 1) / rate_hz
    stamps_ns = drive.start_ns + np.round(times_s * 1e9).astype(np.int64)
    view = CameraView(camera.T_base_camera, camera.intrinsics, stamps_ns)
    height_m = float(drive.calibration.lidars[SCAN].T_base_lidar[2, 3])
    return obstacle_truth(place, drive.ground_truth(), [view], [height_m], drive.start_ns)


def _finish(
    rows: Rows, done: DriveMapped, place: str, seed: int, clock: Clock, condition: str = ""
) -> None:
    for mapped in done.mapped.values():
        rows.trajectories.append(trajectory_row(condition, place, seed, mapped, done.truth))
    for name, reason in done.failed.items():
        rows.failures.append(FailureRow(condition, place, seed, name, "the whole drive", reason))
    _count_cost(rows, condition, place, seed, clock)


def _count_cost(rows: Rows, condition: str, place: str, seed: int, clock: Clock) -> None:
    for stage, cpu_s in clock.cpu_s.items():
        rows.cost.append(CostRow(condition, place, seed, stage, cpu_s))
