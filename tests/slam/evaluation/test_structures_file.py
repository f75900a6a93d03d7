"""Structures that a user measured, and every mistake in their file."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from datasets.errors import InputError
from slam.evaluation.structures_file import read_structures

GOOD = """\
structures:
  hall:
    from_m: [0.0, 1.0]
    to_m: [12.0, 1.0]
    length_m: 12.34
    width_m: 3.0
  side: {from_m: [0, 0], to_m: [0, -5], length_m: 5.1}
"""


def read(folder: Path, text: str) -> object:
    path = folder / "structures.yaml"
    path.write_text(text, encoding="utf-8")
    return read_structures(path)


def test_structures_are_read_in_order(tmp_path: Path) -> None:
    path = tmp_path / "structures.yaml"
    path.write_text(GOOD, encoding="utf-8")
    hall, side = read_structures(path)
    assert hall.structure.name == "hall"
    assert hall.structure.length_m == 12.34
    assert hall.structure.end_m == (12.0, 1.0)
    assert hall.width_m == 3.0
    assert side.structure.start_m == (0.0, 0.0)
    assert side.width_m == 2.0


@pytest.mark.parametrize(
    ("old", "new", "line", "what"),
    [
        ("length_m: 12.34", "lenght_m: 12.34", 5, "no such key"),
        ("    length_m: 12.34\n", "", 2, "missing"),
        ("length_m: 12.34", "length_m: -1", 5, "greater than or equal to 0.0001"),
        ("length_m: 12.34", "length_m: .nan", 5, ""),
        ("to_m: [12.0, 1.0]", "to_m: [12.0]", 4, ""),
        ("to_m: [12.0, 1.0]", "to_m: [0.0, 1.0]", 2, "0.00 m apart"),
        ("length_m: 12.34", "length_m: 21.34", 2, "12.00 m apart"),
        ("  side:", "  hall:", 7, "second time"),
        ("width_m: 3.0", "width_m: 0.1", 6, ""),
        ("    from_m", "  from_m", 4, "YAML"),
    ],
)
def test_mistakes_are_named_with_their_line(
    tmp_path: Path, old: str, new: str, line: int, what: str
) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, GOOD.replace(old, new, 1))
    assert f"line {line}" in caught.value.where
    assert what in caught.value.what
    assert caught.value.remedy


def test_what_is_no_such_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="can't be read"):
        read_structures(tmp_path / "none.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="can't be read"):
        read_structures(tmp_path / "binary.yaml")
    for text in ("", "structures: {}", "[]", "3"):
        with pytest.raises(InputError):
            read(tmp_path, text)


@given(text=st.text(max_size=200))
def test_other_texts_are_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.mktemp("any") / "structures.yaml"
    path.write_text(text, encoding="utf-8", errors="replace")
    with pytest.raises(InputError) as caught:
        read_structures(path)
    assert caught.value.where.startswith(str(path))


@given(
    value=st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=1) | st.dictionaries(st.text(max_size=5), inner),
        max_leaves=6,
    )
)
def test_an_end_that_is_no_point_is_refused(
    tmp_path_factory: pytest.TempPathFactory, value: object
) -> None:
    path = tmp_path_factory.mktemp("any") / "structures.yaml"
    content = {"structures": {"a": {"from_m": [0, 0], "to_m": value, "length_m": 4.0}}}
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(InputError):
        read_structures(path)
