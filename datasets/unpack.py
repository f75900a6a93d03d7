"""Unpacking what stands compressed in a recording, with bounds on what may come of it.

A few kilobytes of bzip2 or zstandard can stand for gigabytes. What a file may unpack to is bounded
by its own size, for each reading of it from the beginning.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, TypeVar

T = TypeVar("T")

ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"

MOST_BLOCK_BYTES: Final = 256 << 20
"""Writers make chunks of a few megabytes; one is held in memory as a whole."""
SMALL_FILE_BYTES: Final = 1 << 20
SPARE_BYTES: Final = 128 << 20
MOST_RATIO: Final = 1000
"""A small file may unpack to so many bytes, a larger one to so many times what it is larger by:
what scans hold shrinks by 2 to 10, but images of nothing by hundreds."""
SPARE_RECORDS: Final = 50_000
BYTES_A_RECORD: Final = 4
"""So many records may be in what is unpacked, and one more for so many bytes of the file."""

_STEP_BYTES: Final = 1 << 20


class DamagedError(Exception):
    """What in a file can't be read, in the words of the report."""


class Allowance:
    """What may still be unpacked of a file in one reading of it."""

    def __init__(
        self, file_bytes: int, spare_bytes: int = SPARE_BYTES, ratio: int = MOST_RATIO
    ) -> None:
        self.bytes = spare_bytes + ratio * max(0, file_bytes - SMALL_FILE_BYTES)
        self._records = SPARE_RECORDS + file_bytes // BYTES_A_RECORD

    def take(self, count: int) -> None:
        """Raises DamagedError if more is unpacked than the file can hold."""
        self.bytes -= count
        if self.bytes < 0:
            raise DamagedError("its compressed data unpack to far more than it can hold")

    def counting(self, records: Iterable[T]) -> Iterator[T]:
        """The records of a block, counted. Raises DamagedError if there are too many."""
        for record in records:
            self._records -= 1
            if self._records < 0:
                raise DamagedError("it holds far more records than its size allows")
            yield record


def unpack(compression: str, data: bytes, declared: int | None, allowance: Allowance) -> bytes:
    """The bytes of a compressed block, of its declared size where there is one.

    Raises DamagedError if they are not all there, or are more than declared or allowed.
    """
    out, fault = unpack_part(compression, data, declared, allowance)
    if fault is not None:
        raise DamagedError(fault)
    return out


def unpack_part(
    compression: str, data: bytes, declared: int | None, allowance: Allowance
) -> tuple[bytes, str | None]:
    """What a compressed block yields up to where it breaks off, and what is wrong with it."""
    if compression in ("", "none"):
        return data, None
    decompressor = _decompressor(compression)
    if decompressor is None:
        return b"", f"compression {compression!r} is not known"
    most = MOST_BLOCK_BYTES if declared is None else min(declared, MOST_BLOCK_BYTES)
    out = bytearray()
    fault = None
    try:
        at = 0
        while len(out) <= most:
            if decompressor.eof:  # another frame may follow
                data, at = (decompressor.unused_data or b"") + data[at:], 0
                if not data:
                    break
                decompressor = _decompressor(compression)
            piece = b""
            if decompressor.needs_input:
                if at >= len(data):
                    break
                piece = data[at : at + 4096]  # so that a damaged one yields what it can
                at += len(piece)
            new = decompressor.decompress(piece, max_length=_STEP_BYTES)
            allowance.take(len(new))
            out += new
    except DamagedError as error:
        return b"", str(error)
    except Exception:  # each library has errors of its own, and what came before is good
        fault = "its compressed data is damaged"
    if len(out) > most:
        return b"", "its compressed data unpack to more than is declared"
    if fault is None and (not decompressor.eof or (declared is not None and len(out) < declared)):
        fault = "its compressed data is damaged"
    return bytes(out), fault


def _decompressor(compression: str) -> Any:  # noqa: ANN401 - the libraries share no base class
    if compression == "bz2":
        import bz2  # noqa: PLC0415

        return bz2.BZ2Decompressor()
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped] # noqa: PLC0415

        return LZ4FrameDecompressor()
    if compression == "zstd":
        from backports.zstd import ZstdDecompressor  # noqa: PLC0415

        return ZstdDecompressor()
    return None


def unpack_file(path: Path, target: Path) -> None:
    """Write what a zstandard file unpacks to. Raises DamagedError, OSError."""
    from backports.zstd import ZstdError, ZstdFile  # noqa: PLC0415

    allowance = Allowance(path.stat().st_size)
    with target.open("wb") as out:
        try:
            with ZstdFile(path) as packed:
                while piece := packed.read(_STEP_BYTES):
                    allowance.take(len(piece))
                    out.write(piece)
        except (ZstdError, EOFError) as error:
            raise DamagedError("its compressed data is damaged") from error
