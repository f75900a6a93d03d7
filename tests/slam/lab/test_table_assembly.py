"""Tables from rows that are known: every figure is where it belongs."""

from __future__ import annotations

import pytest

from slam.lab.drives.constraints import MIN_SCORE
from slam.lab.drives.rows import (
    BeamErrorRow,
    BeamRow,
    ClosureRow,
    ConstraintRow,
    ObstacleRow,
    PointRow,
    RestorationRow,
    Rows,
    TrajectoryRow,
)
from slam.lab.drives.systems import CAMERA, FUSED, FUSED_PAPER, LIDAR
from slam.lab.tables.bars import judged, time_taken
from slam.lab.tables.findings import findings
from slam.lab.tables.page import bars_table, standard
from slam.lab.tables.spread import mean_of, mean_spread
from slam.lab.tables.table_beams import beams_table
from slam.lab.tables.table_corridors import corridors_table, obstacles_table
from slam.lab.tables.table_hard import hard_table
from slam.lab.tables.table_points import mean_error_m, points_table
from slam.lab.tables.table_scores import closures_table, scores_table, worth_table


def cells(table: str, first: str) -> list[str]:
    """The cells of the row that begins so."""
    for line in table.splitlines():
        row = [cell.strip() for cell in line.strip("|").split("|")]
        if row[0].strip("*") == first:
            return row
    raise AssertionError(f"no row {first}")


def head(table: str) -> list[str]:
    return [cell.strip() for cell in table.splitlines()[0].strip("|").split("|")]


def point(seed: int, system: str, name: str, error_m: float | None) -> PointRow:
    if error_m is None:
        return PointRow(seed, system, name, 1.0, 2.0, None, None, None, "not found: why")
    return PointRow(seed, system, name, 1.0, 2.0, 1.0 + error_m, 2.0, error_m, "two faces")


def gamma(
    seed: int, system: str, number: int, percent: float | None, note: str = "restored"
) -> RestorationRow:
    measured = None if percent is None else 43.0 * percent / 100.0
    name = f"corridor-{number}"
    return RestorationRow("", seed, system, name, 43.0, measured, percent, 0.004, note)


def constraint(
    seed: int, system: str, after_s: float, score: float, error_m: float, *, observed: bool = True
) -> ConstraintRow:
    scored = score >= MIN_SCORE
    accepted, false = scored and observed, scored and error_m > 0.5
    row = (seed, system, after_s, 0, 8.0, score, score + 0.01)
    return ConstraintRow(*row, scored, accepted, error_m, 0.1, false)


def obstacle(condition: str, system: str, what: str, f1: float, missed: str = "") -> ObstacleRow:
    return ObstacleRow(condition, 1, system, what, 90, 100, 95, 100, 0.9, 0.95, f1, 6, 7, missed)


def test_mean_and_spread_are_of_what_is_there() -> None:
    assert mean_spread([1.0, 2.0, None, 3.0]) == "2.000 ± 1.000"
    assert mean_spread([1.5, None], 1) == "1.5"
    assert mean_spread([None]) == "-"
    assert mean_of([]) is None


def test_points_that_were_not_found_are_counted_and_in_no_mean() -> None:
    rows = [
        point(seed, FUSED.name, name, error)
        for seed, errors in ((1, (0.01, 0.02, 0.03, None)), (2, (0.03, 0.04, 0.05, 0.06)))
        for name, error in zip("ABCD", errors, strict=True)
    ]
    text = points_table(2, rows)
    assert head(text) == ["", "true, m", "paper, m", "paper's error", FUSED.name]
    assert cells(text, "A")[3:] == ["0.138", "(1.020, 2.000), error 0.020 ± 0.014, in 2 of 2 maps"]
    assert cells(text, "D")[4] == "(1.060, 2.000), error 0.060, in 1 of 2 maps"
    assert cells(text, "mean")[3:] == [
        "0.132 (recomputed 0.135)",
        "**0.033 ± 0.018, 7 of 8 found**",
    ]
    error_m, missing = mean_error_m(rows, FUSED.name)
    assert error_m == pytest.approx(0.24 / 7)
    assert missing == 1


def test_beams_stand_beside_the_papers() -> None:
    beams = [
        BeamRow(seed, LIDAR.name, 180.0, 1.013, 2.06 + 0.01 * seed, 0.02, 100) for seed in (1, 2)
    ]
    errors = [BeamErrorRow(seed, LIDAR.name, 100, 3, 0.1 * seed, 0.0, 0.3, 0.0) for seed in (1, 2)]
    text = beams_table(beams, errors)
    assert cells(text, "180") == ["180", "1.013", "2.062", "0.932", "2.075 ± 0.020"]
    assert cells(text, "0")[4] == "- ± -"
    assert cells(text, "MAE")[2:] == [
        "0.1442 (recomputed 0.1452)",
        "0.0501 (recomputed 0.0511)",
        "**0.1500 ± 0.0707**",
    ]
    assert cells(text, "RMSE")[3] == "0.0524 (recomputed 0.0530)"
    assert cells(text, "scans")[4] == "200"
    assert cells(text, "readings missing")[4] == "6"


def test_corridors_that_are_ghosted_are_counted_and_in_no_mean() -> None:
    rows = [gamma(1, LIDAR.name, k, 100.0 + 0.1 * k) for k in (1, 2, 3)]
    rows.append(gamma(1, LIDAR.name, 4, None, "ghosted at its end: 43.0 m, 43.2 m"))
    rows += [gamma(2, LIDAR.name, k, 99.8) for k in (1, 2, 3, 4)]
    text = corridors_table(rows)
    assert cells(text, "gamma_1") == ["gamma_1", "93.57", "97.68", "99.950 ± 0.212"]
    assert cells(text, "gamma_4")[3] == "99.800"
    assert cells(text, "mean of abs(100 - gamma)")[1:] == ["4.26", "2.86", "**0.200 ± 0.000**"]
    assert cells(text, "largest")[1:] == ["6.43", "3.72", "**0.300**"]
    assert cells(text, "spread of the four in a drive")[1:] == ["1.59", "0.60", "0.050 ± 0.071"]
    assert cells(text, "ghosted")[3] == "1 of 8"
    assert cells(text, "not found")[3] == "0 of 8"


def test_obstacles_tell_which_were_missed() -> None:
    rows = [obstacle("", LIDAR.name, what, 0.9, "box 3, obstacle 1") for what in ("all", "low")]
    text = obstacles_table(rows)
    assert cells(text, LIDAR.name)[1:7] == ["0.900", "0.950", "**0.900**"] * 2
    assert cells(text, LIDAR.name)[7] == "6 of 7; missed at least once: box 3, obstacle 1"


def test_scores_are_of_8_accepted_constraints_evenly_spaced() -> None:
    rows = [constraint(1, LIDAR.name, 10.0 * k, 0.6 + 0.01 * k, 0.01) for k in range(15)]
    rows.append(constraint(1, LIDAR.name, 75.0, 0.3, 0.01))
    text = scores_table(rows)
    row = cells(text, LIDAR.name)
    assert row[1:4] == ["0.620", "0.791", "0.712"]
    assert row[4:7] == ["0.600", "0.740", "**0.670**"]
    assert row[7] == "0.680"
    worth = cells(worth_table(rows), LIDAR.name)
    assert worth[1] == "15 of 16"
    assert worth[2] == "0.670"
    assert worth[7:] == ["0", "0", "-", "0"]


def test_what_slides_along_a_wall_is_not_accepted_and_counted_apart() -> None:
    rows = [constraint(1, LIDAR.name, 1.0, 0.6, 0.01)]
    rows += [constraint(1, LIDAR.name, 2.0, 0.8, error, observed=False) for error in (0.2, 1.8)]
    worth = cells(worth_table(rows), LIDAR.name)
    assert worth[1:7] == ["1 of 3", "0.600", "0.610", "0.0100", "0.0100", "0.100"]
    assert worth[7:] == ["0", "2", "1.000", "1"]
    assert cells(scores_table(rows), LIDAR.name)[4:7] == ["0.600", "0.600", "**0.600**"]


def test_systems_without_accepted_constraints_have_dashes() -> None:
    rows = [constraint(1, CAMERA.name, 1.0, 0.2, 3.0)]
    assert cells(scores_table(rows), CAMERA.name)[4:] == ["-", "-", "**-**", "-"]
    assert cells(worth_table(rows), CAMERA.name)[1:] == ["0 of 1", *["-"] * 5, "0", "0", "-", "0"]


def test_closures_are_summed_over_the_seeds() -> None:
    rows = [ClosureRow("", k, LIDAR.name, 8, 3, 2, 1, 0, 0.01, 0.1, 0.02) for k in (1, 2)]
    ways = [TrajectoryRow("", "ring-corridor", 1, LIDAR.name, 0.04, 0.05, 1.0, 0, 4.0)]
    row = cells(closures_table(rows, ways), LIDAR.name)
    assert row[1:6] == ["16", "6", "2", "4", "0"]
    assert row[6:] == ["0.0100 ± 0.0000", "0.100 ± 0.000", "0.040", "0.050", "4.0"]


def test_hard_conditions_stand_in_their_order() -> None:
    rows = Rows()
    for condition in ("glass", "slip"):
        way = TrajectoryRow(condition, "ring-corridor", 1, LIDAR.name, 0.04, 0.05, 1.0, 0, 4.0)
        rows.trajectories.append(way)
        rows.obstacles.append(obstacle(condition, LIDAR.name, "low", 0.5))
    rows.restoration.append(
        RestorationRow("slip", 1, LIDAR.name, "corridor-1", 43.0, None, None, None, "not found: x")
    )
    text = hard_table(rows)
    assert [line.split("|")[1].strip() for line in text.splitlines()[2:]] == ["slip", "glass"]
    assert cells(text, "slip")[2:] == ["-", "-", "1 of 1", "0.040", "0.500", "6 of 7", "0"]


def verdicts(rows: Rows) -> dict[str, str]:
    return {bar.what: bar.verdict(value) for bar, value in judged(standard(rows))}


def test_a_corner_that_was_not_found_misses_the_bar() -> None:
    found = Rows(points=[point(1, FUSED.name, name, 0.03) for name in "ABCD"])
    lost = Rows(points=[*found.points, point(2, FUSED.name, "A", None)])
    what = "table 2, mean map point error, fused"
    assert verdicts(found)[what] == "aim reached"
    assert verdicts(lost)[what] == "MISSED"
    assert "1 corners not found" in bars_table(judged(lost))


def test_every_corridor_of_every_seed_counts_for_the_bar() -> None:
    rows = Rows()
    for name, off in ((LIDAR.name, 0.1), (FUSED.name, 0.15)):
        rows.restoration += [gamma(1, name, k, 100.0 - off) for k in (1, 2, 3, 4)]
    worst, mean = "table 4, largest abs(100 - gamma), fused", "the same, mean"
    assert verdicts(rows) == {worst: "aim reached", mean: "MISSED"}
    rows.restoration.append(gamma(2, FUSED.name, 1, 100.6))
    assert verdicts(rows)[worst] == "MISSED"
    rows.restoration[-1] = gamma(2, FUSED.name, 1, None, "ghosted at its start: 43 m, 43.2 m")
    assert verdicts(rows)[worst] == "MISSED"


def test_hard_conditions_move_no_bar() -> None:
    rows = Rows()
    rows.closures.append(ClosureRow("slip", 1, FUSED.name, 9, 5, 5, 1, 1, 0.1, 0.1, 0.9))
    rows.obstacles.append(obstacle("slip", FUSED.name, "low", 0.1))
    assert verdicts(rows) == {}
    rows.closures.append(ClosureRow("", 1, FUSED.name, 9, 5, 5, 1, 1, 0.1, 0.1, 0.9))
    assert verdicts(rows) == {"false closures that stay in the graph, fused": "MISSED"}


def test_constraints_are_compared_with_those_of_the_lidar() -> None:
    rows = Rows()
    rows.constraints = [constraint(1, LIDAR.name, 1.0, 0.7, 0.03)]
    rows.constraints.append(constraint(1, FUSED.name, 1.0, 0.7, 0.02))
    found = verdicts(rows)
    what = "constraints of table 5 against the truth, mean error, fused (aim {})"
    assert found[what.format("0.02 m")] == "aim reached"
    rows.constraints[0] = constraint(1, LIDAR.name, 1.0, 0.7, 0.019)
    assert verdicts(rows)[what.format("0.02 m")] == "MISSED"
    rows.constraints[0] = constraint(1, LIDAR.name, 1.0, 0.7, 0.03)
    rows.constraints.append(constraint(1, FUSED.name, 2.0, 0.7, 1.98, observed=False))
    assert verdicts(rows)[what.format("0.02 m")] == "aim reached"
    assert (
        verdicts(rows)["the same, with those that slide or fit elsewhere as well, fused"]
        == "information"
    )
    assert "1.0000 m | information | 1 false; the lidar alone 0.0300 m, 0 false" in bars_table(
        judged(rows)
    )


def test_a_difference_within_its_standard_error_makes_no_system_worse() -> None:
    rows = Rows()
    for seed, fused_m in ((1, 0.022), (2, 0.008), (3, 0.014)):
        rows.constraints.append(constraint(seed, LIDAR.name, 1.0, 0.7, 0.013))
        rows.constraints.append(constraint(seed, FUSED.name, 1.0, 0.7, fused_m))
    what = "constraints of table 5 against the truth, mean error, fused (aim 0.02 m)"
    assert verdicts(rows)[what] == "aim reached"
    assert "the difference is +0.0017 ± 0.0041 m" in bars_table(judged(rows))
    rows.constraints[3] = constraint(2, FUSED.name, 1.0, 0.7, 0.018)
    assert verdicts(rows)[what] == "MISSED"


def test_closures_that_stay_are_told_with_their_standard_error() -> None:
    rows = Rows()
    rows.closures = [
        ClosureRow("", 1, LIDAR.name, 9, 2, 2, 0, 0, 0.015, 0.1, 0.02),
        ClosureRow("", 2, LIDAR.name, 9, 0, 0, 0, 0, None, None, None),
        ClosureRow("", 1, FUSED.name, 9, 1, 1, 0, 0, 0.020, 0.1, 0.02),
        ClosureRow("", 2, FUSED.name, 9, 3, 3, 0, 0, 0.012, 0.1, 0.02),
    ]
    what = "closures that stay in the graph, mean error, fused"
    assert verdicts(rows)[what] == "information"
    text = bars_table(judged(rows))
    assert "0.0160 ± 0.0040 m over 2 drives; the lidar alone 0.0150 m over 1 drives" in text
    rows.closures[3] = ClosureRow("", 2, FUSED.name, 9, 3, 3, 1, 1, 1.7, 0.1, 2.0)
    assert verdicts(rows)["false closures that stay in the graph, fused"] == "MISSED"


def test_low_obstacles_need_an_f1_of_95_percent() -> None:
    what = "low obstacles of the ring, F1, fused"
    for f1, verdict in (
        (0.99, "aim reached"),
        (0.96, "must reached, aim not"),
        (0.94, "MISSED"),
    ):
        assert verdicts(Rows(obstacles=[obstacle("", FUSED.name, "low", f1)]))[what] == verdict


def test_the_time_bar_is_one_of_ten_seeds() -> None:
    def verdict(seeds: int, minutes: float) -> str:
        ways = [
            TrajectoryRow("", "room", seed, LIDAR.name, 0.04, 0.05, 1.0, 0, 4.0)
            for seed in range(seeds)
        ]
        bar, value = time_taken(Rows(trajectories=ways), minutes)
        return bar.verdict(value)

    assert verdict(10, 20.0) == "aim reached"
    assert verdict(10, 50.0) == "must reached, aim not"
    assert verdict(10, 61.0) == "MISSED"
    assert verdict(3, 5.0) == "information"


def test_what_does_not_favour_fusion_is_explained_and_nothing_else() -> None:
    good = Rows()
    for name, off in ((LIDAR.name, 0.2), (FUSED.name, 0.1), (FUSED_PAPER.name, 0.15)):
        good.restoration += [gamma(1, name, k, 100.0 - off) for k in (1, 2, 3, 4)]
    good.constraints = [constraint(1, LIDAR.name, 1.0, 0.6, 0.02)]
    good.constraints.append(constraint(1, FUSED.name, 1.0, 0.7, 0.02))
    assert findings(good) == []

    bad = Rows()
    for name, off in ((LIDAR.name, 0.1), (FUSED.name, 0.2), (FUSED_PAPER.name, 1.0)):
        bad.restoration += [gamma(1, name, k, 100.0 - off) for k in (1, 2, 3, 4)]
    bad.points = [point(1, FUSED_PAPER.name, name, None) for name in "ABCD"]
    bad.constraints = [constraint(1, LIDAR.name, 1.0, 0.7, 0.02)]
    bad.constraints.append(constraint(1, FUSED.name, 1.0, 0.6, 0.02))
    bad.constraints.append(constraint(1, FUSED_PAPER.name, 1.0, 0.7, 0.4))
    bad.constraints.append(constraint(1, CAMERA.name, 1.0, 0.7, 2.0))
    said = findings(bad)
    assert len(said) == 6
    for figures in (
        "4 of 4 corners",
        "1.000 %, lidar alone 0.100 %",
        "0.2000 %",
        "0.600, lidar alone 0.700; the lidar's beams at the fused poses 0.610",
        "0.400 m",
        "1 of 1 accepted constraints are false",
    ):
        assert sum(figures in each for each in said) == 1
