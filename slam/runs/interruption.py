"""Ctrl-C and SIGTERM during a run: the first asks to come to an end, the second breaks off."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """Work that can be done without was broken off by the first signal."""


class Interruption:
    """Listens while it is entered (in the main thread; elsewhere nothing can).

    number : of the first signal, 0 while there is none.
    """

    def __init__(self) -> None:
        self.number = 0
        self._breaks_off = False
        self._before: dict[signal.Signals, Any] = {}

    @property
    def asked(self) -> bool:
        """Whether somebody wants the work to come to its end."""
        return self.number != 0

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._heard) for number in SIGNALS}
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @contextmanager
    def breaking_off(self) -> Iterator[None]:
        """Within, the first signal raises Interrupted; ``number`` is set then."""
        self._breaks_off = True
        try:
            yield
        finally:
            self._breaks_off = False

    def _heard(self, number: int, frame: FrameType | None) -> None:
        if self.number:
            raise KeyboardInterrupt
        self.number = number
        if self._breaks_off:
            raise Interrupted
