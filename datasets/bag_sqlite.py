"""The messages of rosbag2's SQLite databases, whole and damaged ones.

A database is a program as well: views, triggers, generated columns and virtual tables compute what
a query reads. Only plain tables are read here, with the number of steps bounded by the file's size.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final

from datasets.bag_records import Channel, Entry
from datasets.unpack import DamagedError

_STEPS: Final = 10_000
"""Instructions of SQLite's machine between two looks at how many there were."""
_SPARE_STEPS: Final = 2_000_000
_STEPS_A_BYTE: Final = 20
"""So many instructions a query may take, and so many for each byte: a row takes 10 to 40."""

_TABLES: Final = ("topics", "messages")


class Database:
    """A rosbag2 database, opened for reading; ``close`` it.

    salvage : a file shorter than its header says is borne, and damage ends what is read.

    Raises DamagedError if it is none.
    """

    def __init__(self, path: Path, *, salvage: bool) -> None:
        self._path = path
        self._bytes = sum(p.stat().st_size for p in (path, _log(path)) if p.exists())
        self._steps = 0
        self._salvage = salvage
        self._connection = self._open()
        self.unreadable = 0
        """Rows that were no messages: their values are of other types."""

    def close(self) -> None:
        self._connection.close()

    def channels(self) -> dict[int, Channel]:
        """The topics by their numbers. Raises DamagedError."""
        found: dict[int, Channel] = {}
        for row in self._rows("SELECT id, name, type, serialization_format FROM topics"):
            number, *words = row
            texts = [word for word in words if isinstance(word, str)]
            if isinstance(number, int) and len(texts) == len(words):
                found[number] = Channel(*texts)
            elif not self._salvage:
                raise DamagedError("a topic in it has no name or no type")
        return found

    def counts(self) -> Counter[int]:
        """The number of messages of each topic. Raises DamagedError."""
        query = "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"
        return Counter({n: count for n, count in self._rows(query) if isinstance(n, int)})

    def entries(self, channels: Collection[int]) -> Iterator[Entry]:
        """The messages of some topics: by bag time, or as they were written when salvaging.

        Raises DamagedError where the database breaks off.
        """
        order = "rowid" if self._salvage else "timestamp, rowid"
        numbers = ",".join(str(int(number)) for number in sorted(channels))
        where = "" if self._salvage else f"WHERE topic_id IN ({numbers}) "
        query = f"SELECT topic_id, timestamp, data FROM messages {where}ORDER BY {order}"
        wanted = frozenset(channels)
        left = self._bytes
        for number, bag_ns, data in self._rows(query):
            if not isinstance(number, int) or number not in wanted:
                continue
            if not (isinstance(bag_ns, int) and isinstance(data, bytes)):
                self.unreadable += 1
                continue
            left -= len(data)
            if left < 0:
                raise DamagedError("its rows hold more than the file does")
            yield Entry(number, bag_ns, data)

    def _rows(self, query: str) -> Iterator[tuple[object, ...]]:
        self._steps = 0
        try:
            for row in self._connection.execute(query):  # noqa: UP028 - closing it late must not fail
                yield row
        except (sqlite3.Error, UnicodeError, OverflowError) as error:
            reason = "it takes too long to read" if self._is_over() else str(error)
            raise DamagedError(reason) from error

    def _open(self) -> sqlite3.Connection:
        """A read-only connection. A write-ahead log beside the file is read where possible."""
        fault = "not a rosbag2 database"
        modes = ("mode=ro", "immutable=1") if _log(self._path).exists() else ("immutable=1",)
        for mode in modes:
            try:
                uri = f"{self._path.resolve().as_uri()}?{mode}"
                connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
            except sqlite3.Error as error:
                fault = str(error)
                continue
            try:
                self._prepare(connection)
                connection.execute("SELECT count(*) FROM topics").fetchone()
            except DamagedError:
                connection.close()
                raise
            except (sqlite3.Error, UnicodeError) as error:  # names of columns, too, may be no text
                fault = "it takes too long to read" if self._is_over() else str(error)
                connection.close()
                continue
            return connection
        raise DamagedError(fault)

    def _prepare(self, connection: sqlite3.Connection) -> None:
        connection.text_factory = lambda text: text.decode("utf-8", "replace")
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(1 << 20, self._bytes))
        connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        connection.set_progress_handler(self._step, _STEPS)
        connection.execute("PRAGMA trusted_schema=OFF")
        connection.execute("PRAGMA cell_size_check=ON")
        if self._salvage:
            connection.execute("PRAGMA writable_schema=ON")  # bears a schema that is damaged
        kinds = connection.execute(
            "SELECT name, type, sql FROM sqlite_master WHERE lower(name) IN ('topics', 'messages')"
        ).fetchall()
        for name, kind, sql in kinds:
            words = str(sql).upper().split()[:2]
            if kind != "table" or words != ["CREATE", "TABLE"]:
                raise DamagedError(f"its {name} are no plain table")
        for table in _TABLES:
            # hidden: 2 and 3 are generated columns, 1 a virtual table's
            columns = connection.execute(f"PRAGMA table_xinfo({table})").fetchall()
            if any(column[6] for column in columns):
                raise DamagedError(f"its {table} are no plain table")

    def _step(self) -> int:
        self._steps += _STEPS
        return int(self._is_over())

    def _is_over(self) -> bool:
        return self._steps > _SPARE_STEPS + _STEPS_A_BYTE * self._bytes


def _log(path: Path) -> Path:
    return path.with_name(f"{path.name}-wal")


def is_shorter_than_said(path: Path) -> bool:
    """Whether pages are missing by the database's header (sqlite.org/fileformat.html, 1.3)."""
    with path.open("rb") as file:
        header = file.read(32)
    page_bytes = int.from_bytes(header[16:18], "big")
    pages = int.from_bytes(header[28:32], "big")
    return path.stat().st_size < pages * (65536 if page_bytes == 1 else page_bytes)
