"""The numbers a run is judged by, on cases with known answers."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets.messages import Array, Message
from datasets.recording import Calibration
from datasets.trajectory import Trajectory
from slam.runs.cost import peak_memory_mb
from slam.runs.fusion_summary import fusion_lines
from slam.runs.interruption import Interruption
from slam.runs.run import RunRequest, run_recording
from slam.runs.summary import driven_m, ground_truth_of, summary_lines
from tests.slam.ring_log import DemoFiles

S = 1_000_000_000


def along(x_m: Array, y_m: Array | float = 0.0, yaw: Array | float = 0.0) -> Trajectory:
    rows = np.column_stack(np.broadcast_arrays(x_m, y_m, yaw))
    return Trajectory(np.arange(len(rows), dtype=np.int64) * S // 10, rows * 1.0)


def test_the_noise_of_a_standing_robot_is_no_way() -> None:
    random = np.random.default_rng(1)
    assert driven_m(along(random.normal(0.0, 0.01, 5000), random.normal(0.0, 0.01, 5000))) == 0.0
    there_and_back = np.concatenate([np.linspace(0, 3, 301), np.linspace(3, 0, 301)])
    assert driven_m(along(there_and_back)) == pytest.approx(6.0, abs=0.2)
    assert driven_m(along(np.arange(5.0))) == pytest.approx(4.0)
    assert driven_m(along(np.zeros(1))) == 0.0


class Told:
    """A recording that has a ground truth."""

    name = "told"
    calibration = Calibration()

    def __init__(self, truth: Trajectory | None) -> None:
        self.notes: Counter[str] = Counter()
        self._truth = truth

    def __iter__(self) -> Iterator[Message]:
        return iter(())

    def ground_truth(self) -> Trajectory | None:
        return self._truth


def test_a_clock_offset_is_believed_only_where_it_shows() -> None:
    t = np.arange(0, 40, 0.1)
    # The speed changes: on an even circle an offset would be a turn.
    truth = along(0.4 * t + np.sin(t), 0.1 * np.sin(0.3 * t))
    late = Trajectory(truth.stamps_ns + S // 10, truth.xyyaw)
    told = ground_truth_of(Told(truth), late)
    assert told is not None
    assert told["error"]["time_offset"]["offset_s"] == pytest.approx(-0.1, abs=1e-3)
    assert told["error"]["ate_translation_m"]["rmse"] < 1e-3
    assert any("0.1" in line and "late" in line for line in told["words"])
    random = np.random.default_rng(2)
    standing = [along(*random.normal(0, 0.005, (2, 400))) for _ in range(2)]
    told = ground_truth_of(Told(standing[0]), standing[1])
    assert told is not None
    assert told["error"]["time_offset"]["offset_s"] == 0.0
    assert "clocks taken as equal" in " ".join(told["words"])


def test_ground_truth_of_another_day_is_told_not_fatal() -> None:
    truth = along(np.arange(50.0))
    other = Trajectory(truth.stamps_ns + 86_400 * S, truth.xyyaw)
    told = ground_truth_of(Told(truth), other)
    assert told is not None
    assert told["error"] is None
    assert told["words"][0].startswith("not compared: ")
    assert ground_truth_of(Told(None), truth) is None


def test_peak_memory_is_of_this_program() -> None:
    """A child of a large program must not inherit its peak; what it takes itself counts."""
    program = (
        "import numpy as np; from slam.runs.cost import peak_memory_mb as mb\n"
        "before = mb(); x = np.ones(40_000_000); print(before, mb())"
    )
    ballast = np.ones(60_000_000)
    assert peak_memory_mb() > 480.0
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    before_mb, after_mb = map(float, done.stdout.split())
    assert ballast.size
    assert before_mb < 470.0
    assert after_mb - before_mb == pytest.approx(320.0, abs=30.0)


METRICS: dict[str, Any] = {
    "verdict": "good",
    "doubts": [],
    "recording": "hall",
    "duration_s": 120.0,
    "way_m": 50.04,
    "unobserved_way_m": 7.25,
    "scans": 812,
    "scans_by_sensor": {"front": 700, "rear": 112},
    "fusion": {
        "sensors": "fused",
        "mode": "better",
        "single_grid": False,
        "views": {"/depth": 610, "/low": 0},
        "cameras_without_view": ["/behind"],
        "scans_without_view": {"/depth": 44, "/low": 0},
        "view_clocks_s": {"/depth": 0.0625},
        "points": {"lidar": 7000, "camera": 1000, "both": 2000, "compared": 2600},
    },
    "scans_unmatched": {"too little of the scan lies on the map": 9},
    "lost": [{"after_s": 61.25, "x_m": 3.0, "y_m": -4.5}],
    "left_out": {"scan left out: stamp not newer than the one before": 3},
    "reader_notes": {"range NaN kept as invalid": 44},
    "odometry_messages": 2400,
    "odometry_used": True,
    "odometry_turn_bias_rad_per_m": 0.0795,
    "odometry_scale_error": -0.0123,
    "odometry_slip_scans": 37,
    "nodes": 300,
    "submaps": 14,
    "loops": {"searched": 30, "closed": 19, "taken_back": 2, "refused": {"ambiguous": 9}},
    "final_passes": {
        "undone": False,
        "moved_m": [0.021, 0.002],
        "pairs": 90,
        "pairs_tried": 100,
        "lidar_offsets": [
            {
                "lidar": "rear",
                "x_m": 0.03,
                "y_m": -0.04,
                "yaw_deg": -0.9,
                "clock_s": 0.0,
                "sigma_m": 0.005,
                "sigma_deg": 0.07,
                "sigma_s": 0.01,
            }
        ],
    },
    "correction_m": {"mean": 0.5, "maximum": 1.25, "end": 0.75},
    "map": {
        "resolution_m": 0.05,
        "width_cells": 400,
        "height_cells": 200,
        "occupied_cells": 5,
        "free_m2": 61.4,
    },
    "ground_truth": {"error": None, "words": ["ATE rmse 0.0430 m"]},
}
TIMING = {
    "cpu_s_of_process": 4.25,
    "wall_s": 5.0,
    "times_real_time": 24.0,
    "peak_memory_mb": 301.4,
    "kernels_compiled": False,
}


def test_the_summary_tells_what_a_map_is_judged_by(tmp_path: Path) -> None:
    (tmp_path / "map.png").touch()
    text = "\n".join(summary_lines(METRICS, TIMING, tmp_path, partial=False))
    for told in (
        "50.0 m driven in 120.0 s",
        "812 scans mapped (700 of front, 112 of rear)",
        "7.2 m driven where the scans did not show the way along; odometry held it",
        "+0.0795 rad/m and -1.23 % of its way",
        "turned otherwise than its wheels say during 37 scans",
        "too little of the scan lies on the map: 9",
        "19 closed, 9 refused, 2 taken back",
        "ambiguous: 9",
        "views taken in: 610 of /depth",
        "20.0 % were seen by both, 10.0 % by the views alone",
        "the clock of /depth is off: +0.062 s added",
        "scans without a view of /depth near in time, lidar alone there: 44",
        "lost 61.2 s after the start, near (3.0, -4.5) in the map",
        "1.25 m at most",
        "21.0 mm, 2.0 mm",
        "90 of 100 pairs",
        "rear corrected: it stands 5.0 cm (+- 0.5) and -0.90 deg (+- 0.07) from where",
        "20.0 x 10.0 m",
        "stamp not newer than the one before: 3",
        "range NaN kept as invalid: 44",
        "ATE rmse 0.0430 m",
        "4.2 s CPU, 5.0 s wall time; 24 times real time; 301 MB",
        "map.png",
    ):
        assert told in text, told
    assert text.startswith("verdict       good: ")
    assert "PARTIAL" not in text
    assert "PARTIAL" in "\n".join(summary_lines(METRICS, TIMING, tmp_path, partial=True))
    bare = {
        **METRICS,
        "fusion": {**METRICS["fusion"], "views": {}, "cameras_without_view": []},
        "final_passes": None,
        "ground_truth": None,
        "odometry_messages": 0,
        "odometry_used": False,
        "odometry_turn_bias_rad_per_m": None,
        "odometry_scale_error": None,
        "odometry_slip_scans": None,
        "scans_unmatched": {},
        "reader_notes": {},
        "left_out": {},
    }
    text = "\n".join(summary_lines(bare, TIMING, tmp_path, partial=False))
    assert "the last velocity held it" in text
    assert "every scan matched" in text
    assert "left out" not in text
    assert "views" not in text
    assert "slip" not in text


@pytest.mark.parametrize(
    ("both", "camera", "compared", "said"),
    [
        (2000, 1000, 2600, []),
        (300, 1700, 2000, []),  # low things in nearly all directions
        (30, 1700, 2000, ["agree on only 1.7 % of what the views saw"]),
        (0, 1700, 0, ["measured in no common direction"]),
        (0, 0, 0, []),  # blind views
    ],
)
def test_views_that_contradict_the_lidar_are_told(
    both: int, camera: int, compared: int, said: list[str]
) -> None:
    points = {"lidar": 7000, "camera": camera, "both": both, "compared": compared}
    fusion = {**METRICS["fusion"], "points": points}
    doubts = [line for line in fusion_lines({"fusion": fusion}) if "lidar and views" in line]
    assert len(doubts) == len(said)
    assert all(words in line for words, line in zip(said, doubts, strict=True))
    union = {**fusion, "mode": "union"}
    assert not any("lidar and views" in line for line in fusion_lines({"fusion": union}))


def test_a_run_whose_images_were_all_lost_says_what_it_is() -> None:
    fusion = {**METRICS["fusion"], "views": {}}
    assert fusion_lines({"fusion": fusion}) == [
        "no image of /behind could be used: see 'left out'",
        "mapped by the lidar alone",
    ]


def test_what_is_counted_twice_says_the_same(demo: DemoFiles, tmp_path: Path) -> None:
    """The metrics of a run against its own files."""

    class Silent:
        def stage(self, what: str) -> None: ...

        def progress(self, scans: int, recorded_s: float, closures: int) -> None: ...

    request = RunRequest((demo.recording,), out=tmp_path / "out")
    run = run_recording(request, Silent(), Interruption()).run
    metrics = run.metrics
    assert sum(metrics["scans_by_sensor"].values()) == metrics["scans"] == len(run.scans)
    loops = metrics["loops"]
    closed_or_not = loops["closed"] + loops["taken_back"] + sum(loops["refused"].values())
    assert closed_or_not == loops["searched"]
    assert run.odometry is not None
    assert metrics["odometry_messages"] == len(run.odometry)
    # The base is mapped from where it stood first, so the drift of local SLAM shows at the end.
    assert metrics["correction_m"]["maximum"] >= metrics["correction_m"]["mean"] > 0.0
    # The wheels turn by 0.015-0.02 rad/m to one side: the error in heading over the way tells.
    heading_error = run.odometry.at(run.trajectory.stamps_ns)[:, 2] - run.trajectory.xyyaw[:, 2]
    drift = np.unwrap(heading_error)
    turned_rad_per_m = (drift[-1] - drift[0]) / metrics["way_m"]
    assert metrics["odometry_turn_bias_rad_per_m"] == pytest.approx(-turned_rad_per_m, abs=0.005)
    # They count 1 to 2 % too long or too short, and the way that was mapped tells.
    wheels_m = float(np.hypot(*np.diff(run.odometry.xyyaw[:, :2], axis=0).T).sum())
    missing = metrics["way_m"] / wheels_m - 1.0
    assert abs(missing) > 0.005
    assert metrics["odometry_scale_error"] == pytest.approx(missing, abs=0.005)


def test_a_doubtful_map_says_so_first_and_where(tmp_path: Path) -> None:
    doubt = {
        "what": "walls stand where other scans saw free space",
        "x_m": 12.34,
        "y_m": -5.0,
        "after_s": 61.2,
        "to_s": 70.0,
        "why": "44 % of what can be compared with another pass (12.0 s) is contradicted",
        "help": "look at the map there",
    }
    lines = summary_lines(
        {**METRICS, "verdict": "doubtful", "doubts": [doubt] * 7}, TIMING, tmp_path, partial=False
    )
    assert lines[0] == "verdict       DOUBTFUL: 7 places to look at"
    assert "near (12.3, -5.0), 61.2 to 70.0 s: walls stand where" in lines[1]
    assert "44 %" in lines[1]
    assert sum("near (12.3, -5.0)" in line for line in lines) == 5
    assert "and 2 more" in "\n".join(lines)
