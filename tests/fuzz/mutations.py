"""Ways to spoil an input: bytes as disks and programs do, text as people and programs do.

All are drawn from one ``random.Random``: the same seed spoils alike.
"""

from __future__ import annotations

import gzip
import io
import re
import struct
import zlib
from collections.abc import Callable
from random import Random
from typing import Final

import numpy as np

MOST_BYTES: Final = 2_000_000

NUMBERS: Final = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "1e999999", "-1e999980", "1e-999999", "0",
    "-0", "-1", "4e9", "1e20", "2147483648", "-9223372036854775809", "18446744073709551616",
    "9" * 50, "9" * 5000, "1.5e5", "0x7fffffffffffffff", "1_0", "--1", "1e", "٣", "0.1.2",
)  # fmt: skip
WORDS: Final = (
    "", "a", "null", "~", "true", "[]", "{}", "2020-01-01", "2020-99-99", "!!binary aGk=",
    "a" * 3000, "\x1b[31mred\x07", "\u202e\u0000", "é\udcff", "../../etc/passwd", "<<", "*a", "&a",
    "!!python/x", "12:30:45", "%", "\t", '"', "[" * 500, "{a: " * 300, "- " * 300, "|", "'", "#",
    "---", "\n\n",
)  # fmt: skip
MERGES: Final = "\nz0: &z0 {x: 1}\n" + "".join(
    f"z{k}: &z{k} {{<<: [*z{k - 1}, *z{k - 1}]}}\n" for k in range(1, 30)
)
ALIASES: Final = "\nz0: &z0 [1]\n" + "".join(
    f"z{k}: &z{k} [*z{k - 1}, *z{k - 1}]\n" for k in range(1, 30)
)
INTS: Final = (0, 1, 2, 3, 4, 7, 8, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000,
               0xFFFFFFFF, 1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)  # fmt: skip
FLOATS: Final = (0.0, -0.0, -1.0, 1.0, float("nan"), float("inf"), -float("inf"), 3e38, -3e38,
                 1e-40, 1e30, 1e9, 1e308, -1e308, 1e-310, 57.3)  # fmt: skip

_TOKEN: Final = re.compile(rb"[^\s,:\[\]{}\"']+")
_NUMBER: Final = re.compile(rb"[-+]?\d[\w.+-]*")


def spoil(name: str, data: bytes, is_text: bool, random: Random) -> bytes:
    """Some of the data, changed by one to four mutations."""
    if name.endswith(".npz") and random.random() < 0.7:
        return _arrays(data, random)
    if name.endswith(".gz") and random.random() < 0.7:
        inner = spoil("", gzip.decompress(data), True, random)
        return gzip.compress(inner, compresslevel=1, mtime=0)
    for _ in range(random.choice((1, 1, 1, 2, 2, 3, 4))):
        # Text is spoilt as bytes, too, now and then.
        as_text = is_text and random.random() < 0.85
        data = random.choice(TEXT if as_text else BYTES)(data, random)[:MOST_BYTES]
    if name.endswith((".bag", ".mcap")) and random.random() < 0.5:
        data = _mended(data)
    return data


def _place(data: bytes, random: Random) -> int:
    return random.randrange(len(data) + 1)


def _flip(data: bytes, random: Random) -> bytes:
    out = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 8, 64))):
        if out:
            out[random.randrange(len(out))] ^= 1 << random.randrange(8)
    return bytes(out)


def _int(data: bytes, random: Random) -> bytes:
    size = random.choice((1, 2, 4, 8))
    value = random.choice(INTS) & ((1 << 8 * size) - 1)
    return _over(data, value.to_bytes(size, random.choice(("little", "little", "big"))), random)


def _float(data: bytes, random: Random) -> bytes:
    value = random.choice(FLOATS)
    if random.random() < 0.5:
        return _over(data, struct.pack("<d", value), random)
    with np.errstate(over="ignore"):
        return _over(data, np.float32(value).tobytes(), random)


def _over(data: bytes, patch: bytes, random: Random) -> bytes:
    at = _place(data, random)
    if random.random() < 0.5:
        at -= at % 4
    return (data[:at] + patch + data[at + len(patch) :])[: max(len(data), 1)]


def _word(data: bytes, random: Random) -> bytes:
    patch = random.choice(WORDS).encode("utf-8", "surrogateescape")
    return _over(data, patch[:200], random)


def _cut(data: bytes, random: Random) -> bytes:
    return data[: _place(data, random)]


def _delete(data: bytes, random: Random) -> bytes:
    at = _place(data, random)
    return data[:at] + data[at + random.choice((1, 4, 8, 30, 300, 3000)) :]


def _repeat(data: bytes, random: Random) -> bytes:
    at, size = _place(data, random), random.choice((1, 8, 60, 600, 6000))
    return data[:at] + data[at : at + size] * random.choice((2, 2, 3, 50)) + data[at + size :]


def _move(data: bytes, random: Random) -> bytes:
    at, to, size = _place(data, random), _place(data, random), random.choice((4, 40, 400, 4000))
    piece, rest = data[at : at + size], data[:at] + data[at + size :]
    return rest[:to] + piece + rest[to:]


def _zeros(data: bytes, random: Random) -> bytes:
    return _over(data, bytes([random.choice((0, 0xFF))]) * random.choice((4, 50, 500)), random)


def _copy(data: bytes, random: Random) -> bytes:
    at = _place(data, random)
    return _over(data, data[at : at + random.choice((4, 8, 64, 512))], random)


BYTES: Final[tuple[Callable[[bytes, Random], bytes], ...]] = (
    _flip, _int, _int, _float, _float, _word, _cut, _delete, _repeat, _move, _zeros, _copy,
)  # fmt: skip


def _token(data: bytes, random: Random) -> bytes:
    return _replace(_TOKEN, data, random, WORDS + NUMBERS)


def _number(data: bytes, random: Random) -> bytes:
    return _replace(_NUMBER, data, random, NUMBERS)


def _replace(
    pattern: re.Pattern[bytes], data: bytes, random: Random, words: tuple[str, ...]
) -> bytes:
    start = _place(data, random)
    found = pattern.search(data, start) or pattern.search(data)
    if found is None:
        return data
    word = random.choice(words).encode("utf-8", "surrogateescape")
    return data[: found.start()] + word + data[found.end() :]


def _swap_tokens(data: bytes, random: Random) -> bytes:
    found = list(_TOKEN.finditer(data))
    if len(found) < 2:
        return data
    a, b = sorted(random.sample(range(len(found)), 2))
    first, second = found[a], found[b]
    middle = data[first.end() : second.start()]
    return data[: first.start()] + second[0] + middle + first[0] + data[second.end() :]


def _lines(data: bytes, random: Random) -> bytes:
    lines = data.split(b"\n")
    at, to = random.randrange(len(lines)), random.randrange(len(lines))
    kind = random.randrange(5)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(to, lines[at])
    elif kind == 2:
        lines[at], lines[to] = lines[to], lines[at]
    elif kind == 3:
        lines[at : at + 1] = [lines[at]] * random.choice((2, 20, 400))
    else:
        lines[at] = b" " * random.choice((1, 2, 7)) + lines[at]
    return b"\n".join(lines)


def _add(data: bytes, random: Random) -> bytes:
    word = random.choice((*WORDS, *NUMBERS, MERGES, ALIASES)).encode("utf-8", "surrogateescape")
    at = _place(data, random) if random.random() < 0.5 else len(data)
    return data[:at] + word + data[at:]


TEXT: Final[tuple[Callable[[bytes, Random], bytes], ...]] = (
    _token, _token, _number, _number, _number, _swap_tokens, _lines, _lines, _add, _cut,
)  # fmt: skip


def _mended(data: bytes) -> bytes:
    """The checksums of MCAP chunks made right or left out, so that what is spoilt is looked at."""
    out, at = bytearray(data), 8
    while data.startswith(b"\x89MCAP") and at + 9 <= len(out):
        op, length = struct.unpack_from("<BQ", out, at)
        if op == 6 and at + 9 + 28 <= len(out):
            struct.pack_into("<I", out, at + 9 + 24, 0)
        at += 9 + length
    at = 0
    while (at := out.find(b"IHDR", at)) > 0 and at + 21 <= len(out):
        struct.pack_into(">I", out, at + 17, zlib.crc32(bytes(out[at : at + 17])))
        at += 21
    return bytes(out)


def _arrays(data: bytes, random: Random) -> bytes:
    """A run folder's arrays with other values, types and shapes."""
    with np.load(io.BytesIO(data), allow_pickle=False) as loaded:
        arrays = dict(loaded)
    for _ in range(random.choice((1, 1, 2))):
        name = random.choice(sorted(arrays))
        arrays[name] = _array(arrays[name], random)
        if random.random() < 0.1:
            del arrays[name]
    out = io.BytesIO()
    save = np.savez_compressed if random.random() < 0.2 else np.savez
    save(out, **arrays)
    return out.getvalue()


def _array(array: np.ndarray, random: Random) -> np.ndarray:  # type: ignore[type-arg]
    kind = random.randrange(6)
    if kind <= 2 and array.dtype.kind in "iuf" and array.size:
        changed = array.copy()
        values = FLOATS if array.dtype.kind == "f" else INTS
        at = random.randrange(array.size)
        with np.errstate(all="ignore"):
            changed.flat[at] = np.array(random.choice(values)).astype(array.dtype)
        return changed
    if kind == 3 and array.dtype.kind != "O":
        numbers = ("<f8", "<i4", "<u8", "U7", "?", "O", "<c16")
        kinds = ("U2", "O") if array.dtype.kind == "U" else numbers
        with np.errstate(all="ignore"):
            return array.astype(random.choice(kinds))
    if kind == 4:
        return array.reshape(-1)[: random.randrange(array.size + 1)]
    return random.choice((array[None], np.array(7), np.empty((0, 3)), np.array([{}], object)))
