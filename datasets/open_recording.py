"""Opening a recording of any kind: what it is decides its content, not its name."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from datasets.bag_parts import magic
from datasets.bags import BagRecording
from datasets.carmen import CarmenRecording
from datasets.errors import InputError, reading
from datasets.options import ReadOptions
from datasets.recording import Recording

BAG_ENDINGS = (".bag", ".mcap", ".db3")
SNIFFED_BYTES = 1 << 16
TEXT_BYTES = bytes([*range(0x20, 0x7F), *b"\t\n\r"])

PACKED = {
    b"BZh": "bzip2",
    b"\xfd7zXZ": "xz",
    b"PK\x03\x04": "zip",
    b"\x28\xb5\x2f\xfd": "zstandard",
    b"7z\xbc\xaf": "7-Zip",
}
FOREIGN = {
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"%PDF": "a PDF document",
    b"\x89HDF": "an HDF5 file",
    b"\x7fELF": "a program",
    b"GIF8": "a GIF picture",
    b"P5": "a PGM picture",
}
WANTED = (
    "Give a CARMEN log (.log, .clf, also gzipped), a ROS 1 bag or a ROS 2 bag (folder or .mcap)"
)

Kind = Literal["bag", "carmen"]


def open_recording(paths: Sequence[Path], options: ReadOptions) -> Recording:
    """Open a recording: one file, one ROS 2 bag folder, or the parts of a split one.

    Raises InputError that names file and remedy if one is missing, empty, unreadable or of
    another kind, or if the parts are of different kinds. Whether there are scans in it only
    reading it shows.
    """
    if not paths:
        raise InputError("no recording is given", where="slam", remedy=WANTED)
    where = ", ".join(map(str, paths))
    with reading("the recording can't be read", where=where, remedy=WANTED):
        return _open(paths, options)


def _open(paths: Sequence[Path], options: ReadOptions) -> Recording:
    kinds = [_kind(path) for path in paths]
    if len(set(kinds)) > 1:
        raise InputError(
            "CARMEN logs and bags can't be parts of one recording",
            where=", ".join(map(str, paths)),
            remedy="Give files of one kind",
        )
    if kinds[0] == "bag":
        return BagRecording(paths, options)
    return CarmenRecording(paths, options)


def _kind(path: Path) -> Kind:
    try:
        if path.is_dir():
            return _kind_of_folder(path)
        if not path.exists():
            raise InputError("there is no such file", where=str(path), remedy="Check the path")
        if not path.is_file():
            raise InputError("neither a file nor a folder", where=str(path), remedy=WANTED)
        if path.stat().st_size == 0:
            raise InputError(
                "the file is empty",
                where=str(path),
                remedy="The recorder wrote nothing, or a copy failed: copy or record it again",
            )
        if magic(path) is not None or path.suffix.lower() in BAG_ENDINGS:
            return "bag"
        return _kind_of_text(path)
    except OSError as error:
        raise InputError(
            f"it can't be read ({error.strerror})", where=str(path), remedy="Check path and rights"
        ) from error


def _kind_of_folder(path: Path) -> Kind:
    inside = sorted(entry.name for entry in path.iterdir())
    if "metadata.yaml" in inside or any(Path(name).suffix in BAG_ENDINGS[1:] for name in inside):
        return "bag"
    recordings = [name for name in inside if name.endswith((".bag", ".log", ".clf", ".log.gz"))]
    raise InputError(
        "the folder is no ROS 2 bag: it holds neither metadata.yaml nor .mcap or .db3 files",
        where=str(path),
        remedy=f"Did you mean {path / recordings[0]}?" if recordings else WANTED,
    )


def _kind_of_text(path: Path) -> Kind:
    """A file without the mark of a bag: a CARMEN log if it is text, gzipped or not."""
    with path.open("rb") as file:
        start = file.read(SNIFFED_BYTES)
    if start.startswith(b"\x1f\x8b"):
        start = _unpacked_start(path)
        if start.startswith((b"#ROSBAG", b"SQLite format 3", b"\x89MCAP")):
            raise InputError(
                "a bag that is packed with gzip",
                where=str(path),
                remedy=f"Unpack it: gunzip {path}",
            )
    for mark, packer in PACKED.items():
        if start.startswith(mark):
            raise InputError(
                f"it is packed with {packer}",
                where=str(path),
                remedy="Unpack it, give what is in it",
            )
    for mark, name in FOREIGN.items():
        if start.startswith(mark):
            raise InputError(f"it is {name}, no recording", where=str(path), remedy=WANTED)
    if len(start.translate(None, TEXT_BYTES)) > 0.3 * len(start):
        raise InputError("a binary file of no known kind", where=str(path), remedy=WANTED)
    return "carmen"


def _unpacked_start(path: Path) -> bytes:
    """The first bytes in a gzipped file, as far as they can be had."""
    start = b""
    try:
        with gzip.open(path) as file:
            while len(start) < SNIFFED_BYTES and (line := file.readline(SNIFFED_BYTES)):
                start += line
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        if not start:
            raise InputError(
                f"nothing of it can be unpacked ({error})",
                where=str(path),
                remedy="Copy or download it again",
            ) from error
    return start
