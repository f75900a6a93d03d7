"""A small recording for runs, and the command line as a function."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import NamedTuple

import pytest

from tests.slam.ring_log import DemoFiles, write_demo_recording


class Done(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


Command = Callable[..., Done]


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> DemoFiles:
    """A ring of corridors: 109 s; most tests read the first seconds only."""
    return write_demo_recording(tmp_path_factory.mktemp("demo"), seed=7)


@pytest.fixture
def slam(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """``slam("run", path)`` as in a shell, in this process."""
    from slam.cli import main

    def command(*words: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["slam", *map(str, words)])
        capsys.readouterr()
        try:
            main()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        return Done(code, *capsys.readouterr())

    return command
