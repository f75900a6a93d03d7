"""Which matches of scans in submaps table 5 accepts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from datasets.se2 import se2
from datasets.trajectory import Trajectory
from frontend.local_map import LocalMap
from frontend.match import Match
from slam.lab.drives import constraints
from slam.lab.drives.constraints import MIN_SCORE, constraint_rows
from tests.frontend.rooms import CABINETS, MARKED_CABINETS, prepared


@pytest.mark.parametrize("marked", [True, False])
def test_a_scan_that_fits_the_next_door_as_well_is_ambiguous(marked: bool) -> None:
    segments = MARKED_CABINETS if marked else CABINETS
    scans = [
        (prepared(segments, T, max_range_m=5.0), T)
        for T in (se2(x, 0.0, 0.0) for x in np.arange(-2.0, 2.1, 0.25))
    ]
    query: Any = SimpleNamespace(scan=prepared(segments, se2(0.1, 0.0, 0.0), max_range_m=5.0))
    match, ambiguous = constraints._match(query, LocalMap.around(scans), np.eye(3))
    assert match is not None
    assert ambiguous != marked


@pytest.mark.parametrize(
    ("score", "weak_sigma_m", "ambiguous", "accepted"),
    [
        (MIN_SCORE, 0.05, False, True),
        (MIN_SCORE - 0.01, 0.01, False, False),
        (0.8, 0.051, False, False),
        (0.8, 0.01, True, False),
    ],
)
def test_accepted_is_what_scores_observes_every_direction_and_fits_nowhere_else(
    monkeypatch: pytest.MonkeyPatch,
    score: float,
    weak_sigma_m: float,
    ambiguous: bool,
    accepted: bool,
) -> None:
    stamps_ns = [0, 1_000_000_000]
    truth = Trajectory.from_matrices(stamps_ns, [np.eye(3), se2(1.0, 0.0, 0.0)])
    anchor, query = (
        SimpleNamespace(scan=SimpleNamespace(moment_ns=stamp_ns), way_m=1e-9 * stamp_ns)
        for stamp_ns in stamps_ns
    )
    T = se2(1.02, 0.0, 0.0)
    match = Match(T, np.eye(3), 0.9, 0.9, 0.01, weak_sigma_m, np.array([1.0, 0.0]))
    found: Any = constraints._Found(anchor, query, 0, match, ambiguous, score, None)  # type: ignore[arg-type]
    monkeypatch.setattr(constraints, "_matches", lambda *_: iter([found]))
    mapped: Any = SimpleNamespace(system=SimpleNamespace(name="Lidar"))
    (row,) = constraint_rows(1, mapped, None, truth)
    assert row.accepted == accepted
    assert row.scored == (score >= MIN_SCORE)
    assert row.error_m == pytest.approx(0.02)
    assert not row.false
