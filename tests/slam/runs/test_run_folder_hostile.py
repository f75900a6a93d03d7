"""Run folders that somebody else wrote: each fault is named with its file, whatever it is."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets.errors import InputError
from slam.runs.export import export_run
from slam.runs.run_folder import read_run
from tests.slam.runs.test_run_folder import make_run, write


def changed_scans(**changes: Any) -> Callable[[bytes], bytes]:  # noqa: ANN401
    """scans.npz with other arrays."""

    def change(before: bytes) -> bytes:
        with np.load(io.BytesIO(before)) as arrays:
            fields = dict(arrays) | changes
        out = io.BytesIO()
        np.savez(out, **fields)
        return out.getvalue()

    return change


def bomb(before: bytes) -> bytes:
    """A few kilobytes that say they unpack to 1 GB, and would."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as members:
        for name in ("points_base", "roles"):
            with members.open(f"{name}.npy", "w") as member:
                header = np.lib.format.header_data_from_array_1_0(np.zeros((2, 2), np.float32))
                np.lib.format.write_array_header_1_0(member, header | {"shape": (8 << 20, 2)})
                for _ in range(64):
                    member.write(bytes(1 << 20))
    return out.getvalue()


def text(content: str) -> Callable[[bytes], bytes]:
    return lambda before: content.encode()


HOSTILE = {
    "json that is a list": ("metrics.json", text("[1, 2]"), "not a table"),
    "json 50,000 deep": ("metrics.json", text("[" * 50_000), "deep"),
    "json 50,000 deep in words": ("timing.json", text('{"a":' * 50_000), "deep"),
    "a number of 10,000 digits": ("timing.json", text(f'{{"a": {"9" * 10_000}}}'), "digits"),
    "a list for the configuration": ("config.yaml", text("- 1\n"), "not a table"),
    "merge keys": ("config.yaml", text("a: &a {b: 1}\nc: {<<: *a}\n"), "line 2: merge keys"),
    "a cell of 200,000 characters": ("constraints.csv", text("a\n" + "x" * 200_000), "limit"),
    "no table at all": ("constraints.csv", text(""), "column names"),
    "rows of other lengths": ("constraints.csv", text("a,b\n1\n"), "a row of 1"),
    "zeros for a trajectory": ("trajectory.tum", lambda before: bytes(100), "line 1"),
    "a pose at 4e9 m": ("trajectory.tum", text("1 4e9 0 0 0 0 0 1\n"), "line 1: a value is larger"),
    "a stamp of a million digits": ("odometry.tum", text("1e999999 0 0 0 0 0 0 1\n"), "line 1"),
    "an object array": ("scans.npz", changed_scans(offsets=np.array([{}], object)), "pickle"),
    "a number for an array": ("scans.npz", changed_scans(points_base=np.float32(1)), "scans.npz"),
    "an origin of 1e308": (
        "scans.npz", changed_scans(origins_base=np.full((2, 2), 1e308)), "origins_base is out of"
    ),
    "points out of range": (
        "scans.npz",
        changed_scans(points_base=np.full((66, 2), 1e38, np.float32)),
        "points_base is out of range",
    ),
    "offsets that fall": (
        "scans.npz", changed_scans(offsets=np.array([0, 5, 3, *range(4, 13), 66])), "offsets"
    ),
    "a bomb": ("scans.npz", bomb, "unpack to more than it can hold"),
    "an empty archive": ("scans.npz", lambda before: b"PK\5\6" + bytes(18), "no"),
    "half an archive": ("scans.npz", lambda before: before[: len(before) // 2], "scans.npz"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "change", "what"), HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_file_is_named(
    tmp_path: Path, name: str, change: Callable[[bytes], bytes], what: str
) -> None:
    write(tmp_path / "run", make_run())
    path = tmp_path / "run" / name
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(InputError, match=what) as caught:
        read_run(tmp_path / "run")
    assert str(path) in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    "config", ["config: [1]\n", "config: {map: [1]}\n", "config: {map: {resolution_m: []}}\n"]
)
def test_an_export_refuses_a_configuration_that_is_none(tmp_path: Path, config: str) -> None:
    write(tmp_path / "run", make_run())
    (tmp_path / "run" / "config.yaml").write_text(config)
    with pytest.raises(InputError, match=r"the map cannot be drawn so"):
        export_run(tmp_path / "run", tmp_path / "out")
