"""The parts of the benchmark about low obstacles: whether they are in the map, and stay there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from slam.evaluation.obstacle_score import Share
from slam.lab.bench.jobs import side_by_side
from slam.lab.bench.session import Part, Session
from slam.lab.bench.tours import SYSTEMS, Shown, Tour, map_laps, map_tour
from slam.lab.page import Bar, Measured, Value, table

DRIVES: Final = (("ring-corridor", "circle"), ("office", "tour"), ("room", "tour"))
SEEDS: Final = (1, 2)
LAPS: Final = 6
LAPPED: Final = (
    Tour("ring-corridor", "circle", 1, LAPS, 1.0),
    Tour("office", "tour", 1, LAPS, 2.5),
    Tour("room", "tour", 1, LAPS, 5.0),
)


def in_the_map(session: Session) -> Measured:
    """Low obstacles in the final maps of three places, two seeds each."""
    tours = [Tour(place, drive, seed) for place, drive in DRIVES for seed in SEEDS]
    every = dict(zip(tours, side_by_side(map_tour, tours), strict=True))
    values, rows = [], []
    for place, drive in DRIVES:
        fused = [shown["fused"] for tour, shown in every.items() if tour.place == place]
        words = [f"seed {seed}: {_percents(each)}" for seed, each in zip(SEEDS, fused, strict=True)]
        values.append(Value(_worst([each.recall for each in fused]), "; ".join(words)))
        values.append(Value(_worst([each.precision for each in fused]), "the worse of the seeds"))
        found, total = (sum(getattr(each.objects, k) for each in fused) for k in ("hits", "total"))
        lost = sorted({name for each in fused for name in each.lost})
        values.append(
            Value(total - found, f"of {total}" + (f": {', '.join(lost)}" if lost else ""))
        )
        rows += [
            _row(tour, system, shown[system])
            for tour, shown in every.items()
            for system in SYSTEMS
            if (tour.place, tour.drive) == (place, drive)
        ]
    head = ("drive", "seed", "", "recall", "precision", "low objects", "all objects", "ATE, m")
    return Measured(
        tuple(values),
        "The whole application with its own poses, depth 640 x 480 at 5 Hz with all errors, the "
        "robot that the drive names. Recall of cells of 5 cm, precision of the map's occupied "
        "cells, both of what lies below the lidar's plane (docs/measures.md); an object is found "
        "if half of its cells are. In paper mode there is one grid, in which the lidar's beams "
        "free again what the camera marked.\n\n" + table(head, rows),
    )


def after_laps(session: Session) -> Measured:
    """Whether what was found in one lap is still in the map after six."""
    every = side_by_side(map_laps, LAPPED)
    lost, rows = [], []
    for tour, (once, often) in zip(LAPPED, every, strict=True):
        gone = sorted(set(often.lost) - set(once.lost))
        lost += [f"{name} ({tour.place})" for name in gone]
        rows += [
            (
                f"`{tour.place}`, {tour.drive}, {tour.depth_rate_hz:g} images a second",
                laps,
                _percent(shown.recall),
                _percent(shown.precision),
                _share(shown.objects),
                f"{shown.ate_m:.3f}",
            )
            for laps, shown in (("1", once), (str(tour.laps), often))
        ]
    head = ("drive", "laps", "recall", "precision", "low objects", "ATE, m")
    found = sum(once.objects.hits for once, _ in every)
    return Measured(
        (Value(len(lost), f"of {found} found in the first lap" + _listed(lost)),),
        f"{LAPS} laps without a stop, mapped as one recording; the map of the scans of the first "
        "lap against that of all, both at the final poses, asked for what the first lap's images "
        "saw. Fewer images a second than elsewhere in the longer drives, to save time.\n\n"
        + table(head, rows),
    )


def _listed(names: Sequence[str]) -> str:
    return f": {', '.join(names)}" if names else ""


def _worst(shares: Sequence[Share]) -> float:
    return 100.0 * min(share.value or 0.0 for share in shares)


def _percents(shown: Shown) -> str:
    return f"recall {_percent(shown.recall)} precision {_percent(shown.precision)}"


def _percent(share: Share) -> str:
    return "-" if share.value is None else f"{100.0 * share.value:.1f} % of {share.total}"


def _share(share: Share) -> str:
    return f"{share.hits} of {share.total}"


def _row(tour: Tour, system: str, shown: Shown) -> tuple[str, ...]:
    return (
        f"`{tour.place}`, {tour.drive}",
        str(tour.seed),
        system,
        _percent(shown.recall),
        _percent(shown.precision),
        _share(shown.objects),
        _share(shown.all_objects),
        f"{shown.ate_m:.3f}",
    )


def _bars(place: str) -> tuple[Bar, ...]:
    return (
        Bar(f"`{place}`, recall of low obstacles", "%", 95, 100, 1, at_least=True),
        Bar(f"`{place}`, precision of low obstacles", "%", 95, 99, 1, at_least=True),
        Bar(f"`{place}`, low objects not found", "objects", None, None, 0),
    )


PARTS: Final = (
    Part(
        "obstacles",
        "Low obstacles in the map",
        tuple(bar for place, _ in DRIVES for bar in _bars(place)),
        (),
        in_the_map,
    ),
    Part(
        "laps",
        "Low obstacles after five more laps",
        (Bar("low objects found in one lap, gone after six", "objects", 0, None, 0),),
        (),
        after_laps,
    ),
)
