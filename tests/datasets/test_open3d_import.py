"""Open3D without the system's libusb."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
from datasets.open3d_import import import_open3d
open3d = import_open3d()
assert open3d.t.geometry.RaycastingScene is not None
print(open("/proc/self/maps").read())
"""


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="only Linux lists its libraries")
def test_the_library_of_the_wheel_is_the_one_in_use() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    mapped = {line.split()[-1] for line in done.stdout.splitlines() if "libusb-1.0" in line}
    assert {Path(name).parent.name for name in mapped} == {"libusb_package"}
