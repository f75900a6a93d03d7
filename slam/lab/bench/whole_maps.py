"""The parts of the benchmark about maps as a whole: do places that were visited again lie right?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from datasets.trajectory import Stamps, Trajectory
from datasets.tum import read_tum
from slam.evaluation.revisits import RevisitErrors, nearest, revisit_errors
from slam.evaluation.trajectory_error import TrajectoryError, trajectory_error
from slam.lab.bench.session import MappedRecording, Part, Session
from slam.lab.bench.subsampled import write_every_kth_scan
from slam.lab.page import NOTHING, Bar, Measured, Value, table

SUBSAMPLED: Final = "fr079"
OFFSETS: Final = (0, 2, 4)


@dataclass(frozen=True, slots=True)
class WholeMap:
    """A run against the reference trajectory of its recording.

    error : of the poses within 20 ms of a reference pose. References may have few: interpolated in
    between they would be worse than the run.
    """

    label: str
    run: MappedRecording
    revisits: RevisitErrors
    error: TrajectoryError

    @property
    def off_percent(self) -> float:
        """Of the revisits; all, where there are none to judge by."""
        share = self.revisits.off_share
        return 100.0 if share is None else 100.0 * share

    @property
    def p95_m(self) -> float:
        """Infinite where the run has no revisit at all."""
        return math.inf if self.revisits.p95_m is None else self.revisits.p95_m

    @property
    def cpu_s(self) -> float:
        """The median over the runs."""
        return self.run.usages.cpu_s.median

    @property
    def brief(self) -> str:
        """In the form of the other systems' figures."""
        return f"{self.off_percent:.1f} % / {self.p95_m:.2f} m / {self.cpu_s:.1f} s"


def whole_map(session: Session, name: str) -> Measured:
    """One log with all defaults."""
    run = session.map_timed(f"{name}.log.gz")
    found = _compared(session, f"`{name}`", name, run)
    usages = found.run.usages
    values = [
        *_values([found]),
        Value(found.error.translation_m.rmse, f"SE(2) aligned, n = {found.error.count}"),
        Value(found.cpu_s, usages.cpu_s.words("s")),
        Value(usages.peak_mb, "the most of all runs"),
    ]
    return Measured(tuple(values), _table([found]), found.brief)


def without_odometry(session: Session) -> Measured:
    """``intel`` from its scans alone."""
    run = session.map_recording(session.recordings / "intel.log.gz", "--no-odometry")
    found = _compared(session, "`intel` without odometry", "intel", run)
    return Measured(_values([found]), _table([found]))


def subsampled(session: Session, every: int) -> Measured:
    """Every k-th scan of a log, from several first ones; the worst counts."""
    source = session.recordings / f"{SUBSAMPLED}.log.gz"
    found = []
    for offset in OFFSETS:
        target = session.scratch / f"{SUBSAMPLED}-{every}-{offset}.log.gz"
        scans_ns = write_every_kth_scan(source, target, every, offset)
        run = session.map_recording(target)
        label = f"`{SUBSAMPLED}`, scans {offset}, {offset + every}, ..."
        found.append(_compared(session, label, SUBSAMPLED, run, scans_ns))
    return Measured(_values(found), _table(found))


def _compared(
    session: Session,
    label: str,
    name: str,
    run: MappedRecording,
    scans_ns: Stamps | None = None,
) -> WholeMap:
    trajectory = read_tum(run.folder / "trajectory.tum")
    reference = read_tum(session.recordings / f"{name}.reference.tum")
    index, near = nearest(trajectory.stamps_ns, reference.stamps_ns)
    shared = np.unique(index[near])
    at_reference = Trajectory(trajectory.stamps_ns[shared], trajectory.xyyaw[shared])
    return WholeMap(
        label,
        run,
        revisit_errors(trajectory, reference, scans_ns),
        trajectory_error(at_reference, reference),
    )


def _values(found: Sequence[WholeMap]) -> tuple[Value, Value]:
    """The worst share and the worst p95 of one or several runs."""
    most_off = max(found, key=lambda one: one.off_percent)
    widest = max(found, key=lambda one: one.p95_m)
    revisits = most_off.revisits
    off = f"{revisits.off} of {revisits.count} revisits, {revisits.missing} of them missing"
    return (
        Value(most_off.off_percent, f"{off}; {most_off.label}"),
        Value(widest.p95_m, f"{widest.label}, median {_length(widest.revisits.median_m)} m"),
    )


def _length(length_m: float | None) -> str:
    return NOTHING if length_m is None else f"{length_m:.3f}"


def _table(found: Sequence[WholeMap]) -> str:
    head = (
        "recording",
        "revisits",
        "off, %",
        "missing, %",
        "median, m",
        "mean, m",
        "p95, m",
        "ATE rmse, m",
        "ATE maximum, m",
        "CPU, s",
        "peak, MB",
    )
    rows = []
    for one in found:
        errors, metres = one.revisits, one.error.translation_m
        missing = NOTHING if not errors.count else f"{100.0 * errors.missing / errors.count:.1f}"
        lengths = (errors.median_m, errors.mean_m, errors.p95_m, metres.rmse, metres.maximum)
        rows.append(
            (
                one.label,
                str(errors.count),
                f"{one.off_percent:.1f}",
                missing,
                *map(_length, lengths),
                f"{one.cpu_s:.1f}",
                f"{one.run.usages.peak_mb:.0f}",
            )
        )
    return table(head, rows)


def _log_part(
    name: str,
    off: tuple[float, float | None],
    p95_m: tuple[float, float | None],
    ate_m: tuple[float | None, float | None] = (None, None),
    cpu_s: tuple[float | None, float | None] = (None, None),
    peak_mb: tuple[float | None, float | None] = (None, None),
) -> Part:
    """Bars are (must, aim); without one the figure is information."""
    bars = (
        Bar(f"`{name}`, revisits off by more than 0.5 m", "%", *off),
        Bar(f"`{name}`, revisits, p95", "m", *p95_m, 3),
        Bar(f"`{name}`, ATE rmse against its reference", "m", *ate_m, 3),
        Bar(f"`{name}`, mapped as a whole, CPU time", "s", *cpu_s),
        Bar(f"`{name}`, mapped as a whole, peak memory", "MB", *peak_mb, 0),
    )
    return Part(
        f"whole-{name}",
        f"`{name}` as a whole",
        bars,
        (f"{name}.log.gz", f"{name}.reference.tum"),
        partial(whole_map, name=name),
    )


def _subsampled_part(every: int) -> Part:
    what = f"`{SUBSAMPLED}`, every {every}th scan"
    return Part(
        f"whole-every-{every}",
        f"{what}, as a whole",
        (
            Bar(f"{what}, revisits off, worst offset", "%", 0.5, 0.0),
            Bar(f"{what}, revisits, p95", "m", 0.25, 0.16, 3),
        ),
        (f"{SUBSAMPLED}.log.gz", f"{SUBSAMPLED}.reference.tum"),
        partial(subsampled, every=every),
    )


PARTS: Final = (
    _log_part("intel", off=(0.0, None), p95_m=(0.13, None)),
    _log_part("fr079", off=(0.0, None), p95_m=(0.17, None)),
    _log_part("aces", off=(0.0, None), p95_m=(0.12, 0.09), ate_m=(0.20, 0.10), cpu_s=(6.6, 4.3)),
    _log_part(
        "infinite-corridor",
        off=(0.0, None),
        p95_m=(0.22, 0.15),
        ate_m=(0.9, 0.6),
        cpu_s=(27.5, 16.5),
        peak_mb=(700, 500),
    ),
    _log_part("acapulco", off=(0.0, None), p95_m=(0.25, 0.15)),
    _subsampled_part(5),
    _subsampled_part(10),
    Part(
        "whole-no-odometry",
        "`intel` without odometry, as a whole",
        (
            Bar("`intel` without odometry, revisits off", "%", 0.0),
            Bar("`intel` without odometry, revisits, p95", "m", decimals=3),
        ),
        ("intel.log.gz", "intel.reference.tum"),
        without_odometry,
    ),
)
