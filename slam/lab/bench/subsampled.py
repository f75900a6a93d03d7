"""A recording of which only every k-th scan is left."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np

from datasets.trajectory import Stamps
from datasets.tum import parse_stamp_ns

SCAN = "FLASER"


def write_every_kth_scan(source: Path, target: Path, every: int, offset: int) -> Stamps:
    """Write a log with the scans offset, offset + every, ... of ``source``, counted from 0.

    source : a CARMEN log, gzipped or not, whose lines are whole. target : a gzipped one. All lines
    but FLASER's are as they were. Returns the stamps of the scans that are left, ns.
    """
    opened = gzip.open if source.suffix == ".gz" else open
    stamps_ns, count = [], 0
    with (
        opened(source, "rt", encoding="ascii") as lines,
        gzip.open(target, "wt", encoding="ascii", compresslevel=6) as left,
    ):
        for line in lines:
            if line.startswith(f"{SCAN} "):
                count += 1
                if (count - 1) % every != offset:
                    continue
                stamps_ns.append(parse_stamp_ns(line.split()[-3]))
            left.write(line)
    return np.array(stamps_ns, dtype=np.int64)
