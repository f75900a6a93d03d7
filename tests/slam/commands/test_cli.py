"""The commands as a person types them."""

from __future__ import annotations

import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from backend.pose_graph_files import read_pose_graph
from datasets.tum import read_tum
from slam.commands.options import Frontend
from slam.config import Config, load_config
from slam.runs.interruption import Interruption
from slam.runs.run import RunRequest, run_recording
from slam.runs.run_folder import read_run
from tests.datasets.bag_factory import pose_entry, write_bag
from tests.slam.conftest import Command
from tests.slam.ring_log import DemoFiles

COMMANDS = ("run", "check", "export", "evaluate", "optimise", "config", "demo")


class Silent:
    def stage(self, what: str) -> None: ...

    def progress(self, scans: int, recorded_s: float, closures: int) -> None: ...


@pytest.fixture(scope="module")
def mapped(demo: DemoFiles, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of the demo."""
    out = tmp_path_factory.mktemp("mapped") / "run"
    run_recording(RunRequest((demo.recording,), out=out), Silent(), Interruption())
    return out


def test_help_and_version(slam: Command) -> None:
    done = slam("--help")
    assert done.code == 0
    for command in COMMANDS:
        assert command in done.out
        assert slam(command, "--help").code == 0
    assert re.fullmatch(r"corridor-slam \d+\.\d+\.\d+\n", slam("--version").out)
    assert slam("fly").code == 2


def test_the_printed_configuration_can_be_read_back(slam: Command, tmp_path: Path) -> None:
    done = slam("config")
    path = tmp_path / "all.yaml"
    path.write_text(done.out)
    assert load_config(path) == Config()
    assert yaml.safe_load(done.out) == Config().model_dump(mode="json"), "no key is missing"
    assert re.search(r"resolution_m: 0\.05 +# side of a cell; >= 0\.005, <= 1", done.out)


def test_a_run_without_a_target_makes_the_next_folder(
    slam: Command, demo: DemoFiles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for number in ("001", "002"):
        done = slam("run", demo.recording, "--duration", 3, "--quiet")
        assert done == (0, f"results/demo-{number}\n", "")
        assert read_run(tmp_path / "results" / f"demo-{number}").metrics["duration_s"] < 3.0


def test_a_run_tells_its_stages_and_its_summary(
    slam: Command, demo: DemoFiles, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = ["--start", 5, "--duration", 8, "--no-loops", "--set", "map.resolution_m=0.1"]
    done = slam("run", demo.recording, "-o", out, *words)
    assert done.code == 0
    stages = [line for line in done.err.splitlines() if "compiling" not in line]
    assert [stage.split(" ")[0] for stage in stages] == ["mapping", "last", "drawing", "writing"]
    assert "m driven in" in done.out
    assert "map.png" in done.out
    run = read_run(out)
    first_s = (run.trajectory.stamps_ns[0] - read_tum(demo.ground_truth).stamps_ns[0]) * 1e-9
    assert 5.0 <= first_s < 5.2
    assert run.metrics["duration_s"] == pytest.approx(8.0, abs=0.2)
    assert run.config["config"]["loops"] is False
    assert run.config["reading"]["start_s"] == 5.0
    assert yaml.safe_load((out / "map.yaml").read_text())["resolution"] == 0.1
    refused = slam("run", demo.recording, "-o", out)
    assert refused.code == 2
    assert "exists already" in refused.err
    again = slam("run", demo.recording, "-o", out, "--force", "--duration", 3, "--no-odometry")
    assert again.code == 0
    assert read_run(out).metrics["odometry_used"] is False
    assert read_run(out).odometry is not None  # for evaluation


def test_check_says_what_is_there_and_its_code_can_be_used(
    slam: Command, demo: DemoFiles, tmp_path: Path
) -> None:
    good = slam("check", demo.recording)
    assert "760" in good.out
    with gzip.open(demo.recording, "rt") as log:
        lines = [line for line in log if not line.startswith("ODOM")]
    gap = tmp_path / "gap.log"
    gap.write_text("".join(lines[:200] + lines[400:]))
    bad = slam("check", gap)
    assert bad.code == 1
    assert "gap" in bad.out
    blind = tmp_path / "blind.log"
    blind.write_text("ODOM 0 0 0 0 0 0 1.0 host 1.0\n" * 3)
    assert slam("check", blind).code == 2
    assert good.code in (0, 1)
    assert good.code < 2


def test_export_writes_another_map(slam: Command, mapped: Path, tmp_path: Path) -> None:
    done = slam("export", mapped, "-o", tmp_path / "map", "--resolution", 0.1, "--align-walls")
    assert done.code == 0
    assert "turned by" in done.out
    meta = yaml.safe_load((tmp_path / "map" / "map.yaml").read_text())
    assert meta["resolution"] == 0.1
    fine = np.asarray(Image.open(mapped / "map.pgm")).shape
    coarse = np.asarray(Image.open(tmp_path / "map" / "map.pgm")).shape
    assert 0.3 < coarse[0] / fine[0] < 0.8
    assert slam("export", mapped, "-o", tmp_path / "map").code == 2
    assert slam("export", mapped, "-o", tmp_path / "map", "--force").code == 0
    assert slam("export", mapped, "--max-range", 5).code == 0
    assert (mapped.parent / "run-map-001" / "map.pgm").is_file()
    assert slam("export", mapped, "--resolution", -1).code == 2


def test_evaluate_against_a_tum_file_and_a_bag(
    slam: Command, demo: DemoFiles, mapped: Path, tmp_path: Path
) -> None:
    numbers = tmp_path / "numbers.json"
    done = slam("evaluate", mapped, "--ground-truth", demo.ground_truth, "--json", numbers)
    assert done.code == 0
    assert re.search(r"ATE rmse 0\.0\d+ m", done.out)
    by_tum = json.loads(numbers.read_text())["trajectory"]
    assert by_tum["pairs"] == 760
    truth = read_tum(demo.ground_truth)
    bag = write_bag(
        tmp_path, "mcap",
        [
            pose_entry(int(stamp), *map(float, row), topic="/where")
            for stamp, row in zip(truth.stamps_ns, truth.xyyaw, strict=True)
        ],
    )  # fmt: skip
    done = slam("evaluate", mapped, "--ground-truth", f"{bag}:/where", "--json", numbers)
    assert done.code == 0, done.err
    by_bag = json.loads(numbers.read_text())["trajectory"]
    assert by_bag["ate_translation_m"]["rmse"] == pytest.approx(
        by_tum["ate_translation_m"]["rmse"], abs=1e-6
    )
    assert slam("evaluate", mapped, "--ground-truth", f"{bag}:/there").code == 2
    assert slam("evaluate", mapped, "--ground-truth", bag).code == 2, "none is called so"
    assert slam("evaluate", mapped).code == 2, "nothing to compare with"


def test_evaluate_estimates_the_clocks(
    slam: Command, demo: DemoFiles, mapped: Path, tmp_path: Path
) -> None:
    truth = demo.ground_truth.read_text().splitlines()
    shifted = tmp_path / "shifted.tum"
    shifted.write_text(
        "\n".join(
            line if line.startswith("#") else re.sub(r"^(\d+)\.(\d)", _later, line)
            for line in truth
        )
    )
    words = ["--ground-truth", shifted, "--time-offset"]
    assert "0.3000 s early" in slam("evaluate", mapped, *words, "0.3").out
    done = slam("evaluate", mapped, *words, "auto")
    offset_s = float(re.search(r"stamped (\d\.\d+) s early", done.out)[1])  # type: ignore[index]
    assert offset_s == pytest.approx(0.3, abs=0.01)
    assert slam("evaluate", mapped, *words, "soon").code == 2


def _later(start: re.Match[str]) -> str:
    tenths = int(start[1]) * 10 + int(start[2]) + 3
    return f"{tenths // 10}.{tenths % 10}"


def test_evaluate_measures_walls(slam: Command, mapped: Path, tmp_path: Path) -> None:
    numbers = tmp_path / "numbers.json"
    done = slam("evaluate", mapped, "--walls", "--json", numbers)
    assert done.code == 0
    assert "wall thickness" in done.out
    walls = json.loads(numbers.read_text())["walls"]
    assert 0.02 < walls["thickness_median_m"] <= walls["thickness_95_m"] < 0.15


def test_evaluate_uses_relations(
    slam: Command, demo: DemoFiles, mapped: Path, tmp_path: Path
) -> None:
    truth = read_tum(demo.ground_truth)
    T = truth.matrices()
    lines = []
    for a, b in ((0, 100), (200, 500), (300, 310), (10, 740)):
        step = np.linalg.inv(T[a]) @ T[b]
        yaw = np.arctan2(step[1, 0], step[0, 0])
        stamps = " ".join(f"{int(truth.stamps_ns[k]) / 1e9:.9f}" for k in (a, b))
        stamps = " ".join(
            f"{truth.stamps_ns[k] // 10**9}.{truth.stamps_ns[k] % 10**9:09d}" for k in (a, b)
        )
        lines.append(f"{stamps} {step[0, 2]} {step[1, 2]} 0 0 0 {yaw}")
    relations = tmp_path / "demo.relations"
    relations.write_text("\n".join(lines))
    done = slam("evaluate", mapped, "--relations", relations)
    assert done.code == 0
    error_m = float(re.search(r"Abs translational error (\S+) ", done.out)[1])  # type: ignore[index]
    assert error_m < 0.03


def test_optimise_finds_the_graph_of_a_run_at_rest(
    slam: Command, mapped: Path, tmp_path: Path
) -> None:
    out = tmp_path / "again.g2o"
    done = slam("optimise", mapped / "graph.g2o", "-o", out)
    assert done.code == 0, done.err
    assert str(out) in done.out
    before, after = read_pose_graph(mapped / "graph.g2o"), read_pose_graph(out)
    moved_m = np.hypot(*(after.nodes_xyyaw - before.nodes_xyyaw)[:, :2].T)
    assert moved_m.max() < 0.02
    assert slam("optimise", mapped / "graph.g2o", "-o", out).code == 2
    assert slam("optimise", mapped / "graph.g2o", "-o", out, "--robust", "--force").code == 0
    assert slam("optimise", mapped / "map.png", "-o", tmp_path / "no.g2o").code == 2


def test_the_demo_ends_with_its_picture(
    slam: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = slam("demo")
    assert done.code == 0
    picture = Path(done.out.splitlines()[-1])
    assert np.asarray(Image.open(picture)).shape[2] == 3
    raw_m, slam_m = (
        float(re.search(rf"{name} +(\d+\.\d+) m", done.out)[1])  # type: ignore[index]
        for name in ("raw odometry", "slam")
    )
    assert slam_m < 0.05
    assert raw_m > slam_m
    assert slam("demo", "-o", "results/demo-001").code == 2, "there is a run already"


def test_a_real_log_with_each_front_end(slam: Command, shared_data: Path, tmp_path: Path) -> None:
    log = shared_data / "recordings" / "fr079.log.gz"
    for frontend in Frontend:
        out = tmp_path / frontend
        done = slam("run", log, "--duration", 20, "--frontend", frontend, "-o", out)
        assert done.code == 0, done.err
        run = read_run(out)
        assert run.config["config"]["frontend"] == frontend
        assert run.metrics["scans"] == len(run.trajectory)
        # the mounting of the log, 4 cm behind the base, is where the rays begin
        assert run.scans.origins_base[0] == pytest.approx((-0.04, 0.0), abs=1e-9)


def test_a_bag_with_ground_truth_says_how_far_it_is_off(
    slam: Command, shared_data: Path, tmp_path: Path
) -> None:
    bag = shared_data / "recordings" / "jarvis_complex_path_fast.bag"
    out = tmp_path / "out"
    done = slam("run", bag, "--start", 10, "--duration", 6, "-o", out)
    assert done.code == 0, done.err
    assert re.search(r"ATE rmse 0\.0\d+ m", done.out)
    topic = slam("evaluate", out, "--ground-truth", f"{bag}:/pose_ground_truth")
    assert "ATE rmse" in topic.out, topic.err
    one = slam(
        "run", bag, "--duration", 4, "-o", tmp_path / "one",
        "--lidar", "/driver_laser_navigation/laser_scan", "--odometry", "tf",
    )  # fmt: skip
    assert one.code == 0, one.err
    assert list(read_run(tmp_path / "one").metrics["scans_by_sensor"]) == [
        "/driver_laser_navigation/laser_scan"
    ]
