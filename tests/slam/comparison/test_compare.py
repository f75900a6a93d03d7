"""``slam compare`` and ``slam evaluate --structures`` on a short drive past a low crate."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from slam.comparison.compare import (
    CSV,
    JSON,
    MARKDOWN,
    PICTURE,
    Compared,
    CompareRequest,
    compare_recording,
    is_comparison,
)
from slam.comparison.parts import BAYES_PART, PAPER_PART, UNION_PART
from slam.config import Config
from slam.runs.interruption import Interruption
from slam.runs.run_folder import is_run_folder
from tests.slam.conftest import Command
from tests.slam.crate_drive import write_crate_drive, write_place

ALL = (PAPER_PART, UNION_PART, BAYES_PART)
FILES = {PICTURE, MARKDOWN, CSV, JSON}


@dataclass
class Watch:
    """Remembers what it is told, and may ask for an end at some stage."""

    interruption: Interruption = field(default_factory=Interruption)
    end_at: str | None = None
    stages: list[str] = field(default_factory=list)

    def stage(self, what: str) -> None:
        self.stages.append(what)
        if self.end_at is not None and what.startswith(self.end_at):
            self.interruption.number = 2

    def progress(self, scans: int, recorded_s: float, closures: int) -> None:
        pass


def compared(request: CompareRequest, watch: Watch) -> Compared:
    return compare_recording(request, watch, watch.interruption)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_crate_drive(tmp_path_factory.mktemp("crate"))


@pytest.fixture(scope="module")
def done(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    folder = tmp_path_factory.mktemp("compared")
    lengths = folder / "lengths.yaml"
    lengths.write_text(
        yaml.safe_dump(
            {
                "structures": {
                    "taped": {"from_m": [-2.0, -1.0], "to_m": [5.0, -1.0], "length_m": 7.0},
                    "nowhere": {"from_m": [-40.0, 0.0], "to_m": [-30.0, 0.0], "length_m": 10.0},
                }
            }
        ),
        encoding="utf-8",
    )
    place = write_place(folder)
    request = CompareRequest(
        (bag,), out=folder / "out", extra=ALL, place=str(place), structures=lengths
    )
    return compared(request, Watch())


def test_each_part_is_a_run_folder_beside_picture_and_table(done: Compared) -> None:
    names = ["lidar", "camera", "fused", "paper", "union", "bayes"]
    assert [row["name"] for row in done.rows] == names
    assert {row["status"] for row in done.rows} == {"ok"}
    assert not done.partial
    assert {path.name for path in done.folder.iterdir()} == FILES | set(names)
    assert all(is_run_folder(done.folder / name) for name in names[:-1])
    bayes = {path.name for path in (done.folder / "bayes").iterdir()}
    assert bayes == {"map.pgm", "map.yaml", "map.png"}
    assert is_comparison(done.folder)
    picture = cv2.imread(str(done.folder / PICTURE))
    assert picture is not None
    config = yaml.safe_load((done.folder / "camera" / "config.yaml").read_text())["config"]
    assert config["sensors"] == "camera"


def test_the_crate_is_in_the_fused_map_and_not_in_the_lidars(done: Compared) -> None:
    rows = {row["name"]: row for row in done.rows}
    assert rows["lidar"]["obstacles"]["low_objects_found"] == 0
    assert rows["fused"]["obstacles"]["low_objects_found"] == 1
    assert rows["fused"]["obstacles"]["low_objects"] == 1
    assert rows["fused"]["obstacles"]["low"]["recall"] > 0.9
    assert rows["fused"]["lacked"]["by"] == "lidar"
    assert rows["fused"]["lacked"]["free_groups"] >= 1
    assert rows["lidar"]["lacked"]["by"] == "fused"
    assert rows["lidar"]["lacked"]["groups"] == 0


def test_the_figures_are_those_of_the_runs(done: Compared) -> None:
    for row in done.rows:
        if row["name"] == BAYES_PART:
            continue
        metrics = json.loads((done.folder / row["name"] / "metrics.json").read_text())
        assert row["way_m"] == metrics["way_m"]
        assert row["map"]["free_m2"] == metrics["map"]["free_m2"]
        assert row["map"]["occupied_cells"] == metrics["map"]["occupied_cells"]
        error = metrics["ground_truth"]["error"]["ate_translation_m"]["rmse"]
        assert row["ate_m"] == error
        assert row["cpu_s"] > 0.0


def test_structures_of_place_and_file_are_measured(done: Compared) -> None:
    lidar = {each["name"]: each for each in done.rows[0]["structures"]}
    for name in ("hall", "taped"):
        assert lidar[name]["gamma_percent"] == pytest.approx(100.0, abs=0.5)
        assert 0.0 < lidar[name]["gamma_std_percent"] < 0.5
    assert lidar["nowhere"]["found"] == "no"


def test_json_and_csv_and_page_say_the_same(done: Compared) -> None:
    data = json.loads((done.folder / JSON).read_text())
    assert [row["name"] for row in data["maps"]] == [row["name"] for row in done.rows]
    with (done.folder / CSV).open() as file:
        lines = list(csv.DictReader(file))
    assert [float(line["map.free_m2"]) for line in lines] == [
        row["map"]["free_m2"] for row in data["maps"]
    ]
    page = (done.folder / MARKDOWN).read_text()
    assert "low obstacles: recall" in page
    assert "nowhere not measured in lidar" in page


def test_a_part_that_fails_is_a_row_that_says_so(bag: Path, tmp_path: Path) -> None:
    blind = Config.model_validate({"depth": {"max_range_m": 0.31}})
    done = compared(CompareRequest((bag,), config=blind, out=tmp_path / "out"), Watch())
    rows = {row["name"]: row for row in done.rows}
    assert rows["camera"]["status"] == "failed"
    assert "beam" in rows["camera"]["why"]
    assert rows["fused"]["status"] == "ok"
    assert not (done.folder / "camera").exists()
    assert "no map of camera" in (done.folder / MARKDOWN).read_text()


def test_an_interruption_keeps_what_is_mapped_and_marks_it(bag: Path, tmp_path: Path) -> None:
    watch = Watch(end_at="camera: last scan read")
    done = compared(CompareRequest((bag,), out=tmp_path / "out"), watch)
    assert done.partial
    assert [row["status"] for row in done.rows] == ["ok", "partial", "not run"]
    assert not (done.folder / "fused").exists()
    assert json.loads((done.folder / JSON).read_text())["partial"] is True
    assert "PARTIAL" in (done.folder / MARKDOWN).read_text()
    assert not any(stage.startswith("fused") for stage in watch.stages)


def test_what_breaks_off_leaves_nothing(bag: Path, tmp_path: Path) -> None:
    watch = Watch()

    def twice(what: str) -> None:
        if what.startswith("camera: drawing"):
            raise KeyboardInterrupt

    watch.stage = twice  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        compared(CompareRequest((bag,), out=tmp_path / "out"), watch)
    assert not list(tmp_path.iterdir())


def test_a_second_lidar_is_compared_like_a_camera(tmp_path: Path) -> None:
    bag = write_crate_drive(tmp_path, "two-lidars")
    done = compared(CompareRequest((bag,), out=tmp_path / "out"), Watch())
    assert [row["name"] for row in done.rows] == ["lidar", "fused"]
    lidar, fused = done.rows
    assert lidar["words"] == "/scan"
    assert fused["lacked"]["free_groups"] >= 1
    metrics = json.loads((done.folder / "lidar" / "metrics.json").read_text())
    assert list(metrics["scans_by_sensor"]) == ["/scan"]


def test_the_command_prints_the_table_and_replaces_only_comparisons(
    slam: Command, bag: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = ("compare", bag, "-o", out, "--duration", "2")
    first = slam(*words)
    assert first.code == 0, first.err
    assert "free, m2" in first.out
    assert "fused: mapping" in first.err
    again = slam(*words)
    assert (again.code, "exists already" in again.err) == (2, True)
    forced = slam(*words, "--force", "-q")
    assert (forced.code, forced.out.strip()) == (0, str(out))
    other = tmp_path / "mine"
    other.mkdir()
    (other / "thesis.txt").write_text("dear")
    refused = slam("compare", bag, "-o", other, "--force")
    assert refused.code == 2
    assert (other / "thesis.txt").read_text() == "dear"


@pytest.mark.parametrize(
    "words", [("--place", "nowhere"), ("--structures", "nowhere.yaml"), ("--camera", "/nope")]
)
def test_mistakes_cost_a_line_and_no_run(
    slam: Command, bag: Path, tmp_path: Path, words: tuple[str, str]
) -> None:
    done = slam("compare", bag, "-o", tmp_path / "out", *words)
    assert done.code == 2
    assert done.err.startswith("error: ")
    assert done.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_single_lidar_is_nothing_to_compare(slam: Command, tmp_path: Path, bag: Path) -> None:
    text = "PARAM robot_front_laser_max 20.0\nFLASER 3 1 1 1 0 0 0 0 0 0 1.0 host 1.0\n"
    log = tmp_path / "one.log"
    log.write_text(text)
    done = slam("compare", log, "-o", tmp_path / "out")
    assert done.code == 2
    assert "nothing to compare" in done.err
    assert "slam run" in done.err
    assert not (tmp_path / "out").exists()


def test_evaluate_measures_the_structures_of_a_file(
    slam: Command, done: Compared, tmp_path: Path
) -> None:
    lengths = done.folder.parent / "lengths.yaml"
    told = slam(
        "evaluate", done.folder / "fused", "--structures", lengths, "--json", tmp_path / "e.json"
    )
    assert told.code == 0, told.err
    assert "taped: " in told.out
    assert "nowhere: not found" in told.out
    found = {
        each["name"]: each for each in json.loads((tmp_path / "e.json").read_text())["structures"]
    }
    assert found["taped"]["gamma_percent"] == pytest.approx(100.0, abs=0.5)
    assert np.isfinite(found["taped"]["gamma_std_percent"])
    assert found["nowhere"]["found"] == "no"
    wrong = slam("evaluate", done.folder / "fused", "--structures", tmp_path / "none.yaml")
    assert wrong.code == 2
