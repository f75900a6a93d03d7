"""The benchmark measures what it says it measures, and writes down what it measured."""

from __future__ import annotations

import gzip
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets.messages import LaserScan, Message, Odometry
from datasets.open_recording import open_recording
from datasets.options import ReadOptions
from slam.lab import benchmark
from slam.lab.bench.growth import write_there_and_back
from slam.lab.bench.measure import CommandFailedError, Spread, Usage, Usages, measure, measure_often
from slam.lab.bench.scans import summary, time_scans
from slam.lab.bench.session import Part, Session
from slam.lab.benchmark import PARTS, measure_part
from slam.lab.page import (
    Bar,
    Measured,
    Result,
    Value,
    circumstances,
    commit,
    page,
)
from tests.slam.ring_log import DemoFiles


def python(program: str) -> list[str]:
    return [sys.executable, "-c", program]


def read(path: Path) -> list[Message]:
    return list(open_recording([path], ReadOptions()))


def head_of(source: Path, target: Path, lines: int) -> Path:
    """The first lines of a gzipped log."""
    with gzip.open(source, "rb") as whole, gzip.open(target, "wb") as part:
        part.writelines(line for _, line in zip(range(lines), whole, strict=False))
    return target


# ---- what a command costs ----------------------------------------------------------------------


def test_work_counts_as_cpu_time_and_sleep_does_not() -> None:
    busy = "import time\nwhile time.process_time() < 0.3: pass"
    asleep = "import time\ntime.sleep(0.5)"
    worked, slept = measure(python(busy)), measure(python(asleep))
    assert worked.cpu_s >= 0.3
    assert slept.wall_s >= 0.5
    assert slept.wall_s - slept.cpu_s > 0.4


def test_what_a_child_of_the_command_does_counts() -> None:
    busy = "import time\nwhile time.process_time() < 0.3: pass"
    parent = f"import subprocess, sys\nsubprocess.run([sys.executable, '-c', {busy!r}])"
    assert measure(python(parent)).cpu_s >= 0.3


def test_the_peak_is_what_was_held_at_most() -> None:
    held = measure(python("b = bytearray(b'x') * 300_000_000\ndel b"))
    assert 300 < held.peak_mb < 400


def test_the_peak_is_not_that_of_whoever_measures() -> None:
    """Linux would count it in: a process starts as a copy of the one that starts it."""
    ballast = bytearray(b"x") * 300_000_000
    assert measure(python("pass")).peak_mb < 100
    del ballast


def test_the_output_is_kept_and_the_environment_set() -> None:
    program = "import os; print(os.environ['WHERE'])"
    assert measure(python(program), {"WHERE": "here"}).out == "here\n"


def test_a_command_that_fails_tells_its_last_line() -> None:
    program = "import sys; print('first', file=sys.stderr); sys.exit('the reason')"
    with pytest.raises(CommandFailedError, match="ended with 1: the reason"):
        measure(python(program))


def test_a_command_that_does_not_exist_fails() -> None:
    with pytest.raises(CommandFailedError, match="no-such-command"):
        measure(["no-such-command"])


def test_a_command_that_is_killed_fails() -> None:
    program = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    with pytest.raises(CommandFailedError, match="ended with -9: nothing on stderr"):
        measure(python(program))


@pytest.mark.parametrize(("warm_up", "started"), [(True, 4), (False, 3)])
def test_the_run_that_warms_up_is_not_counted(tmp_path: Path, warm_up: bool, started: int) -> None:
    log = tmp_path / "log"
    command = python(f"open({str(log)!r}, 'a').write('started\\n')")
    used = measure_often(command, 3, warm_up=warm_up)
    assert used.cpu_s.count == 3
    assert len(log.read_text().splitlines()) == started


def test_usages_have_medians_and_the_largest_peak() -> None:
    used = Usages.of([Usage(s, 2 * s, mb, "") for s, mb in ((5.0, 30.0), (1.0, 50.0), (2.0, 40.0))])
    assert used == Usages(Spread(2.0, 1.0, 5.0, 3), Spread(4.0, 2.0, 10.0, 3), 50.0)
    assert used.cpu_s.words("s", 1) == "2.0 s (median of 3, 1.0 to 5.0)"
    assert Spread.of([0.25]).words("s") == "0.25 s (one run)"


# ---- a recording three times as long -----------------------------------------------------------


def check_there_and_back(source: Path, target: Path) -> None:
    """Stamps and odometry of the written log, as the reader finds them, against the definition."""
    write_there_and_back(source, target)
    once, thrice = read(source), read(target)
    start_ns, end_ns = once[0].stamp_ns, once[-1].stamp_ns
    for kind in (LaserScan, Odometry):
        one = [message for message in once if isinstance(message, kind)]
        back = [message for message in reversed(one) if message.stamp_ns < end_ns]
        again = [message for message in one if message.stamp_ns > start_ns]
        expected = [(m.stamp_ns, m) for m in one]
        expected += [(2 * end_ns - m.stamp_ns, m) for m in back]
        expected += [(m.stamp_ns + 2 * (end_ns - start_ns), m) for m in again]
        found = [message for message in thrice if isinstance(message, kind)]
        assert [message.stamp_ns for message in found] == [stamp for stamp, _ in expected]
        for message, (_, original) in zip(found, expected, strict=True):
            if isinstance(message, LaserScan) and isinstance(original, LaserScan):
                np.testing.assert_array_equal(message.ranges_m, original.ranges_m)
            elif isinstance(message, Odometry) and isinstance(original, Odometry):
                np.testing.assert_array_equal(message.T_odom_base, original.T_odom_base)


def test_there_and_back_the_demo(demo: DemoFiles, tmp_path: Path) -> None:
    source = head_of(demo.recording, tmp_path / "short.log.gz", 120)
    check_there_and_back(source, tmp_path / "long.log.gz")


def test_there_and_back_a_recorded_log(shared_data: Path, tmp_path: Path) -> None:
    """Its lines come in bursts, with stamps that repeat and a parameter before them."""
    whole = shared_data / "recordings" / "fr079.log.gz"
    source = head_of(whole, tmp_path / "short.log.gz", 600)
    check_there_and_back(source, tmp_path / "long.log.gz")
    recordings = [open_recording([p], ReadOptions()) for p in sorted(tmp_path.glob("*.log.gz"))]
    for recording in recordings:
        assert sum(1 for _ in recording) > 500
    mountings = [r.calibration.lidars["front"].T_base_lidar[0, 3] for r in recordings]
    assert mountings == [-0.04, -0.04]


# ---- scan after scan ---------------------------------------------------------------------------


def test_every_scan_is_timed(demo: DemoFiles, tmp_path: Path) -> None:
    recording = open_recording(
        [head_of(demo.recording, tmp_path / "short.log.gz", 60)], ReadOptions()
    )
    messages = list(recording)
    scans = sum(isinstance(message, LaserScan) for message in messages)
    times = time_scans(messages, recording.calibration)
    assert {clock: len(times_ms) for clock, times_ms in times.items()} == {
        "wall_ms": scans,
        "cpu_ms": scans,
    }
    assert min(times["wall_ms"]) > 0.0


def test_the_summary_of_times() -> None:
    times_ms = [float(k) for k in range(101)]
    assert summary(times_ms) == {"p50": 50.0, "p99": 99.0, "max": 100.0, "scans": 101}


# ---- the page ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("must", "aim", "value", "verdict"),
    [
        (2.0, 1.0, Value(1.0), "aim reached"),
        (2.0, 1.0, Value(1.5), "must reached, aim not"),
        (2.0, 1.0, Value(2.0), "must reached, aim not"),
        (2.0, 1.0, Value(2.1), "MISSED"),
        (2.0, None, Value(0.1), "must reached"),
        (2.0, None, Value(float("nan")), "MISSED"),
        (None, None, Value(9.0), "information"),
        ("completes", 1.0, Value(9.0), "must reached, aim not"),
        ("completes", 1.0, Value(0.5), "aim reached"),
        ("completes", 1.0, Value(0.5, met=False), "MISSED"),
    ],
)
def test_verdicts(must: float | str | None, aim: float | None, value: Value, verdict: str) -> None:
    assert Bar("anything", "m", must, aim).verdict(value) == verdict


@pytest.mark.parametrize(
    ("value", "verdict"),
    [
        (99.0, "aim reached"),
        (98.9, "must reached, aim not"),
        (95.0, "must reached, aim not"),
        (94.9, "MISSED"),
        (float("nan"), "MISSED"),
    ],
)
def test_a_bar_may_be_one_to_rise_above(value: float, verdict: str) -> None:
    assert Bar("recall", "%", 95, 99, at_least=True).verdict(Value(value)) == verdict


def test_the_page_holds_the_figures_beside_their_bars() -> None:
    bars = (Bar("`intel`, error", "m", 0.05, 0.043, 4), Bar("`intel`, memory", "MB", 600, 400, 0))
    values = (Value(0.04567, "n = 3"), Value(812.4))
    other = (Bar("`fr079`, error", "m", 0.04),)
    results = {
        "intel": Result("`intel`", bars, Measured(values, "| more |", "0.046 m, 1.30 deg, 6.1 s")),
        "fr079": Result("`fr079`", other, "no fr079.log.gz in ../data"),
    }
    text = page(results, {"commit": "abc, tree clean", "odd": "a | b"})
    lines = text.splitlines()
    assert (
        "| `intel`, error | 0.05 m | 0.043 m | 0.0457 m | must reached, aim not | n = 3 |" in lines
    )
    assert "| `intel`, memory | 600 MB | 400 MB | 812 MB | **MISSED** |  |" in lines
    skipped = "| `fr079`, error | 0.04 m | - | - | **not measured** | no fr079.log.gz in ../data |"
    assert skipped in lines
    assert "| commit | abc, tree clean |" in lines
    assert "| odd | a / b |" in lines
    # the other systems' figures are those of the table that the project was given
    assert "| 0.104 m, 1.35 deg, 928 s | 7.4 m | 0.046 m, 1.30 deg, 6.1 s |" in text
    assert "| 0.036 m, 0.76 deg, 311 s | 6.5 m | not measured |" in text
    assert "## `intel`\n\n| more |\n" in text
    assert "## `fr079`" not in text


def test_the_page_says_if_the_commit_changed_meanwhile(tmp_path: Path) -> None:
    now = commit(tmp_path)
    assert now == "unknown: this is no git checkout"
    assert circumstances(tmp_path, "c", {}, now)["commit"] == now
    changed = circumstances(tmp_path, "c", {}, "abc, tree clean")["commit"]
    assert changed == f"changed while measuring: first abc, tree clean; then {now}"


def test_tables_have_as_many_cells_in_each_row() -> None:
    results = {name: Result(name, part.bars, "no data") for name, part in PARTS.items()}
    block: list[int] = []
    for line in [*page(results, {"a": "b"}).splitlines(), ""]:
        if line.startswith("|"):
            block.append(line.count("|"))
        else:
            assert len(set(block)) <= 1
            block = []


# ---- parts -------------------------------------------------------------------------------------


def test_parts_without_their_recordings_say_so(tmp_path: Path) -> None:
    session = Session(tmp_path / "recordings", tmp_path / "scratch", 1)
    for part in PARTS.values():
        if part.needs:
            measured = measure_part(part, session).measured
            assert isinstance(measured, str)
            assert part.needs[0] in measured


def test_a_part_that_fails_says_why_and_the_others_go_on(tmp_path: Path) -> None:
    def fail(session: Session) -> Measured:
        measure(python(f"import sys; sys.exit('bad {tmp_path}/x')"))
        raise AssertionError

    session = Session(tmp_path, tmp_path, 1)
    result = measure_part(Part("p", "A part", (Bar("it", "s"),), (), fail), session)
    assert isinstance(result.measured, str)
    assert "ended with 1: bad /x" in result.measured


def test_a_recording_is_mapped_once_and_evaluated(demo: DemoFiles, tmp_path: Path) -> None:
    session = Session(tmp_path, tmp_path, 1)
    run = session.map_recording(demo.recording, "--duration=10", "--no-loops")
    assert session.map_recording(demo.recording, "--duration=10", "--no-loops") is run
    assert run.metrics()["recording"] == "demo"
    assert run.usages.cpu_s.median > 0.1
    error = session.evaluate(run, "--ground-truth", str(demo.ground_truth))["trajectory"]
    assert error["ate_translation_m"]["rmse"] < 0.1


@pytest.mark.parametrize(
    ("asked", "written"),
    [({}, True), ({"only": ["p"]}, False), ({"only": ["p"], "write": True}, True)],
)
def test_the_page_is_written_where_all_was_measured(
    asked: dict[str, Any],
    written: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    part = Part("p", "A part", (Bar("it", "s", 2.0),), (), lambda _: Measured((Value(1.0),)))
    monkeypatch.setattr(benchmark, "PARTS", {"p": part})
    monkeypatch.setattr(benchmark, "PAGE", tmp_path / "benchmarks.md")
    monkeypatch.setattr(benchmark, "measure", lambda command: None)  # the demo that warms up
    benchmark.main(data=tmp_path, runs=1, **asked)
    printed = capsys.readouterr().out
    assert "| it | 2 s | - | 1.00 s | must reached |  |\n" in printed
    assert f"--data {os.path.relpath(tmp_path, benchmark.ROOT)} --runs 1" in printed
    assert [path.name for path in tmp_path.iterdir()] == (["benchmarks.md"] if written else [])
    if written:
        assert (tmp_path / "benchmarks.md").read_text(encoding="utf-8") + "\n" == printed
