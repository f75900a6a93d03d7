"""Kernels give the same bytes whether they were compiled just now or come from the cache."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.slam.crate_drive import write_crate_drive

RUN = "import sys; from slam.cli import main; sys.argv[0] = 'slam'; main()"


def test_a_first_run_gives_the_bytes_of_all_later_ones(tmp_path: Path) -> None:
    bag = write_crate_drive(tmp_path)
    cache = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    folders = [tmp_path / "cold", tmp_path / "warm"]
    for folder in folders:
        command = [sys.executable, "-c", RUN, "run", str(bag), "-q", "-o", str(folder)]
        subprocess.run(command, env=cache, check=True, capture_output=True)
    cold, warm = ({f.name: f.read_bytes() for f in each.iterdir()} for each in folders)
    assert b'"kernels_compiled": true' in cold["timing.json"]
    assert b'"kernels_compiled": false' in warm["timing.json"]
    assert cold.keys() == warm.keys()
    assert {name for name in cold if cold[name] != warm[name]} == {"timing.json"}
