"""``make fuzz``: spoil good inputs of every kind, read them, tell what no reader may do.

A fault is an exception other than InputError, an error that is not one printable line of sensible
length, more than ``HANG_S``, or more memory than ``MOST_MB`` above the start. Input number n of a
seed is the same in every process: what is told of a fault reproduces it.

    python -m tests.fuzz --seconds 600 --seed 7 --only bag --only log
    python -m tests.fuzz --seed 7 --index 1234
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Final

from datasets.errors import InputError
from tests.fuzz.mutations import spoil
from tests.fuzz.samples import Sample, samples
from tests.fuzz.targets import READERS

HANG_S: Final = 20.0
MOST_MB: Final = 1500
LONGEST_ERROR: Final = 1200
STORE: Final = Path("build/fuzz")


class HangError(BaseException):
    """Raised by the alarm; no reader may catch it."""


@dataclass(frozen=True)
class Fault:
    """signature : what is the same whenever the same place fails."""

    index: int
    sample: str
    signature: str
    detail: str


def choose(seed: int, index: int, kinds: Sequence[Sample]) -> tuple[Sample, bytes, int]:
    """Input number ``index`` of a seed: its sample, the spoilt file, and the way of reading."""
    random = Random(f"{seed} {index}")
    sample = random.choice(kinds)
    data = spoil(sample.spoilt, sample.files[sample.spoilt], sample.is_text, random)
    return sample, data, random.randrange(8)


def place(folder: Path, sample: Sample, data: bytes) -> Path:
    """Write an input. Returns the spoilt file."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, content in sample.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data if name == sample.spoilt else content)
    return folder / sample.spoilt


def attempt(sample: Sample, path: Path, way: int) -> tuple[str, str] | None:
    """Read an input. Returns signature and detail of a fault."""
    before_mb = _peak_mb()
    signal.setitimer(signal.ITIMER_REAL, HANG_S)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            READERS[sample.kind](path, way)
    except InputError as error:
        said = str(error)
        if not said.isprintable() or len(said) > LONGEST_ERROR:
            return "an error that is not one printable line", repr(said[:2000])
    except HangError:
        return f"hang in {_place()}", traceback.format_exc(limit=-12)
    except Exception as error:
        return f"{type(error).__name__} in {_place()}", traceback.format_exc(limit=-12)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    if _peak_mb() > max(before_mb, MOST_MB):
        return "memory", f"{_peak_mb():.0f} MB"
    return None


def _place() -> str:
    frames = traceback.extract_tb(sys.exc_info()[2])
    ours = [f for f in frames if "site-packages" not in f.filename and "/lib/" not in f.filename]
    last = (ours or frames)[-1]
    return f"{Path(last.filename).name}:{last.name}:{last.lineno}"


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _alarm(number: int, frame: FrameType | None) -> None:
    raise HangError


def _work(pipe: Connection, seed: int, first: int, only: Sequence[str]) -> None:
    """Try inputs from a number on, telling each before it is tried, and its fault after it."""
    signal.signal(signal.SIGALRM, _alarm)
    kinds = [s for s in samples() if not only or s.kind in only]
    with TemporaryDirectory() as scratch:
        index = first
        while True:
            sample, data, way = choose(seed, index, kinds)
            pipe.send((index, sample.name, None))
            path = place(Path(scratch) / "input", sample, data)
            found = attempt(sample, path, way)
            if found is not None:
                kept = STORE / f"seed{seed}-{index}"
                place(kept, sample, data)
                pipe.send((index, sample.name, found))
                if found[0] == "memory":  # the peak never falls: go on in a new process
                    return
            index += 1


def search(
    seed: int, seconds: float, only: Sequence[str], most: int
) -> tuple[Counter[str], list[Fault]]:
    """Try inputs for so long, or so many. Returns how many of each sample, and the faults."""
    tried: Counter[str] = Counter()
    faults: dict[str, Fault] = {}
    context = multiprocessing.get_context("fork")
    index, until = 0, time.monotonic() + seconds
    while time.monotonic() < until and index < most:
        ours, theirs = context.Pipe(duplex=False)
        worker = context.Process(target=_work, args=(theirs, seed, index, only), daemon=True)
        worker.start()
        theirs.close()
        name = ""
        try:
            while time.monotonic() < until and index < most:
                if not ours.poll(2 * HANG_S):
                    _add(faults, Fault(index, name, f"hang outside Python ({name})", ""))
                    break
                index, name, found = ours.recv()
                if found is None:
                    tried[name] += 1
                else:
                    _add(faults, Fault(index, name, *found))
        except EOFError:
            worker.join()
            if worker.exitcode:
                why = f"the process ended with {worker.exitcode} ({name})"
                _add(faults, Fault(index, name, why, ""))
        worker.kill()
        worker.join()
        index += 1
    return tried, list(faults.values())


def _add(faults: dict[str, Fault], fault: Fault) -> None:
    if fault.signature not in faults:
        faults[fault.signature] = fault
        print(f"FAULT {fault.sample}, --index {fault.index}: {fault.signature}", flush=True)
        print(fault.detail, flush=True)


def main() -> int:
    """0 if no fault was found."""
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--most", type=int, default=10**9, help="stop after so many inputs")
    parser.add_argument("--only", action="append", default=[], choices=sorted(READERS))
    parser.add_argument("--index", type=int, help="try this one alone, and show what it does")
    asked = parser.parse_args()
    if asked.index is not None:
        kinds = [s for s in samples() if not asked.only or s.kind in asked.only]
        sample, data, way = choose(asked.seed, asked.index, kinds)
        path = place(STORE / f"seed{asked.seed}-{asked.index}", sample, data)
        print(f"{sample.kind}: {path}, read in way {way}")
        READERS[sample.kind](path, way)
        return 0
    start = time.monotonic()
    tried, faults = search(asked.seed, asked.seconds, asked.only, asked.most)
    took_s = time.monotonic() - start
    for name, count in sorted(tried.items()):
        print(f"{count:9} {name}")
    total = sum(tried.values())
    print(f"{total} inputs, {total / took_s:.0f} a second, seed {asked.seed}; {len(faults)} faults")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
