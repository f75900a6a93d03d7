"""What stops a run before it starts: errors with a place and a remedy."""

from __future__ import annotations


class InputError(Exception):
    """Input that no run can come from. The command line prints it and exits with code 2.

    what   : what is wrong, one sentence without a full stop.
    where  : the file, and the line, key or topic in it.
    remedy : what the person can do about it.
    """

    def __init__(self, what: str, *, where: str, remedy: str) -> None:
        super().__init__(f"{where}: {what}. {remedy}")
        self.what = what
        self.where = where
        self.remedy = remedy
