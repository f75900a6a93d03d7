"""What stops a run before it starts: errors with a place and a remedy."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

LONGEST_WHAT: Final = 300
LONGEST_WHERE: Final = 300
LONGEST_REMEDY: Final = 500
"""Characters of each part of an error: what a hostile file has to say may be megabytes."""

_BREAK: Final = re.compile(r"\s*[^\S ]\s*")


def one_line(text: str, longest: int) -> str:
    """The text as one printable line of at most so many characters, to be shown in a terminal.

    Line breaks and tabs become a space and control characters, lone surrogates and the like
    their escapes (``\\x1b``), so that no file can move a cursor. What is too long loses its middle.
    """
    text = str(text)
    if len(text) > 4 * longest:  # before the work on each character
        text = f"{text[: 2 * longest]} {text[-2 * longest :]}"
    text = _BREAK.sub(" ", text).strip()
    if not text.isprintable():
        text = "".join(c if c.isprintable() else _escaped(c) for c in text)
    if len(text) > longest:
        head = (longest - 3) // 2
        text = f"{text[:head]}...{text[head + 3 - longest :]}"
    return text


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


class InputError(Exception):
    """Input that no run can come from. The command line prints it and exits with code 2.

    what   : what is wrong, one sentence without a full stop.
    where  : the file, and the line, key or topic in it.
    remedy : what the person can do about it.

    Each part is kept as one printable line of bounded length (``one_line``).
    """

    def __init__(self, what: str, *, where: str, remedy: str) -> None:
        self.what = one_line(what, LONGEST_WHAT)
        self.where = one_line(where, LONGEST_WHERE)
        self.remedy = one_line(remedy, LONGEST_REMEDY)
        super().__init__(f"{self.where}: {self.what}. {self.remedy}")


@contextmanager
def reading(what: str, *, where: str, remedy: str) -> Iterator[None]:
    """At the border of a reader: whatever it trips over becomes an InputError.

    what : the sentence that the reason is put behind, as in "the trajectory can't be read".

    Files hold what nobody thought of, and libraries raise whatever their parsing trips over: types,
    keys, overflows, depth of recursion. An InputError that says more goes through as it is.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{what} ({_reason(error)})", where=where, remedy=remedy) from error


def _reason(error: Exception) -> str:
    if isinstance(error, UnicodeDecodeError):
        return "no text file"
    if isinstance(error, OSError):
        return error.strerror or str(error)
    if isinstance(error, RecursionError):
        return "nested too deeply"
    if isinstance(error, MemoryError):
        return "it asks for more memory than there is"
    if isinstance(error, KeyError):
        return f"there is no {error}"
    return str(error) or type(error).__name__
