"""All five tables, from short drives of one seed through the whole application."""

from __future__ import annotations

import csv
import io

import pytest

from slam.lab.drives.constraints import MIN_SCORE
from slam.lab.drives.rows import Rows
from slam.lab.drives.systems import CAMERA, FUSED, FUSED_PAPER, LIDAR, UNION
from slam.lab.tables import paper_tables as paper
from slam.lab.tables.page import page
from tests.slam.lab.small_drives import rows_of_one_seed


@pytest.fixture(scope="module")
def rows() -> Rows:
    return rows_of_one_seed()


def test_nothing_failed(rows: Rows) -> None:
    assert rows.failures == []
    names = {row.system for row in rows.trajectories if row.place == "ring-corridor"}
    assert {LIDAR.name, CAMERA.name, FUSED_PAPER.name, FUSED.name, UNION.name} <= names


def test_the_lidar_shows_no_low_obstacle_and_the_fused_map_those_on_the_way(rows: Rows) -> None:
    found = {
        system: [row.point for row in rows.points if row.system == system and row.error_m]
        for system in (LIDAR.name, FUSED.name)
    }
    assert found[LIDAR.name] == []
    assert {"B", "C"} <= set(found[FUSED.name])
    assert "D" not in found[FUSED.name]  # the drive ends before it
    errors = {row.point: row.error_m for row in rows.points if row.system == FUSED.name}
    assert max(errors["B"] or 0.0, errors["C"] or 0.0) < 0.08


def test_the_true_corners_are_those_of_the_paper(rows: Rows) -> None:
    true = {row.point: (row.true_x_m, row.true_y_m) for row in rows.points}
    assert set(true) == {printed.name for printed in paper.MAP_POINTS}
    for printed in paper.MAP_POINTS:
        assert true[printed.name] == pytest.approx(printed.true_m, abs=1e-3)


def test_only_the_forward_beam_tells_the_lidar_from_the_fused(rows: Rows) -> None:
    mean = {(row.system, row.beam_deg): row.mean_m for row in rows.beams}
    for printed in paper.BEAMS:
        for name in (LIDAR.name, FUSED.name, FUSED_PAPER.name):
            away = 2.06 if (name, printed.beam_deg) == (LIDAR.name, 180) else printed.actual_m
            assert mean[name, printed.beam_deg] == pytest.approx(away, abs=0.03)
    assert {row.scans for row in rows.beam_errors} == {27}


def test_corridors_that_were_not_seen_to_both_ends_are_said_to_be_missing(rows: Rows) -> None:
    assert {row.structure for row in rows.restoration} == {r.name for r in paper.RESTORATION}
    for row in rows.restoration:
        assert row.gamma_percent is None
        assert row.note.startswith("not found")


def test_only_layers_keep_the_low_obstacle(rows: Rows) -> None:
    low = {row.system: row for row in rows.obstacles if row.what == "low"}
    assert low[LIDAR.name].objects_found == 0
    assert low[FUSED.name].objects_found == low[FUSED.name].objects >= 1
    assert low[FUSED.name].missed == ""
    assert "obstacle 1" in low[UNION.name].missed


def test_constraints_of_the_lidar_are_scored_as_its_beams_are(rows: Rows) -> None:
    own = [row for row in rows.constraints if row.system == LIDAR.name and row.score is not None]
    assert len(own) > 10
    for row in own:
        assert row.lidar_score == pytest.approx(row.score, abs=2e-3)
        assert row.scored == (row.score is not None and row.score >= MIN_SCORE)
        assert row.scored or not row.accepted
    assert any(row.scored and not row.accepted for row in own), "bare walls: some slide"


def test_accepted_constraints_of_lidar_and_fused_are_near_the_truth(rows: Rows) -> None:
    for name in (LIDAR.name, FUSED.name):
        errors = [row.error_m for row in rows.constraints if row.system == name and row.accepted]
        assert len(errors) >= 5
        assert sorted(each for each in errors if each is not None)[len(errors) // 2] < 0.05


def test_the_page_has_all_tables_beside_the_papers_figures(rows: Rows) -> None:
    text = page(rows, {1, 2, 3, 4, 5}, {"command": "`slam tables`"}, ["results-room.png"], 1.5)
    for heading in ("Table 1", "Table 2", "Table 3", "Table 4", "Table 5"):
        assert heading in text
    for printed in ("1.772", "0.144", "0.1442", "0.0524", "93.57", "0.763"):
        assert printed in text
    assert "(results-room.png)" in text
    assert "hit 0.55" in text
    assert "| 1.5 min |" in text
    assert "Hard conditions" not in text
    lines = text.splitlines()
    for start, line in enumerate(lines):
        if line.startswith("|---"):
            columns = line.count("|")
            assert lines[start - 1].count("|") == columns
            row = start + 1
            while row < len(lines) and lines[row].startswith("|"):
                assert lines[row].count("|") == columns, lines[row]
                row += 1


def test_tables_that_were_not_asked_for_are_left_out(rows: Rows) -> None:
    text = page(Rows(points=rows.points), {2}, {}, [], 0.0)
    assert "Table 2" in text
    for absent in ("### Table 1", "## Table 3", "## Table 4", "## Table 5", "table 3"):
        assert absent not in text


def test_csv_files_hold_every_row(rows: Rows) -> None:
    texts = rows.csv_texts()
    assert "failures.csv" not in texts
    constraints = list(csv.DictReader(io.StringIO(texts["constraints.csv"])))
    assert len(constraints) == len(rows.constraints)
    assert float(constraints[0]["way_m"]) == pytest.approx(rows.constraints[0].way_m, abs=1e-6)
    points = list(csv.DictReader(io.StringIO(texts["points.csv"])))
    assert [row["error_m"] == "" for row in points] == [r.error_m is None for r in rows.points]
