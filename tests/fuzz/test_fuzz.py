"""A few hundred spoilt inputs, the same each time: the fuzzer works, and finds nothing here."""

from __future__ import annotations

import signal
import struct
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datasets.errors import InputError
from tests.fuzz import __main__ as fuzz
from tests.fuzz.samples import samples
from tests.fuzz.targets import READERS

INPUTS = 400


@pytest.fixture
def alarm() -> Any:  # noqa: ANN401
    before = signal.signal(signal.SIGALRM, fuzz._alarm)
    yield
    signal.signal(signal.SIGALRM, before)


def test_every_sample_is_good_until_it_is_spoilt(tmp_path: Path) -> None:
    kinds = samples()
    assert {sample.kind for sample in kinds} == READERS.keys()
    for sample in kinds:
        path = fuzz.place(tmp_path / "input", sample, sample.files[sample.spoilt])
        for way in range(8):
            READERS[sample.kind](path, way)


def test_no_spoilt_input_gives_a_fault(tmp_path: Path, alarm: None) -> None:
    kinds = samples()
    tried: Counter[str] = Counter()
    for index in range(INPUTS):
        sample, data, way = fuzz.choose(0, index, kinds)
        path = fuzz.place(tmp_path / "input", sample, data)
        assert fuzz.attempt(sample, path, way) is None, f"--seed 0 --index {index}"
        tried[sample.kind] += data != sample.files[sample.spoilt]
    assert tried.keys() == READERS.keys()
    assert tried.total() > 0.9 * INPUTS


def test_inputs_are_the_same_each_time() -> None:
    kinds = samples()
    for index in (0, 1, 17):
        assert fuzz.choose(5, index, kinds) == fuzz.choose(5, index, kinds)
    assert fuzz.choose(5, 0, kinds) != fuzz.choose(6, 0, kinds)


def _hang(path: Path, way: int) -> None:
    while True:
        time.sleep(0.01)


def _trip(path: Path, way: int) -> None:
    struct.unpack("<I", b"")


def _mumble(path: Path, way: int) -> None:
    error = InputError("a", where="b", remedy="c")
    error.args = ("two\nlines",)
    raise error


@pytest.mark.parametrize(
    ("reader", "signature"),
    [(_hang, "hang in"), (_trip, "error in"), (_mumble, "not one printable line")],
)
def test_each_kind_of_fault_is_seen(
    tmp_path: Path,
    alarm: None,
    monkeypatch: pytest.MonkeyPatch,
    reader: Callable[[Path, int], object],
    signature: str,
) -> None:
    monkeypatch.setattr(fuzz, "HANG_S", 0.3)
    monkeypatch.setitem(READERS, "tum", reader)
    sample = next(sample for sample in samples() if sample.kind == "tum")
    path = fuzz.place(tmp_path / "input", sample, b"")
    found = fuzz.attempt(sample, path, 0)
    assert found is not None
    assert signature in found[0]
