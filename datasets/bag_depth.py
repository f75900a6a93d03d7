"""Depth images as ROS messages hold them, in metres: raw, as PNG, or by compressedDepth.

What the encodings mean: REP 118 (16UC1 is mm, 0 a hole; 32FC1 is m, NaN a hole). compressedDepth
(of image_transport_plugins) puts 12 bytes before a PNG, an int32 and the floats A and B; 32FC1 is
stored by it as inverse depth in 16 bits, ``A / depth + B``, 0 for a hole.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from datasets.bag_messages import RosMessage
from datasets.messages import Float32s

IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE: Final = "sensor_msgs/msg/CompressedImage"

_DEPTH_TYPES: Final = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
ENCODINGS: Final = tuple(_DEPTH_TYPES)

_PNG_MAGIC: Final = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES: Final = 12
_MM_IN_M: Final = np.float32(1000.0)

MOST_PIXELS: Final = 10_000_000
"""No depth camera has so many; a damaged header, or a small PNG, may claim far more."""
_TOO_MANY: Final = f"it claims more than {MOST_PIXELS // 1_000_000} million pixels: it is damaged"


class BadImageError(Exception):
    """Why a message holds no depth image, in the words of the report."""


class DepthFormat(NamedTuple):
    """How a message holds its depth image. transport : "raw", "compressedDepth" or "png"."""

    transport: str
    encoding: str
    width_px: int
    height_px: int


def depth_format(message: RosMessage) -> DepthFormat:
    """What kind of depth image a (sensor_msgs) Image or CompressedImage is, by its first bytes.

    Raises BadImageError if it is none, or of a kind that is not known.
    """
    if not hasattr(message, "format"):
        if message.encoding not in _DEPTH_TYPES:
            raise BadImageError(_unknown(f"encoding {message.encoding!r}"))
        return DepthFormat("raw", message.encoding, int(message.width), int(message.height))
    encoding, transport, _, png = _unpacked(message)
    return DepthFormat(transport, encoding, *_png_size(png))


def depth_m(message: RosMessage) -> Float32s:
    """The depth image in a (sensor_msgs) Image or CompressedImage: (H, W), m, NaN for holes.

    Raises BadImageError, and nothing else, whatever the message holds.
    """
    if not hasattr(message, "format"):
        return _metres(_raw_pixels(message))
    encoding, _, header, png = _unpacked(message)
    pixels = _png_pixels(png)
    if encoding != "32FC1":
        return _metres(pixels)
    _, a, b = struct.unpack("<iff", header)
    if not (math.isfinite(a) and math.isfinite(b) and a > 0.0):
        raise BadImageError("its compressedDepth header is damaged")
    inverse = pixels.astype(np.float32) - np.float32(b)
    with np.errstate(divide="ignore", over="ignore"):
        depth = np.float32(a) / inverse
    depth[pixels == 0] = np.nan
    return _metres(depth)


def _metres(pixels: npt.NDArray[np.uint16] | Float32s) -> Float32s:
    """Millimetres or metres as they come, as positive metres or NaN; an array of its own."""
    if pixels.dtype.kind == "u":
        depth = np.divide(pixels, _MM_IN_M, dtype=np.float32)
        np.copyto(depth, np.nan, where=pixels == 0)
        return depth
    with np.errstate(invalid="ignore"):  # damaged bytes may be signalling NaNs
        depth = pixels.astype(np.float32)
        np.copyto(depth, np.nan, where=~((depth > 0.0) & (depth < np.inf)))
    return depth


def _raw_pixels(message: RosMessage) -> npt.NDArray[np.uint16] | Float32s:
    """The pixels of an Image: rows of ``step`` bytes, which may be longer than the row is."""
    if message.encoding not in _DEPTH_TYPES:
        raise BadImageError(_unknown(f"encoding {message.encoding!r}"))
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(order + _DEPTH_TYPES[message.encoding])
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * dtype.itemsize
    if not height or not width:
        raise BadImageError("it has no pixels")
    if step < row_bytes:
        raise BadImageError("its row step is shorter than its rows")
    if message.data.size < height * step:
        raise BadImageError("its data are shorter than its size says")
    if height * width > MOST_PIXELS:
        raise BadImageError(_TOO_MANY)
    rows = message.data[: height * step].reshape(height, step)[:, :row_bytes]
    pixels: npt.NDArray[np.uint16] | Float32s = np.ascontiguousarray(rows).view(dtype)
    return pixels


def _unpacked(message: RosMessage) -> tuple[str, str, bytes, bytes]:
    """Encoding, transport, header ("" without) and PNG of a CompressedImage.

    Its format is "ENCODING; TRANSPORT ...", or "png" where somebody wrote it by hand.
    """
    encoding, semicolon, rest = (part.strip() for part in message.format.partition(";"))
    data = bytes(message.data)
    if "compressedDepth" in message.format:
        if encoding not in _DEPTH_TYPES or "rvl" in rest.lower():
            raise BadImageError(_unknown(f"format {message.format!r}"))
        return encoding, "compressedDepth", data[:_HEADER_BYTES], data[_HEADER_BYTES:]
    if (semicolon and encoding not in ("16UC1", "mono16")) or not data.startswith(_PNG_MAGIC):
        raise BadImageError(_unknown(f"format {message.format!r}"))
    return encoding if semicolon else "16UC1", "png", b"", data


def _unknown(what: str) -> str:
    known = ", ".join(ENCODINGS)
    return f"its {what} is none of a depth image (known are {known}, raw or as PNG)"


def _png_size(png: bytes) -> tuple[int, int]:
    """Width and height by the header of a PNG of one channel of 16 bits."""
    if not png.startswith(_PNG_MAGIC) or png[12:16] != b"IHDR" or len(png) < 33:
        raise BadImageError("its PNG is damaged")
    width, height, bits, colour, *methods = struct.unpack_from(">IIBBBBB", png, 16)
    if (bits, colour) != (16, 0):
        raise BadImageError("its PNG has not one channel of 16 bits")
    if width * height > MOST_PIXELS:
        raise BadImageError(_TOO_MANY)
    if not width * height or tuple(methods) not in ((0, 0, 0), (0, 0, 1)):
        raise BadImageError("its PNG is damaged")
    return width, height


def _png_pixels(png: bytes) -> npt.NDArray[np.uint16]:
    import cv2  # noqa: PLC0415

    width, height = _png_size(png)
    # OpenCV would print what libpng says of a damaged one.
    pixels = None
    if _is_whole(png):
        pixels = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.shape != (height, width) or pixels.dtype != np.uint16:
        raise BadImageError("its PNG is damaged")
    return pixels  # type: ignore[return-value]  # its dtype was looked at


def _is_whole(png: bytes) -> bool:
    """Whether all chunks of a PNG are there, as their checksums say."""
    view, at = memoryview(png), len(_PNG_MAGIC)
    while at + 12 <= len(png):
        (length,) = struct.unpack_from(">I", png, at)
        end = at + 12 + length
        if end > len(png) or zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(
            view[end - 4 : end]
        ):
            return False
        if png[at + 4 : at + 8] == b"IEND":
            return True
        at = end
    return False
