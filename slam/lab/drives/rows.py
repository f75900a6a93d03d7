"""What the experiments measure, as rows of CSV files: one class for each file.

Every row says of which seed and which system it is; ``condition`` is empty for the drives of the
tables, and names what was made harder otherwise. None stands where nothing was measured.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields


@dataclass(frozen=True, slots=True)
class PointRow:
    """Tables 1 and 2: the corner of a low obstacle in the map. how : or why it was not found."""

    seed: int
    system: str
    point: str
    true_x_m: float
    true_y_m: float
    found_x_m: float | None
    found_y_m: float | None
    error_m: float | None
    how: str


@dataclass(frozen=True, slots=True)
class BeamRow:
    """Table 3: one beam over all scans of a drive."""

    seed: int
    system: str
    beam_deg: float
    actual_m: float
    mean_m: float | None
    std_m: float | None
    scans: int


@dataclass(frozen=True, slots=True)
class BeamErrorRow:
    """Table 3: MAE and RMSE over the ten beams of a scan, mean and deviation over the scans."""

    seed: int
    system: str
    scans: int
    missing: int
    mae_m: float
    mae_std_m: float
    rmse_m: float
    rmse_std_m: float


@dataclass(frozen=True, slots=True)
class RestorationRow:
    """Table 4: one structure. gamma_percent is None if it is ghosted or was not found."""

    condition: str
    seed: int
    system: str
    structure: str
    true_m: float
    measured_m: float | None
    gamma_percent: float | None
    std_m: float | None
    note: str


@dataclass(frozen=True, slots=True)
class ConstraintRow:
    """Table 5: one scan matched in one submap. score : None if no pose was found at all.

    scored      : whether the score reaches the threshold; accepted: and the match observed every
                  direction, and no other place fits nearly as well. false : scored, and far from
                  the truth.
    way_m       : driven between the scan and the middle of the submap.
    lidar_score : of the lidar's beams alone, in the lidar's grid, at the same poses.
    error_m, error_deg : of the matched pose against the truth.
    """

    seed: int
    system: str
    after_s: float
    submap: int
    way_m: float
    score: float | None
    lidar_score: float | None
    scored: bool
    accepted: bool
    error_m: float | None
    error_deg: float | None
    false: bool


@dataclass(frozen=True, slots=True)
class ClosureRow:
    """The loop closures that a system found by itself, and those that stayed in its graph."""

    condition: str
    seed: int
    system: str
    tried: int
    accepted: int
    kept: int
    false_accepted: int
    false_kept: int
    kept_error_m: float | None
    kept_error_deg: float | None
    kept_worst_m: float | None


@dataclass(frozen=True, slots=True)
class ObstacleRow:
    """Obstacles in the map: ``what`` is all, or those that the lidar passes over.

    missed : the low objects of which less than half is in the map.
    """

    condition: str
    seed: int
    system: str
    what: str
    hits: int
    cells: int
    true_cells: int
    judged_cells: int
    recall: float | None
    precision: float | None
    f1: float | None
    objects_found: int
    objects: int
    missed: str


@dataclass(frozen=True, slots=True)
class TrajectoryRow:
    """Error of the final trajectory, SE(2) aligned, and what it took."""

    condition: str
    place: str
    seed: int
    system: str
    ate_m: float
    ate_deg: float
    unobserved_m: float
    lost: int
    cpu_s: float


@dataclass(frozen=True, slots=True)
class FailureRow:
    """Something that gave no figure, and why."""

    condition: str
    place: str
    seed: int
    system: str
    what: str
    reason: str


@dataclass(frozen=True, slots=True)
class CostRow:
    """CPU seconds of one stage of one drive, all threads."""

    condition: str
    place: str
    seed: int
    stage: str
    cpu_s: float


@dataclass(slots=True)
class Rows:
    """All rows of one or several drives, in the order in which they were measured."""

    points: list[PointRow] = field(default_factory=list)
    beams: list[BeamRow] = field(default_factory=list)
    beam_errors: list[BeamErrorRow] = field(default_factory=list)
    restoration: list[RestorationRow] = field(default_factory=list)
    constraints: list[ConstraintRow] = field(default_factory=list)
    closures: list[ClosureRow] = field(default_factory=list)
    obstacles: list[ObstacleRow] = field(default_factory=list)
    trajectories: list[TrajectoryRow] = field(default_factory=list)
    failures: list[FailureRow] = field(default_factory=list)
    cost: list[CostRow] = field(default_factory=list)

    def extend(self, other: Rows) -> None:
        """Add the rows of another drive."""
        for each in fields(self):
            getattr(self, each.name).extend(getattr(other, each.name))

    def csv_texts(self) -> dict[str, str]:
        """The text of a CSV file by its name, for all kinds that have rows."""
        return {
            f"{each.name}.csv": _csv(getattr(self, each.name))
            for each in fields(self)
            if getattr(self, each.name)
        }


Row = (
    PointRow
    | BeamRow
    | BeamErrorRow
    | RestorationRow
    | ConstraintRow
    | ClosureRow
    | ObstacleRow
    | TrajectoryRow
    | FailureRow
    | CostRow
)


def _csv(rows: Sequence[Row]) -> str:
    text = io.StringIO()
    names = [each.name for each in fields(rows[0])]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(_cells(asdict(row).values()) for row in rows)
    return text.getvalue()


def _cells(values: Iterable[object]) -> list[object]:
    """Floats to a millionth: what lies beyond is of no unit here."""
    return [round(value, 6) if isinstance(value, float) else value for value in values]
