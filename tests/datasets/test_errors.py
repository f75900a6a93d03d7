"""Errors are one printable line of bounded length, whatever a file made somebody say."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datasets.errors import InputError, one_line


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("plain words,  /scan (m²)", "plain words,  /scan (m²)"),
        ("two\nlines\r\n and\ttabs ", "two lines and tabs"),
        ("/scan\x1b[31mred\x07", "/scan\\x1b[31mred\\x07"),
        ("right to left \u202e name", "right to left \\u202e name"),
        ("no UTF-8: \udcff", "no UTF-8: \\udcff"),
        ("a" * 30, "aaaaaaaa...aaaaaaaaa"),
    ],
)
def test_a_text_becomes_one_printable_line(text: str, line: str) -> None:
    assert one_line(text, 20 if text[0] == "a" else 80) == line


@given(st.text(max_size=400), st.text(max_size=400), st.text(max_size=600))
def test_every_error_is_one_printable_line(what: str, where: str, remedy: str) -> None:
    said = str(InputError(what * 9, where=where, remedy=remedy))
    assert said.isprintable()
    assert len(said) <= 1110


def test_a_long_place_keeps_its_two_ends() -> None:
    error = InputError("bad", where=f"/{'deep/' * 100}a.bag, line 7", remedy="Mend it")
    assert error.where.startswith("/deep/")
    assert error.where.endswith("/a.bag, line 7")
    assert len(error.where) == 300
