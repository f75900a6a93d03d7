"""Drives in several processes: the same rows in the same order, and nothing lost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from slam.lab.drives import drives, seeds
from slam.lab.drives.drives import BEAM_ROOM, RING, ROOM, Job, jobs_of
from slam.lab.drives.rows import BeamErrorRow, FailureRow, Rows
from slam.lab.drives.seeds import run_all, write_csv
from slam.lab.tables.results import Results


def without_cost(rows: list[Rows]) -> list[Rows]:
    return [replace(each, cost=[]) for each in rows]


def test_the_number_of_workers_changes_nothing() -> None:
    jobs = [Job(BEAM_ROOM, seed, (3,)) for seed in (2, 1)]
    alone = run_all(jobs, 1, lambda job, rows: None)
    ended = []
    together = run_all(jobs, 2, lambda job, rows: ended.append(job.seed))
    assert sorted(ended) == [1, 2]
    assert [each.beam_errors[0].seed for each in together] == [2, 1]
    assert without_cost(together) == without_cost(alone)
    assert together[0].beam_errors[0].mae_m != together[1].beam_errors[0].mae_m


def test_a_drive_that_fails_is_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(job: Job) -> Rows:
        raise RuntimeError("no such luck")

    monkeypatch.setattr(seeds, "run_job", broken)
    rows = run_all([Job(RING, 7, (4,))], 1, lambda job, rows: None)
    reason = "RuntimeError: no such luck"
    expected = FailureRow("", RING, 7, "all systems", "the whole drive", reason)
    assert rows == [Rows(failures=[expected])]


def test_the_drives_are_those_the_tables_need(tmp_path: Path) -> None:
    jobs = jobs_of({1, 5}, (4, 5), tmp_path)
    assert [(job.seed, job.place, job.tables) for job in jobs] == [
        (4, RING, (5,)),
        (4, ROOM, (1,)),
        (5, RING, (5,)),
        (5, ROOM, (1,)),
    ]
    assert [job.pictures for job in jobs] == [tmp_path, tmp_path, None, None]
    assert [job.place for job in jobs_of({3}, (1,), tmp_path)] == [BEAM_ROOM]


def rows_of(seed: int) -> Rows:
    return Rows(beam_errors=[BeamErrorRow(seed, "Lidar", 9, 0, 0.1, 0.0, 0.3, 0.0)])


def test_a_seed_is_kept_as_soon_as_all_its_drives_are_done(tmp_path: Path) -> None:
    results = Results(tmp_path / "out", None)
    jobs = jobs_of({2, 3}, (1, 2), tmp_path)
    results.begin(jobs)
    results.keep(jobs[0], Rows())
    assert not (tmp_path / "out" / "seeds").exists()
    results.keep(jobs[1], rows_of(1))
    results.keep(jobs[2], Rows())
    kept = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*.csv"))
    assert [path.as_posix() for path in kept] == ["out/seeds/seed-1/beam_errors.csv"]


def test_the_page_is_written_twice_and_whole(tmp_path: Path) -> None:
    docs = tmp_path / "docs" / "results.md"
    results = Results(tmp_path / "out", docs)
    results.begin([])
    (tmp_path / "out" / "results-room.png").write_bytes(b"picture")
    text = results.finish([rows_of(1), rows_of(2)], {3}, "slam tables 3")
    assert docs.read_text(encoding="utf-8") == text == results.page.read_text(encoding="utf-8")
    assert (docs.parent / "results-room.png").read_bytes() == b"picture"
    assert "slam tables 3" in text
    lines = (tmp_path / "out" / "csv" / "beam_errors.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["seed", "1", "2"]
    assert not list(tmp_path.rglob("*.part"))


def test_results_of_an_earlier_time_are_replaced_but_nothing_else(tmp_path: Path) -> None:
    write_csv(tmp_path / "csv", rows_of(1))
    write_csv(tmp_path / "csv", rows_of(2))
    assert "\n2," in (tmp_path / "csv" / "beam_errors.csv").read_text()
    (tmp_path / "csv" / "thesis.txt").write_text("not ours")
    with pytest.raises(Exception, match="not replaced"):
        write_csv(tmp_path / "csv", rows_of(3))


def test_an_interruption_ends_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(job: Job) -> Rows:
        raise KeyboardInterrupt

    monkeypatch.setattr(seeds, "run_job", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_all([Job(RING, 1, (4,))], 1, lambda job, rows: None)


def test_every_place_of_a_job_is_known() -> None:
    assert {drives.RING, drives.ROOM, drives.BEAM_ROOM} == {"ring-corridor", "room", "beam-room"}
