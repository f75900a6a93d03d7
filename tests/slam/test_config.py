"""The configuration names the line of a file, or the setting, that is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from datasets.errors import InputError
from slam.config import load_config


def test_a_file_with_a_setting_over_it(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("odometry: false\nmap:\n  resolution_m: 0.1\n")
    config = load_config(path, ["map.resolution_m=0.025"])
    assert (config.odometry, config.map.resolution_m) == (False, 0.025)


@pytest.mark.parametrize(
    ("text", "settings", "where", "what"),
    [
        (
            "odometry: true\nmap:\n  resolution_m: -1\n",
            (),
            "line 3, key map.resolution_m",
            "greater",
        ),
        ("map:\n  no: 1\n", (), "line 2, key map.no", "no such key"),
        ("config:\n  map:\n    no: 1\n", (), "line 3, key config.map.no", "no such key"),
        ("map: 3\n", (), "line 1, key map", "a section"),
        ("map: {}\n", ("map.resolution_m=x",), "--set map.resolution_m=x", "number"),
        ("map: {}\n", ("loops=7", "odometry=[1"), "--set odometry=[1", "is not a value"),
        ("odometry: 2001-01-01\n", (), "line 1, key odometry", "boolean"),
        ("base: &b {resolution_m: 0.1}\nmap:\n  <<: *b\n", (), "line 3", "merge keys"),
        ("- 1\n", (), "", "holds no keys"),
        ("map: {resolution_m: 0.1}\nmap: {}\n", (), "line 2, key map", "a second time"),
    ],
)
def test_errors_name_line_or_setting(
    tmp_path: Path, text: str, settings: tuple[str, ...], where: str, what: str
) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_config(path, settings)
    assert where in caught.value.where
    assert what in caught.value.what
    assert ("--set" in caught.value.where) != (str(path) in caught.value.where)
