"""The command ``slam tables``: what it refuses, and what it prints."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slam.lab.drives import seeds
from slam.lab.drives.drives import Job
from slam.lab.drives.rows import BeamErrorRow, BeamRow, Rows
from tests.slam.conftest import Command


def test_a_table_that_the_paper_does_not_have(slam: Command, tmp_path: Path) -> None:
    done = slam("tables", 6, "-o", tmp_path / "out")
    assert done.code == 2
    assert "the paper has no table 6" in done.err
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_a_file(slam: Command, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    done = slam("tables", 3, "-o", tmp_path / "out", "--workers", 1)
    assert done.code == 2
    assert "can't be made" in done.err


def test_the_page_is_printed_and_kept(
    slam: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def quick(job: Job) -> Rows:
        return Rows(
            beams=[BeamRow(job.seed, "Lidar", 180, 1.013, 2.06, 0.01, 9)],
            beam_errors=[BeamErrorRow(job.seed, "Lidar", 9, 0, 0.1, 0.0, 0.3, 0.0)],
        )

    monkeypatch.setattr(seeds, "run_job", quick)
    docs = tmp_path / "docs.md"
    words = ("--seeds", 2, "--workers", 1, "-o", tmp_path / "out", "--page", docs)
    done = slam("tables", 3, *words)
    assert done.code == 0
    assert "## Table 3" in done.out
    assert "slam tables 3 --seeds 2" in done.out
    assert "2 of 2: beam-room, seed 2" in done.err
    assert docs.read_text() == (tmp_path / "out" / "results.md").read_text()
    assert sorted(path.name for path in (tmp_path / "out" / "seeds").iterdir()) == [
        "seed-1",
        "seed-2",
    ]


def test_ctrl_c_ends_all_processes_and_keeps_the_seeds_that_are_done(tmp_path: Path) -> None:
    words = ["tables", "3", "--seeds", "9", "-o", str(tmp_path / "out")]
    program = f"import sys; sys.argv = ['slam', *{words!r}]; from slam.cli import main; main()"
    started = subprocess.Popen(
        [sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert started.stderr is not None
    assert "1 of 9: beam-room" in started.stderr.readline()
    started.send_signal(signal.SIGINT)
    said = started.stderr.read()  # ends when the last process that may write has ended
    assert started.wait() == 130
    assert "broken off" in said
    assert "Traceback" not in said
    kept = [path.name for path in (tmp_path / "out" / "seeds").iterdir()]
    assert 1 <= len(kept) < 9
    assert not (tmp_path / "out" / "results.md").exists()
