"""Relations files: exact stamps, the real ones, and errors that name the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datasets.errors import InputError
from datasets.relations_file import Relations, read_relations

LINE = "976052905.167303 976052911.885496 -0.056990 -0.128430 0 0 0 -1.682210\n"


def test_epoch_stamps_are_exact(tmp_path: Path) -> None:
    path = tmp_path / "a.relations"
    path.write_text("# t1 t2 x y z roll pitch yaw\n\n" + LINE)
    relations = read_relations(path)
    assert relations.stamps_1_ns.tolist() == [976_052_905_167_303_000]
    assert relations.stamps_2_ns.tolist() == [976_052_911_885_496_000]
    np.testing.assert_array_equal(relations.xyyaw, [[-0.05699, -0.12843, -1.68221]])


@pytest.mark.parametrize(("name", "count"), [("intel", 2984), ("fr079", 1685)])
def test_the_real_ones_are_read_whole(shared_data: Path, name: str, count: int) -> None:
    assert len(read_relations(shared_data / "recordings" / f"{name}.relations")) == count


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("", "a.relations:", "no relation"),
        (LINE + "1 2 3\n", "line 2", "3 values where 8"),
        (LINE + "\n1 2 0 0 0 0 0 inf\n", "line 3", "not finite"),
        ("1 later 0 0 0 0 0 0\n", "line 1", "'later'"),
        ("1 2 0 0 0 0 0 north\n", "line 1", "could not convert"),
    ],
)
def test_errors_name_the_line(tmp_path: Path, text: str, where: str, what: str) -> None:
    path = tmp_path / "a.relations"
    path.write_text(text)
    with pytest.raises(InputError, match=what) as caught:
        read_relations(path)
    assert where in str(caught.value)


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        read_relations(tmp_path / "absent")
    (tmp_path / "b").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(InputError, match="no text file"):
        read_relations(tmp_path / "b")


def test_shapes_are_checked() -> None:
    stamps = np.array([1, 2], dtype=np.int64)
    with pytest.raises(ValueError, match="stamps"):
        Relations(stamps, stamps[:1], np.zeros((2, 3)))
    with pytest.raises(ValueError, match="2 stamps"):
        Relations(stamps, stamps, np.zeros((1, 3)))
    with pytest.raises(ValueError, match="finite"):
        Relations(stamps, stamps, np.full((2, 3), np.nan))


@pytest.mark.parametrize("line", ["1e999999 2 1 0 0 0 0 0", "1 2 1e300 0 0 0 0 0"])
def test_numbers_out_of_range_are_refused_with_their_line(tmp_path: Path, line: str) -> None:
    path = tmp_path / "far.relations"
    path.write_text(f"1 2 1 0 0 0 0 0\n{line}\n")
    with pytest.raises(InputError, match="line 2"):
        read_relations(path)
