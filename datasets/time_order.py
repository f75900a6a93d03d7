"""Messages as they arrive, put in order of time: each stream for itself, then all of them.

A stamp that doesn't fit is judged by its neighbours on both sides, so that one stamp a day ahead
costs one message and not the day after it.
"""

from __future__ import annotations

import heapq
import statistics
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from datasets.messages import Odometry
from datasets.options import ReadOptions

JUMP_NS = 1_000_000_000
"""A longer step of a stream waits for the messages after it before it is believed,"""

JUMP_INTERVALS = 4
"""unless it is shorter than so many of its usual steps."""

WINDOW = 12
"""How many messages of a stream judge a stamp; outliers among them must be fewer than half."""

LATE_NS = 2_000_000_000
"""How much later than the newest a message of a silent stream may be and still be sorted in."""

SILENT = 300
"""After so many messages of other streams nobody waits for a stream any more."""

ISOLATED_NS = 3_600_000_000_000
"""A message alone by more than this, at an end of the recording, is an error of its clock."""

SAME_TIME_NS = 30_000_000_000
"""Streams closer than this tell the same time."""

MOST_HELD = 10_000
"""Messages of other streams that wait, at most, for the judgement on one."""


class Stamped(Protocol):
    """A dataclass with a stamp: a message, or what will be one when its turn comes."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def stamp_ns(self) -> int: ...


M = TypeVar("M", bound=Stamped)


@dataclass(slots=True)
class _Stream(Generic[M]):
    last_ns: int | None = None
    shift_ns: int = 0
    heard: int = 0
    given_ns: int = -1
    usual_ns: int = 0
    waiting: list[M] = field(default_factory=list)

    def in_step(self, stamp_ns: int) -> bool:
        """Whether a stamp follows the last so closely that it needs no second opinion."""
        longest_ns = max(JUMP_NS, JUMP_INTERVALS * self.usual_ns)
        return self.last_ns is not None and 0 < stamp_ns - self.last_ns <= longest_ns

    def take(self, stamp_ns: int) -> None:
        """Remember a stamp as the last, and its step as one of the usual."""
        if self.last_ns is not None:
            step_ns = stamp_ns - self.last_ns
            # The first step counts whole; a gap counts little, or it would let jumps through.
            most_ns = 2 * self.usual_ns if self.usual_ns else min(step_ns, ISOLATED_NS)
            self.usual_ns += (min(step_ns, most_ns) - self.usual_ns) // (8 if self.usual_ns else 1)
        self.last_ns = stamp_ns


class TimeOrder(Generic[M]):
    """Takes messages in the order of arrival and gives them back in the order of time.

    Within a stream stamps strictly increase afterwards. A message is left out, and counted in
    ``notes``, if its stamp repeats, runs backwards or jumps ahead and back again; what decides is
    which messages the most others agree with. A step forward that lasts is a gap: it is kept and
    noted. A clock set back for good is bridged: what follows is moved on by a constant, the same
    for all streams, so that it continues where the stream was. At equal stamps odometry comes
    first. A stream may lag behind another by any constant. Memory: WINDOW messages a stream, the
    lag between streams and LATE_NS of recording, but never more than MOST_HELD messages.

        order = TimeOrder(notes)
        for name, message in arriving:
            yield from order.push(name, message)
        yield from order.flush()

    The stream's name stands in the notes: ``"<name> left out: stamp runs backwards"``.
    """

    def __init__(self, notes: Counter[str]) -> None:
        self._notes = notes
        self._streams: dict[str, _Stream[M]] = {}
        self._heap: list[tuple[int, bool, int, str, M]] = []
        self._arrived = 0
        self._accepted = 0
        self._newest_ns: int | None = None
        self._given_ns: int | None = None
        self._shift_ns = 0

    def push(self, name: str, message: M) -> Iterable[M]:
        """Add the next message of a stream; gives the messages that are now in order."""
        stream = self._streams.get(name)
        if stream is None:
            stream = self._streams[name] = _Stream(shift_ns=self._shift_ns)
        self._arrived += 1
        stream.heard = self._arrived
        if stream.shift_ns:
            message = replace(message, stamp_ns=message.stamp_ns + stream.shift_ns)
        if stream.last_ns is not None and not stream.waiting:
            if stream.in_step(message.stamp_ns):
                self._accept(name, stream, message)
                return self._ready()
            if message.stamp_ns == stream.last_ns:
                self._leave_out(name, "stamp repeated")
                return ()
        stream.waiting.append(message)
        self._judge(name, stream, WINDOW)
        return self._ready()

    def flush(self) -> Iterator[M]:
        """Judge and give what is left, after the last message."""
        for name, stream in self._streams.items():
            self._judge(name, stream, 1)
        while self._heap:
            yield heapq.heappop(self._heap)[4]

    def _judge(self, name: str, stream: _Stream[M], enough: int) -> None:
        """Decide on waiting messages, oldest first, while ``enough`` are there to judge by."""
        while stream.waiting:
            first_ns = stream.waiting[0].stamp_ns
            if not stream.in_step(first_ns) and len(stream.waiting) < enough:
                return
            stamps_ns = [message.stamp_ns for message in stream.waiting]
            if self._set_back(name, stream, stamps_ns):
                continue
            reason = _reason_against_first(stamps_ns, stream.last_ns, at_end=enough == 1)
            message = stream.waiting.pop(0)
            if reason is not None:
                self._leave_out(name, reason)
                continue
            if stream.last_ns is not None and first_ns - stream.last_ns > ISOLATED_NS:
                self._notes[f"{name}: gap of more than an hour bridged"] += 1
            self._accept(name, stream, message)

    def _set_back(self, name: str, stream: _Stream[M], stamps_ns: list[int]) -> bool:
        """Move a stream on whose clock was set back for good; False if that isn't so."""
        last_ns, count = stream.last_ns, len(stamps_ns)
        if last_ns is None or count < WINDOW or stamps_ns[0] >= last_ns:
            return False
        behind = [stamp_ns for stamp_ns in stamps_ns if stamp_ns <= last_ns]
        steps_ns = [after - before for before, after in pairwise(stamps_ns)]
        if len(behind) < count or sum(step > 0 for step in steps_ns) < 0.8 * len(steps_ns):
            return False
        if self._came_back(name, stream, stamps_ns):
            return True
        own_ns = last_ns + max(1, round(statistics.median(steps_ns))) - stamps_ns[0]
        # Another stream may have met the same step before: then all must move alike.
        shared_ns = self._shift_ns - stream.shift_ns
        move_ns = shared_ns if abs(shared_ns - own_ns) <= SAME_TIME_NS and shared_ns else own_ns
        stream.shift_ns += move_ns
        self._shift_ns = stream.shift_ns
        stream.waiting = [replace(m, stamp_ns=m.stamp_ns + move_ns) for m in stream.waiting]
        self._notes[f"{name}: clock set back; stamps from there on moved forward"] += 1
        return True

    def _came_back(self, name: str, stream: _Stream[M], stamps_ns: list[int]) -> bool:
        """Whether a stream that went back is now where the others are: then it was ahead before.

        What it gave while it was ahead is left out, if it still waits for the others.
        """
        since_ns = stamps_ns[0]
        others = [
            s.last_ns for n, s in self._streams.items() if n != name and s.last_ns is not None
        ]
        agrees = any(abs(other_ns - stamps_ns[-1]) <= SAME_TIME_NS for other_ns in others)
        given_ns = -1 if self._given_ns is None else self._given_ns
        if not agrees or given_ns >= max(stamps_ns):
            return False
        kept = [item for item in self._heap if item[3] != name or item[0] < since_ns]
        self._notes[f"{name} left out: stamp jumps ahead and back"] += len(self._heap) - len(kept)
        heapq.heapify(kept)
        self._heap = kept
        # What another stream has at its last given stamp may be had by this one as well.
        stream.last_ns = max(since_ns - 1, given_ns - 1, stream.given_ns)
        self._newest_ns = max(others)
        return True

    def _leave_out(self, name: str, reason: str) -> None:
        self._notes[f"{name} left out: {reason}"] += 1

    def _accept(self, name: str, stream: _Stream[M], message: M) -> None:
        stamp_ns = message.stamp_ns
        stream.take(stamp_ns)
        if self._given_ns is not None and stamp_ns < self._given_ns:
            self._leave_out(name, "arrives too late after the other messages of its time")
            return
        rank = not isinstance(message, Odometry)
        heapq.heappush(self._heap, (stamp_ns, rank, self._accepted, name, message))
        self._accepted += 1
        if self._newest_ns is None or stamp_ns > self._newest_ns:
            self._newest_ns = stamp_ns

    def _ready(self) -> list[M]:
        """What no message can come before any more."""
        ready: list[M] = []
        if self._newest_ns is None:
            return ready
        limit_ns = self._newest_ns - LATE_NS
        for stream in self._streams.values():
            # Whatever may still come of this stream comes after its last, unless it went back.
            if stream.waiting:
                limit_ns = min(limit_ns, *(message.stamp_ns for message in stream.waiting))
            if stream.waiting or self._arrived - stream.heard < SILENT:
                limit_ns = min(limit_ns, -1 if stream.last_ns is None else stream.last_ns)
        while self._heap and (self._heap[0][0] <= limit_ns or len(self._heap) > MOST_HELD):
            self._given_ns, _, _, name, message = heapq.heappop(self._heap)
            self._streams[name].given_ns = self._given_ns
            ready.append(message)
        return ready


def _reason_against_first(stamps_ns: list[int], last_ns: int | None, *, at_end: bool) -> str | None:
    """Why the first of the waiting stamps doesn't fit its neighbours, or None if it does.

    The stamps that agree are the longest increasing subsequence of those after ``last_ns``.
    """
    first_ns = stamps_ns[0]
    if last_ns is not None and first_ns <= last_ns:
        return "stamp repeated" if first_ns == last_ns else "stamp runs backwards"
    far_from_last = last_ns is None or first_ns - last_ns > ISOLATED_NS
    if len(stamps_ns) == 1:
        alone = at_end and last_ns is not None and far_from_last
        return "stamp jumps ahead" if alone else None
    after_ns = min((stamp for stamp in stamps_ns if stamp > first_ns), default=first_ns)
    if far_from_last and after_ns - first_ns > ISOLATED_NS:
        return "stamp stands alone"
    later = [stamp for stamp in stamps_ns[1:] if last_ns is None or stamp > last_ns]
    with_first = 1 + _longest_rise([stamp for stamp in later if stamp > first_ns])
    without_first = _longest_rise(later)
    # One against one, the smaller step is believed.
    jumps = (
        last_ns is not None
        and first_ns - last_ns > JUMP_NS
        and min(later, default=first_ns) < first_ns
    )
    if with_first > without_first or (with_first == without_first and not jumps):
        return None
    return "stamp jumps ahead and back"


def _longest_rise(stamps_ns: list[int]) -> int:
    """Length of the longest strictly increasing subsequence (patience sorting)."""
    tails: list[int] = []
    for stamp_ns in stamps_ns:
        place = bisect_left(tails, stamp_ns)
        tails[place : place + 1] = [stamp_ns]
    return len(tails)


def cut(messages: Iterable[M], options: ReadOptions) -> Iterator[M]:
    """The part of an ordered stream that ``start_s`` and ``duration_s`` ask for."""
    from_ns = until_ns = None
    for message in messages:
        if from_ns is None:
            from_ns = message.stamp_ns + round(options.start_s * 1e9)
            if options.duration_s is not None:
                until_ns = from_ns + round(options.duration_s * 1e9)
        if until_ns is not None and message.stamp_ns > until_ns:
            return
        if message.stamp_ns >= from_ns:
            yield message
