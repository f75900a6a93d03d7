"""A recording three times as long: forward, reversed and forward again, in one CARMEN log."""

from __future__ import annotations

import gzip
from pathlib import Path

from datasets.carmen_lines import LASERS
from datasets.tum import format_stamp, parse_stamp_ns

STAMPED = {"ODOM", *LASERS}


def write_there_and_back(source: Path, target: Path) -> None:
    """Write what ``source`` holds forward, reversed and forward, stamps and odometry continued.

    source : a CARMEN log, gzipped or not, whose lines are whole. target : a gzipped one.

    Scans and odometry poses stay as recorded, so on the way back the robot backs along the same
    odometry; a stamp t becomes 2 t_end - t there and t + 2 (t_end - t_start) in the third part.
    The messages at the two turning points are not repeated.
    """
    opened = gzip.open if source.suffix == ".gz" else open
    with opened(source, "rt", encoding="ascii") as file:
        lines = [words for line in file if (words := line.split())]
    head = [words for words in lines if words[0] not in STAMPED]
    stamped = [(parse_stamp_ns(words[-3]), words) for words in lines if words[0] in STAMPED]
    start_ns, end_ns = (choose(stamp for stamp, _ in stamped) for choose in (min, max))

    def by_time(message: tuple[int, list[str]]) -> int:
        return message[0]

    # Sorting keeps lines of one stamp in their order, of which the reader believes the first.
    back = [
        (2 * end_ns - stamp, words)
        for stamp, words in sorted(stamped, key=by_time, reverse=True)
        if stamp < end_ns
    ]
    again = [
        (stamp + 2 * (end_ns - start_ns), words) for stamp, words in stamped if stamp > start_ns
    ]
    with gzip.open(target, "wt", encoding="ascii", compresslevel=6) as file:
        for words in head:
            file.write(" ".join(words) + "\n")
        for stamp, words in stamped + back + again:
            when = format_stamp(stamp)
            file.write(" ".join([*words[:-3], when, words[-2], when]) + "\n")
