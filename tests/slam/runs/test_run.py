"""Whole runs: what a run folder holds, repeated, interrupted and killed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from backend.pose_graph_files import read_pose_graph
from datasets.errors import InputError
from datasets.open_recording import open_recording
from datasets.options import ReadOptions
from datasets.se2 import between, pose_matrices
from datasets.tum import format_stamp, read_tum
from frontend.local_slam import LocalSlam
from slam.config import Config, load_config
from slam.evaluation.trajectory_error import trajectory_error
from slam.pipeline import Slam
from slam.runs.export import export_run
from slam.runs.interruption import Interruption
from slam.runs.run import RunDone, RunRequest, run_recording
from slam.runs.run_folder import read_run
from tests.slam.ring_log import DemoFiles, measure

FILES = {
    "config.yaml",
    "constraints.csv",
    "graph.g2o",
    "map.pgm",
    "map.png",
    "map.yaml",
    "metrics.json",
    "odometry.tum",
    "scans.npz",
    "timing.json",
    "trajectory.tum",
}


class Deaf:
    """A watcher who does something at a stage, or nothing."""

    def __init__(self, at: str = "never", then: Callable[[], None] = lambda: None) -> None:
        self.stages: list[str] = []
        self.scans = 0
        self._at, self._then = at, then

    def stage(self, what: str) -> None:
        self.stages.append(what)
        if what.startswith(self._at):
            self._then()

    def progress(self, scans: int, recorded_s: float, closures: int) -> None:
        self.scans = scans
        if self._at == "scans":
            self._then()


def run(
    recording: Path,
    out: Path,
    *,
    duration_s: float | None = 12.0,
    config: Config | None = None,
    watch: Deaf | None = None,
    interruption: Interruption | None = None,
    force: bool = False,
) -> RunDone:
    request = RunRequest(
        (recording,), ReadOptions(duration_s=duration_s), config or Config(), out, force
    )
    return run_recording(request, watch or Deaf(), interruption or Interruption())


@pytest.fixture(scope="module")
def whole(demo: DemoFiles, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the whole demo: the one with loops."""
    out = tmp_path_factory.mktemp("whole") / "run"
    run(demo.recording, out, duration_s=None)
    return out


def test_the_folder_holds_what_it_should(whole: Path, demo: DemoFiles) -> None:
    assert {path.name for path in whole.iterdir()} == FILES
    messages = list(open_recording([demo.recording], ReadOptions()))
    scans = [m.stamp_ns for m in messages if hasattr(m, "ranges_m")]
    odometry = [m.stamp_ns for m in messages if not hasattr(m, "ranges_m")]
    loaded = read_run(whole)
    assert loaded.trajectory.stamps_ns.tolist() == scans, "every scan has its pose"
    assert loaded.odometry is not None
    assert loaded.odometry.stamps_ns.tolist() == odometry, "odometry at its own stamps"
    assert not loaded.partial
    error = trajectory_error(loaded.trajectory, read_tum(demo.ground_truth))
    assert error.translation_m.rmse < 0.03
    assert loaded.metrics["loops"]["closed"] >= 1
    assert loaded.metrics["scans"] == len(scans)
    true_way_m = 81.0
    assert loaded.metrics["way_m"] == pytest.approx(true_way_m, rel=0.02)


def test_the_configuration_can_be_used_again(demo: DemoFiles, tmp_path: Path, whole: Path) -> None:
    config = load_config(None, ["map.resolution_m=0.1", "nodes.step_m=0.3", "loops=false"])
    run(demo.recording, tmp_path / "out", config=config)
    assert load_config(tmp_path / "out" / "config.yaml") == config
    told = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())
    assert told["recording"] == [str(demo.recording)]
    assert "numba" in told["versions"]
    export_run(tmp_path / "out", tmp_path / "map")
    for name in ("map.pgm", "map.yaml"):
        written = (tmp_path / "map" / name).read_bytes()
        assert written == (tmp_path / "out" / name).read_bytes(), "cells of 0.1 m, as the run had"


def test_the_graph_lies_on_the_trajectory(whole: Path) -> None:
    graph, loaded = read_pose_graph(whole / "graph.g2o"), read_run(whole)
    assert graph.node_ids.tolist() == list(range(loaded.metrics["nodes"]))
    assert not graph.left_out
    steps = np.flatnonzero(graph.constraints.to_nodes == graph.constraints.from_nodes + 1)
    assert len(steps) >= len(graph.node_ids) - 1, "one connected chain"
    assert len(graph.constraints) > 2 * len(graph.node_ids), "and the matches of the final passes"
    a, b = (
        graph.nodes_xyyaw[ends]
        for ends in (graph.constraints.from_nodes, graph.constraints.to_nodes)
    )
    off_m = np.hypot(*between(graph.constraints.xyyaw, between(a, b))[:, :2].T)
    assert np.percentile(off_m, 95) < 0.05
    rows = {tuple(np.round(row, 9)) for row in loaded.trajectory.xyyaw[:, :2].tolist()}
    assert all(tuple(np.round(row, 9)) in rows for row in graph.nodes_xyyaw[:, :2].tolist())


def test_every_constraint_and_search_has_its_row(whole: Path) -> None:
    loaded = read_run(whole)
    rows = [
        dict(zip(loaded.constraints.columns, row, strict=True)) for row in loaded.constraints.rows
    ]
    chain = [row for row in rows if row["kind"] == "odometry"]
    loops = [row for row in rows if row["kind"] == "loop"]
    assert len(chain) == loaded.metrics["submaps"] - 1
    assert len(loops) == loaded.metrics["loops"]["searched"]
    closed = [row for row in loops if row["result"] == "accepted"]
    assert sum(row["kept"] == "yes" for row in closed) == loaded.metrics["loops"]["closed"]
    refused = loaded.metrics["loops"]["refused"]
    assert {row["result"] for row in loops} == {*refused, *(["accepted"] if closed else [])}
    graph = read_pose_graph(whole / "graph.g2o")
    poses = pose_matrices(graph.nodes_xyyaw)
    for row in closed:
        T_final = np.linalg.inv(poses[int(row["from_node"])]) @ poses[int(row["to_node"])]
        off_m = np.hypot(T_final[0, 2] - float(row["x_m"]), T_final[1, 2] - float(row["y_m"]))
        assert off_m == pytest.approx(float(row["off_m"]), abs=1e-4)
        assert off_m < 0.1
        assert float(row["score"]) > 0.5
    stamps = {format_stamp(int(stamp)) for stamp in loaded.trajectory.stamps_ns}
    assert {row["to_stamp_s"] for row in rows} <= stamps


def test_the_same_input_gives_the_same_bytes(demo: DemoFiles, whole: Path, tmp_path: Path) -> None:
    run(demo.recording, tmp_path / "again", duration_s=None)
    for name in sorted(FILES - {"timing.json"}):
        assert (tmp_path / "again" / name).read_bytes() == (whole / name).read_bytes(), name


def test_without_loops_and_without_odometry(demo: DemoFiles, tmp_path: Path) -> None:
    done = run(demo.recording, tmp_path / "a", config=Config(loops=False))
    assert done.run.metrics["loops"] == {
        "searched": 0, "closed": 0, "taken_back": 0, "refused": {},
    }  # fmt: skip
    assert done.run.metrics["final_passes"] is None
    graph = read_pose_graph(tmp_path / "a" / "graph.g2o")
    assert len(graph.constraints) == len(graph.node_ids) - 1
    done = run(demo.recording, tmp_path / "b", config=Config(odometry=False))
    assert done.run.metrics["odometry_used"] is False
    assert done.run.metrics["odometry_turn_bias_rad_per_m"] is None
    assert done.run.metrics["odometry_scale_error"] is None
    assert done.run.metrics["odometry_slip_scans"] is None
    assert {path.name for path in (tmp_path / "b").iterdir()} == FILES, "odometry for evaluation"
    error = trajectory_error(done.run.trajectory, read_tum(demo.ground_truth))
    assert error.translation_m.rmse < 0.05


def test_a_scan_that_breaks_the_pipeline_costs_itself(
    demo: DemoFiles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good, count = LocalSlam.add_scan, 0

    def add_scan(self: LocalSlam, scan: object) -> object:
        nonlocal count
        count += 1
        if count in (20, 21, 40):
            raise ValueError("the beams are tangled")
        return good(self, scan)  # type: ignore[arg-type]

    monkeypatch.setattr(LocalSlam, "add_scan", add_scan)
    done = run(demo.recording, tmp_path / "out")
    assert done.run.metrics["left_out"] == {"scan left out: the beams are tangled": 3}
    assert len(done.run.trajectory) == count - 3
    monkeypatch.setattr(LocalSlam, "add_scan", lambda *_: (_ for _ in ()).throw(ValueError("no")))
    with pytest.raises(InputError, match=r"no scan in it can be used .*left out: no"):
        run(demo.recording, tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_two_lidars_with_the_same_stamps(tmp_path: Path) -> None:
    """Front and rear of one moment: both draw the map, the trajectory has the moment once."""
    random = np.random.default_rng(3)
    lines = ["PARAM robot_frontlaser_offset 0.12 1.0 host 1.0"]
    lines.append("PARAM robot_rearlaser_offset 0.12 1.0 host 1.0")
    lines.append("PARAM robot_rearlaser_angular_offset 3.141592653589793 1.0 host 1.0")
    poses = np.array([(8.0 + 0.1 * k, 1.1, 0.0) for k in range(60)])
    for k, (pose, ranges) in enumerate(zip(poses, measure(poses, random), strict=True)):
        end = f"{pose[0]} {pose[1]} 0 {pose[0]} {pose[1]} 0 {100 + 0.2 * k:.3f} host {k}"
        front = " ".join(f"{r:.3f}" for r in ranges[90:270])
        rear = " ".join(f"{r:.3f}" for r in np.roll(ranges, 180)[90:270])
        lines += [f"FLASER 180 {front} {end}", f"RLASER 180 {rear} {end}"]
    log = tmp_path / "two.log"
    log.write_text("\n".join(lines) + "\n")
    done = run(log, tmp_path / "out", duration_s=None)
    assert done.run.metrics["scans_by_sensor"] == {"front": 60, "rear": 60}
    assert len(done.run.trajectory) == 60
    assert len(done.run.scans) == 120
    driven = np.ptp(done.run.trajectory.xyyaw[:, 0])
    assert driven == pytest.approx(5.9, abs=0.05)


def test_beam_times_are_kept_apart_from_stamps(shared_data: Path, tmp_path: Path) -> None:
    """The poses of the trajectory are those of the stamps, and the map is drawn with them."""
    bag = shared_data / "recordings" / "jarvis_complex_path_fast.bag"
    request = RunRequest((bag,), ReadOptions(start_s=10, duration_s=8), out=tmp_path / "out")
    done = run_recording(request, Deaf(), Interruption())
    assert done.run.metrics["ground_truth"]["error"]["ate_translation_m"]["rmse"] < 0.06
    export_run(tmp_path / "out", tmp_path / "map")
    assert (tmp_path / "map/map.pgm").read_bytes() == (tmp_path / "out/map.pgm").read_bytes()


def test_a_first_run_says_that_it_compiles(whole: Path, tmp_path: Path) -> None:
    program = (
        "import slam.pipeline\n"
        "from slam.runs.kernel_cache import kernels_are_compiled\n"
        "print(kernels_are_compiled())\n"
    )

    def said(environment: dict[str, str]) -> str:
        command = [sys.executable, "-c", program]
        env = {**os.environ, **environment}
        return subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout

    assert whole.is_dir(), "a run that compiled all it needs"
    assert said({}) == "True\n"
    assert said({"NUMBA_CACHE_DIR": str(tmp_path)}) == "False\n", "nothing is in this cache"


# ---- interrupted -------------------------------------------------------------------------------


def test_interrupted_while_reading_it_keeps_what_was_mapped(
    demo: DemoFiles, tmp_path: Path
) -> None:
    before = signal.getsignal(signal.SIGINT)  # a shell's background job ignores it
    with Interruption() as interruption:
        watch = Deaf("scans", lambda: os.kill(os.getpid(), signal.SIGINT))
        done = run(
            demo.recording, tmp_path / "out", watch=watch, interruption=interruption,
            duration_s=None,
        )  # fmt: skip
    assert interruption.number == signal.SIGINT
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    loaded = read_run(tmp_path / "out")
    assert loaded.partial
    assert watch.scans <= len(loaded.trajectory) < watch.scans + 20
    assert done.run.metrics["final_passes"] is not None
    assert signal.getsignal(signal.SIGINT) is before


def test_interrupted_in_the_final_passes_it_does_without(
    demo: DemoFiles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def finish(self: Slam) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
        raise AssertionError("not broken off")

    monkeypatch.setattr(Slam, "finish", finish)
    with Interruption() as interruption:
        run(demo.recording, tmp_path / "out", interruption=interruption)
    loaded = read_run(tmp_path / "out")
    assert interruption.number == signal.SIGTERM
    assert loaded.partial
    assert loaded.metrics["final_passes"] is None
    error = trajectory_error(loaded.trajectory, read_tum(demo.ground_truth))
    assert error.translation_m.rmse < 0.05
    assert len(read_pose_graph(tmp_path / "out" / "graph.g2o").node_ids) == loaded.metrics["nodes"]


@pytest.mark.parametrize("stage", ["scans", "last scan", "drawing", "writing"])
def test_interrupted_twice_leaves_nothing(stage: str, demo: DemoFiles, tmp_path: Path) -> None:
    def twice() -> None:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), Interruption() as interruption:
        run(demo.recording, tmp_path / "out", watch=Deaf(stage, twice), interruption=interruption)
    assert list(tmp_path.iterdir()) == []


def test_interrupted_before_the_first_scan_leaves_nothing(demo: DemoFiles, tmp_path: Path) -> None:
    watch = Deaf("mapping", lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt), Interruption() as interruption:
        run(demo.recording, tmp_path / "out", watch=watch, interruption=interruption)
    assert list(tmp_path.iterdir()) == []


# ---- killed ------------------------------------------------------------------------------------


def command(demo: DemoFiles, out: Path, *more: str) -> subprocess.Popen[str]:
    program = "from slam.cli import main; main()"
    words = ["run", str(demo.recording), "-o", str(out), *more]
    return subprocess.Popen(
        [sys.executable, "-c", program, *words], stderr=subprocess.PIPE, stdout=subprocess.PIPE,
        text=True, cwd=out.parent,
    )  # fmt: skip


def wait_for(process: subprocess.Popen[str], stage: str) -> None:
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith(stage):
            return
    raise AssertionError(f"it ended before '{stage}'")


def test_killed_at_any_moment_it_leaves_a_whole_folder_or_none(
    demo: DemoFiles, tmp_path: Path
) -> None:
    out, old = tmp_path / "out", tmp_path / "old"
    moments = [("mapping", 0.1), ("drawing", 0.0), ("writing", 0.0), ("writing", 0.02)]
    for stage, delay_s in moments:
        process = command(demo, out, "--duration", "6")
        wait_for(process, stage)
        time.sleep(delay_s)
        process.kill()
        process.communicate()
        if out.exists():
            assert {path.name for path in out.iterdir()} == FILES
            assert not read_run(out).partial
            shutil.rmtree(out)
    run(demo.recording, old, duration_s=6.0)
    before = (old / "trajectory.tum").read_bytes()
    process = command(demo, old, "--duration", "5", "--force")
    wait_for(process, "writing")
    process.kill()
    process.communicate()
    # Whatever the moment was, the next one finds the old or the new run, and tidies up.
    run(demo.recording, tmp_path / "out", duration_s=6.0, force=True)
    with pytest.raises(InputError, match="exists already"):
        run(demo.recording, old, duration_s=6.0)
    assert {path.name for path in tmp_path.iterdir()} == {"out", "old"}
    assert len((old / "trajectory.tum").read_bytes()) <= len(before)
    assert {path.name for path in old.iterdir()} == FILES


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_command_with_a_partial_run(
    number: int, code: int, demo: DemoFiles, tmp_path: Path
) -> None:
    process = command(demo, tmp_path / "out")
    wait_for(process, "mapping")
    time.sleep(0.5)
    process.send_signal(number)
    output, _ = process.communicate()
    assert process.returncode == code
    assert read_run(tmp_path / "out").partial
    assert "PARTIAL" in output
    assert "Traceback" not in output
