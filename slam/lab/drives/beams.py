"""Table 3: ten beams of every scan of a standing robot, as they go into the matching."""

from __future__ import annotations

import numpy as np

from datasets.messages import Array
from datasets.simulation.simulated_drive import SimulatedDrive
from frontend.local_slam import LocalResult
from slam.lab.drives.beam_errors import BEAMS_DEG, beam_errors, bearings_of, ranges_at
from slam.lab.drives.mapping import Clock, SharedProjections
from slam.lab.drives.rows import BeamErrorRow, BeamRow, Rows
from slam.lab.drives.systems import System
from slam.lab.tables.paper_tables import BEAMS
from slam.pipeline import Slam

HALF_WIDTH_RAD = float(np.radians(0.5))


def beam_drive(seed: int, drive: SimulatedDrive, systems: tuple[System, ...], clock: Clock) -> Rows:
    """Feed a drive to all systems, and compare each one's scans with the paper's true ranges.

    Every scan counts, the first ones too, which come before the first depth image.
    """
    shared = SharedProjections()
    running = {system.name: Slam(system.config(), drive.calibration) for system in systems}
    for slam in running.values():
        slam.fusing.project = shared
    ranges: dict[str, list[Array]] = {name: [] for name in running}
    messages = iter(drive)
    while True:
        with clock.stage("simulation"):
            message = next(messages, None)
        for name, slam in running.items():
            with clock.stage(name):
                results = slam.flush() if message is None else slam.add(message)
            ranges[name] += [_ranges(result) for result in results]
        if message is None:
            break
    rows = Rows()
    for name, readings in ranges.items():
        _add(rows, seed, name, np.array(readings).reshape(-1, len(BEAMS_DEG)))
    return rows


def _ranges(result: LocalResult) -> Array:
    return ranges_at(result.tracked.scan, bearings_of(np.array(BEAMS_DEG)), HALF_WIDTH_RAD)


def _add(rows: Rows, seed: int, system: str, ranges_m: Array) -> None:
    actual = np.array([beam.actual_m for beam in BEAMS])
    errors = beam_errors(ranges_m, actual, np.array(BEAMS_DEG, dtype=np.float64))
    for k, beam_deg in enumerate(BEAMS_DEG):
        seen = errors.counts[k] > 0
        rows.beams.append(
            BeamRow(
                seed,
                system,
                beam_deg,
                float(actual[k]),
                float(errors.mean_m[k]) if seen else None,
                float(errors.std_m[k]) if seen else None,
                int(errors.counts[k]),
            )
        )
    mae_m, rmse_m = (each[np.isfinite(each)] for each in (errors.mae_m, errors.rmse_m))
    if mae_m.size:
        rows.beam_errors.append(
            BeamErrorRow(
                seed,
                system,
                int(mae_m.size),
                errors.missing,
                float(mae_m.mean()),
                float(mae_m.std()),
                float(rmse_m.mean()),
                float(rmse_m.std()),
            )
        )
