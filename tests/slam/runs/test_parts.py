"""A drive that falls into parts is delivered in parts, each right by itself, and says so."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from datasets.bags import read_trajectory
from datasets.tum import read_tum
from slam.evaluation.trajectory_error import trajectory_error
from tests.slam.conftest import Command


def test_what_nothing_joins_is_delivered_beside(tmp_path: Path, slam: Command) -> None:
    """Round a block of the campus, where all corridors look alike; turned by hand half-way."""
    bag = tmp_path / "turned.mcap"
    words = ("simulate", "campus", "--drive", "stretch", "--trouble", "turned", "--seed", "1")
    told = slam(*words, "--no-depth", "-o", bag)
    assert told.code == 0, told.err
    told = slam("run", bag, "-o", tmp_path / "out")
    assert told.code == 0, told.err
    assert told.out.startswith("verdict       DOUBTFUL: 1 place to look at")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["verdict"] == "doubtful"
    assert metrics["doubts"][0]["what"] == "part 2 hangs on by a guess"
    truth = read_trajectory(bag, None)
    parts = [read_tum(tmp_path / "out" / part / "trajectory.tum") for part in (".", "part-2")]
    for part in parts:
        error = trajectory_error(part, truth)
        assert error.translation_m.maximum < 0.05
        assert error.count > 300
    assert not set(parts[0].stamps_ns.tolist()) & set(parts[1].stamps_ns.tolist())
    scans = sum(metrics["scans_by_sensor"].values())
    assert scans - 20 < sum(len(part) for part in parts) <= scans
    for part in (".", "part-2"):
        assert (
            np.frombuffer((tmp_path / "out" / part / "map.pgm").read_bytes(), np.uint8).min() == 0
        )
