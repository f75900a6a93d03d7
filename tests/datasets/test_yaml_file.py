"""What YAML has beyond plain data is refused, with file and line, before it costs anything."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from datasets.errors import InputError
from datasets.yaml_file import DEEPEST, LONGEST_BYTES, MarkedYaml


def content(text: str) -> object:
    return MarkedYaml.parse(text, "a.yaml", "").content


@pytest.mark.parametrize(
    ("text", "data"),
    [
        ("", None),
        ("a: 1\nb: [2.5, x, true, null]\n", {"a": 1, "b": [2.5, "x", True, None]}),
        ("a: -.inf", {"a": -math.inf}),
        ("a: 2020-01-01\n", {"a": "2020-01-01"}),
        ("a: &x {b: 1}\nc: *x\n", {"a": {"b": 1}, "c": {"b": 1}}),
        ("a: 0x1F\n1: b\nno: c\n", {"a": 31, "1": "b", "no": "c"}),
        ('"<<": 1\n', {"<<": 1}),
    ],
)
def test_plain_data_is_read(text: str, data: object) -> None:
    assert content(text) == data


def doubling(merge: bool) -> str:
    """A few lines that stand for 2 ** 40 values."""
    lines = ["a0: &a0 {x: 1}"]
    for k in range(1, 41):
        two = f"[*a{k - 1}, *a{k - 1}]"
        lines.append(f"a{k}: &a{k} {{<<: {two}}}" if merge else f"a{k}: &a{k} {two}")
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        (doubling(merge=True), 2, "merge keys"),
        (doubling(merge=False), None, "more than 200000 values"),
        ("a:\n  - " + "[" * 5000 + "]" * 5000, 2, f"more than {DEEPEST} levels"),
        ("".join(f"{' ' * k}k:\n" for k in range(300)), DEEPEST + 1, f"more than {DEEPEST} levels"),
        ("a: 1\nb: !!python/object:os.system {}\n", 2, "tag"),
        ("a: 1\nb: !!binary aGk=\n", 2, "tag"),
        ("a: 1\nb: !!set {x}\n", 2, "tag"),
        ("a: 1\nb: !thing x\n", 2, "tag"),
        ("a: 1\nb: !!int x\n", 2, "is no int"),
        ("a: 1\n? [b]\n: 2\n", 2, "a key must be a word"),
        ("a: &b\n  c: *b\n", 1, "stands in itself"),
        (f"a:\n  b: {'9' * 5000}\n", 2, "too large"),
        (f"a:\n  b: 0x{'f' * 5000}\n", 2, "too large"),
        (f"a:\n  b: {2**63}\n", 2, "too large"),
        ("a:\n  b: 1.0e+400\n", 2, "too large"),
        ("a: 1\nb: \x01\n", 2, "not readable as YAML"),
        ("a: \ud800\n", None, "not readable as YAML"),
        ("a: 1\n---\nb: 2\n", 2, "not readable as YAML"),
        ("a" * (LONGEST_BYTES + 1), None, "longer than"),
    ],
)
def test_what_is_no_plain_data_is_refused_with_its_line(
    text: str, line: int | None, what: str
) -> None:
    with pytest.raises(InputError, match=what) as caught:
        content(text)
    assert caught.value.where.startswith("a.yaml")
    if line is not None:
        assert caught.value.where.startswith(f"a.yaml, line {line}")
    assert str(caught.value).isprintable()


def test_a_file_that_is_too_long_or_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "long.yaml"
    path.write_text("# " + "x" * LONGEST_BYTES)
    with pytest.raises(InputError, match="longer than"):
        MarkedYaml.read(path, "the place", "", "Give another.")
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="no text file"):
        MarkedYaml.read(path, "the place", "", "Give another.")
    with pytest.raises(InputError, match="No such file"):
        MarkedYaml.read(tmp_path / "none.yaml", "the place", "", "Give another.")
