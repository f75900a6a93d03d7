"""A guard against one stamp from the far future, which would make all that follows look old."""

from __future__ import annotations

from collections import Counter

from datasets.messages import Message

FAR_NS = 1000 * 1_000_000_000


class LeapGuard:
    """Lets messages pass, and holds one that leaps ahead until the next confirms it or not."""

    def __init__(self, left_out: Counter[str]) -> None:
        """left_out : where a message that was not confirmed is counted."""
        self._left_out = left_out
        self._newest_ns: int | None = None
        self._held: Message | None = None

    def passed(self, message: Message) -> list[Message]:
        """The messages that are settled now, in order; none while one is held."""
        held, self._held = self._held, None
        if self._newest_ns is None or message.stamp_ns - self._newest_ns <= FAR_NS:
            self._drop(held)
            self._newest_ns = max(message.stamp_ns, self._newest_ns or message.stamp_ns)
            return [message]
        if held is not None and abs(message.stamp_ns - held.stamp_ns) <= FAR_NS:
            self._newest_ns = max(message.stamp_ns, held.stamp_ns)
            return [held, message]
        self._drop(held)
        self._held = message
        return []

    def end(self) -> None:
        """No more messages come: what is held was never confirmed."""
        self._drop(self._held)
        self._held = None

    def _drop(self, held: Message | None) -> None:
        if held is not None:
            self._left_out["message left out: stamp far after all others"] += 1
