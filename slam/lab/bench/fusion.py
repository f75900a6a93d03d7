"""The parts of the benchmark about fusion: what it costs, how true it is, what it adds to maps."""

from __future__ import annotations

from pathlib import Path
from statistics import median
from typing import Final

import numpy as np

from datasets.errors import InputError
from datasets.messages import Array
from datasets.se2 import transform
from datasets.trajectory import Trajectory
from slam.lab.bench.accuracy import JARVIS, JARVIS_HIGH
from slam.lab.bench.calibration import Mounted, estimated
from slam.lab.bench.floor import (
    HEIGHTS_M,
    K_D435,
    floor_beams,
    nodded,
    read_depth,
    read_outlines,
    standing,
)
from slam.lab.bench.images import cost_of_fusing, false_beams_on_floor, wall_offsets_m
from slam.lab.bench.jobs import alone, side_by_side
from slam.lab.bench.session import MappedRecording, Part, Session
from slam.lab.page import Bar, Measured, Value, table

JARVIS_LOW: Final = "/driver_laser_security/laser_scan"
LACKS_M: Final = 0.10
"""What is farther from all that a map shows, the map lacks; what is nearer, it has."""
SAME_ATE_M: Final = 1e-4
"""Two errors no farther apart are the same: a ground truth from reflectors is no better."""
TILTS_DEG: Final = (0.0, 5.0, 10.0, 15.0, 20.0)
FLOOR_HEIGHTS_M: Final = (0.25, 0.62, 1.2)
SIMULATED_MODES: Final = ("1280x720", "640x480")
WALLS_M: Final = (1.0, 2.0, 3.0)
REAL_DEPTH: Final = "../depth/d435"
OUTLINES: Final = Path(__file__).resolve().parents[3] / "tests" / "fusion" / "bare_floor.yaml"
MOUNTED: Final = (
    Mounted("room", "rolled", 0, 1),
    Mounted("room", "tilted", 5, 2),
    Mounted("office", "offset", 11, 3),
    Mounted("office", "paper", 17, 4),
    Mounted("ring-corridor", "offset", 4, 5),
    Mounted("ring-corridor", "tilted", 15, 6),
)


def image_to_fused_scan(session: Session) -> Measured:
    """One depth image to a view, and a scan fused with it."""
    two, one = alone(cost_of_fusing, 2), alone(cost_of_fusing, 1)
    rows = [
        (
            words,
            *(
                f"{part(times_ms):.1f}"
                for times_ms in (costs.wall_ms, costs.cpu_ms)
                for part in (min, median, max)
            ),
        )
        for words, costs in (("two cores", two), ("one core", one))
    ]
    head = ("ms", "wall, best", "median", "worst", "CPU, best", "median", "worst")
    best_ms, cpu_ms = min(two.wall_ms), median(two.cpu_ms)
    how = f"median of {len(two.wall_ms)}, best {best_ms:.1f} ms; CPU {cpu_ms:.1f} ms"
    return Measured(
        (Value(median(two.wall_ms), how),),
        "Depth projection, view for the map, placing, association, compensation: images of a drive "
        "through `office` one after the other, kernels compiled.\n\n" + table(head, rows),
    )


def wall(session: Session) -> Measured:
    """The bias of the pseudo-laser of a wall."""
    rows, worst_mm = [], 0.0
    for mode in SIMULATED_MODES:
        for waves, words in ((False, "off"), (True, "on")):
            off_mm = [1e3 * wall_offsets_m(mode, distance_m, waves=waves) for distance_m in WALLS_M]
            if not waves:
                worst_mm = max(worst_mm, abs(float(off_mm[-1].mean())))
            rows.append((mode, words, *(f"{x.mean():+.1f} (rms {x.std():.1f})" for x in off_mm)))
    head = ("", "slow waves", *(f"{distance_m:g} m" for distance_m in WALLS_M))
    details = "Mean of all ranges of four images less the true one, mm.\n\n" + table(head, rows)
    return Measured((Value(worst_mm, f"the worse of {' and '.join(SIMULATED_MODES)}"),), details)


def simulated_floor(session: Session) -> Measured:
    """Beams with an obstacle on bare simulated floor."""
    jobs = [(mode, tilt) for mode in SIMULATED_MODES for tilt in TILTS_DEG]
    every = [
        (mode, tilt, [false_beams_on_floor(mode, height_m, tilt) for height_m in FLOOR_HEIGHTS_M])
        for mode, tilt in jobs
    ]
    rows = [
        (mode, f"{tilt:g} deg", *(f"{false} of {beams}" for false, beams in found))
        for mode, tilt, found in every
    ]
    false, beams = np.sum([pair for _, _, found in every for pair in found], axis=0).tolist()
    head = ("", "tilt", *(f"{height_m:g} m high" for height_m in FLOOR_HEIGHTS_M))
    return Measured(
        (Value(100.0 * false / beams, f"{false} of {beams} beams; mountings 0.5 deg wrong"),),
        "All errors of the camera, and its mounting half a degree wrong, in four ways.\n\n"
        + table(head, rows),
    )


def real_floor(session: Session) -> Measured:
    """Beams with an obstacle on bare floor, in real images where it was outlined by hand."""
    if not OUTLINES.is_file():
        raise InputError(
            "the floors outlined by hand are not there",
            where=OUTLINES.name,
            remedy="Run the benchmark from a checkout: they lie among the tests",
        )
    folder, outlines = session.recordings / REAL_DEPTH, read_outlines(OUTLINES)
    counts = np.zeros((3, 2), dtype=np.int64)
    for name, outline in outlines.items():
        depth_m = read_depth(folder / f"{name}.png")
        T = standing(depth_m, K_D435, HEIGHTS_M)
        for row, wrong_deg in enumerate((0.0, 0.5, -0.5)):
            turned = nodded(T, np.radians(wrong_deg))
            counts[row] += floor_beams(depth_m, outline, turned)[:2]
    (false, beams), *wrong = counts.tolist()
    others = ", ".join(f"{a} of {b}" for a, b in wrong)
    how = f"{false} of {beams} beams in {len(outlines)} images; 0.5 deg wrong, both ways: {others}"
    return Measured((Value(100.0 * false / beams, how),))


def calibration(session: Session) -> Measured:
    """Errors of ``slam calibrate`` over places, mountings and seeds."""
    every = side_by_side(estimated, MOUNTED)
    errors = np.array([found.errors for found in every])
    cm, deg = 100.0 * np.abs(errors[:, :3]), np.degrees(np.abs(errors[:, 3:]))
    rows = [
        (
            f"`{each.place}` from point {each.from_point}",
            each.robot,
            str(each.seed),
            *(f"{100.0 * value:+.2f}" for value in found.errors[:3]),
            *(f"{np.degrees(value):+.3f}" for value in found.errors[3:]),
            found.trouble,
        )
        for each, found in zip(MOUNTED, every, strict=True)
    ]
    head = ("", "robot", "seed", "x, cm", "y", "z", "roll, deg", "pitch", "yaw", "")
    return Measured(
        (
            Value(float(deg.max()), f"the worst of {deg.size}; mean {deg.mean():.3f} deg"),
            Value(float(cm.max()), f"the worst of {cm.size}; mean {cm.mean():.2f} cm"),
        ),
        "The first 20 s from a way point, depth 640 x 480 at 5 Hz with all errors, wheels that "
        "slip; the guess is off by 7 to 10 cm and 4 to 5 deg in each value. What is not determined "
        "is nan, and misses the bar.\n\n" + table(head, rows),
    )


def second_lidar(session: Session) -> Measured:
    """What the low lidar adds to the map of the high one, and what it does to the trajectory."""
    path = session.recordings / JARVIS
    runs = {
        "fused": session.map_recording(path),
        "high alone": session.map_recording(path, "--lidar", JARVIS_HIGH),
        "low alone": session.map_recording(path, "--lidar", JARVIS_LOW),
    }
    fused, trajectory = _mapped(runs["fused"])
    others = [_mapped(runs[name]) for name in ("high alone", "low alone")]
    high, low = (in_frame_of(trajectory, way, cells) for cells, way in others)
    lacking = low[_apart_m(high, low) > LACKS_M]
    there = _apart_m(fused, lacking) <= LACKS_M
    ate = {name: _ate_m(session, run, path) for name, run in runs.items() if name != "low alone"}
    options = ("--no-odometry",)
    blind = {
        "fused": session.map_recording(path, *options),
        "high alone": session.map_recording(path, "--lidar", JARVIS_HIGH, *options),
    }
    blind_ate = {name: _ate_m(session, run, path) for name, run in blind.items()}
    rows = [(name, f"{ate[name]:.4f}", f"{blind_ate[name]:.4f}") for name in ate]
    share = 100.0 * float(there.mean())
    return Measured(
        (
            Value(share, f"{int(there.sum())} of {there.size} cells, of the low map's {len(low)}"),
            Value(
                ate["fused"],
                f"high lidar alone {ate['high alone']:.4f} m; without odometry "
                f"{blind_ate['fused']:.4f} and {blind_ate['high alone']:.4f} m",
                met=ate["fused"] <= ate["high alone"] + SAME_ATE_M,
            ),
        ),
        "Occupied cells of the low lidar's own map that lie farther than 10 cm from any of the "
        "high lidar's own map; in the fused map are those with an occupied cell within 10 cm. The "
        "maps are laid on each other by their trajectories. ATE rmse, m:\n\n"
        + table(("", "with odometry", "without"), rows),
    )


def in_frame_of(T_map_base: Trajectory, T_other_base: Trajectory, points_other: Array) -> Array:
    """Points (N, 2) of another run's map in this run's, by what both say of the base's way."""
    from slam.evaluation.alignment import alignment  # noqa: PLC0415
    from slam.evaluation.association import Pairs  # noqa: PLC0415

    stamps = T_other_base.stamps_ns
    stamps = stamps[(stamps >= T_map_base.stamps_ns[0]) & (stamps <= T_map_base.stamps_ns[-1])]
    pairs = Pairs(stamps, T_other_base.at(stamps), T_map_base.at(stamps))
    return transform(alignment(pairs), points_other)


def _mapped(run: MappedRecording) -> tuple[Array, Trajectory]:
    """The occupied cells of a run, (N, 2) m, and its trajectory."""
    from slam.mapping.layers import draw_map  # noqa: PLC0415
    from slam.mapping.occupancy import MapConfig, occupied_cells  # noqa: PLC0415
    from slam.runs.run_folder import read_run  # noqa: PLC0415

    read, config = read_run(run.folder), MapConfig()
    drawn = draw_map(read.scans, read.trajectory, config)
    return occupied_cells(drawn, drawn.classes(config)), read.trajectory


def _apart_m(cells: Array, points: Array) -> Array:
    from scipy.spatial import cKDTree  # noqa: PLC0415

    return np.asarray(cKDTree(cells).query(points)[0])


def _ate_m(session: Session, run: MappedRecording, path: Path) -> float:
    options = ("--ground-truth", str(path), "--time-offset", "auto")
    rmse: float = session.evaluate(run, *options)["trajectory"]["ate_translation_m"]["rmse"]
    return rmse


PARTS: Final = (
    Part(
        "fused-scan",
        "A depth image to a fused scan",
        (Bar("depth image 1280 x 720 to fused scan, two cores, wall time", "ms", 25, 15, 1),),
        (),
        image_to_fused_scan,
    ),
    Part(
        "wall",
        "The pseudo-laser of a wall",
        (Bar("simulated wall at 3 m, bias, slow waves off", "mm", 15, 5, 1),),
        (),
        wall,
    ),
    Part(
        "floor",
        "Bare simulated floor",
        (Bar("false obstacles on bare floor, simulated, tilts 0 to 20 deg", "%", 0.5, 0, 3),),
        (),
        simulated_floor,
    ),
    Part(
        "real-floor",
        "Bare real floor",
        (Bar("false obstacles on bare floor, 12 images of `d435`", "%", 0.5, 0, 3),),
        (f"{REAL_DEPTH}/000.png",),
        real_floor,
    ),
    Part(
        "second-lidar",
        "`jarvis_complex`, the low lidar fused with the high one",
        (
            Bar("`jarvis_complex`, low structure in the fused map", "%", 90, 98, 1, at_least=True),
            Bar(
                "`jarvis_complex`, fused, ATE rmse",
                "m",
                f"not worse than high alone by {SAME_ATE_M * 1e3:g} mm",
                None,
                4,
            ),
        ),
        (JARVIS,),
        second_lidar,
    ),
    Part(
        "calibration",
        "Calibration from 20 s",
        (
            Bar("calibration, roll, pitch, yaw, worst error", "deg", 0.5, 0.2, 3),
            Bar("calibration, x, y, height, worst error", "cm", 2.0, 1.0),
        ),
        (),
        calibration,
    ),
)
