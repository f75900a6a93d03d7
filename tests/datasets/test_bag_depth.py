"""Depth images come out of messages as they were put in, and garbage comes out as one error."""

from __future__ import annotations

import struct
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.bag_depth import BadImageError, depth_format, depth_m
from datasets.messages import Float32s
from tests.datasets.bag_factory import png

MM = np.array([[0, 1, 500, 65535], [1234, 0, 3999, 250], [8, 9, 10, 11]], dtype=np.uint16)
METRES = np.array([[0.5, np.nan, np.inf, -1.0], [0.0, 3.25, -np.inf, 1e-3]], dtype=np.float32)


def image(
    pixels: npt.NDArray[Any], encoding: str, *, order: str = "<", pad: int = 0
) -> SimpleNamespace:
    rows = pixels.astype(pixels.dtype.newbyteorder(order)).view(np.uint8)
    rows = np.pad(rows.reshape(pixels.shape[0], -1), ((0, 0), (0, pad)), constant_values=0xFF)
    return SimpleNamespace(
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=int(order == ">"),
        step=rows.shape[1],
        data=rows.ravel(),
    )


def compressed(data: bytes, form: str) -> SimpleNamespace:
    return SimpleNamespace(format=form, data=np.frombuffer(data, dtype=np.uint8))


def header(a: float = 0.0, b: float = 0.0) -> bytes:
    return struct.pack("<iff", 0, a, b)


def metres(mm: npt.NDArray[np.uint16]) -> Float32s:
    """The twin: millimetres by definition, in double precision."""
    return np.where(mm > 0, mm / 1000.0, np.nan).astype(np.float32)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("pad", [0, 1, 6])
def test_raw_images_of_both_byte_orders_with_padded_rows(order: str, pad: int) -> None:
    for encoding in ("16UC1", "mono16"):
        depth = depth_m(image(MM, encoding, order=order, pad=pad))
        assert depth.dtype == np.float32
        np.testing.assert_array_equal(depth, metres(MM))
    found = depth_m(image(METRES, "32FC1", order=order, pad=pad))
    wanted = [[0.5, np.nan, np.nan, np.nan], [np.nan, 3.25, np.nan, np.float32(1e-3)]]
    np.testing.assert_array_equal(found, wanted)


def test_the_image_is_not_a_view_of_the_bags_bytes() -> None:
    message = image(METRES, "32FC1")
    depth = depth_m(message)
    message.data[:] = 0
    assert depth[0, 0] == 0.5


@pytest.mark.parametrize(
    ("form", "prefix", "transport"),
    [
        ("16UC1; compressedDepth", header(), "compressedDepth"),
        ("16UC1; compressedDepth png", header(), "compressedDepth"),
        ("16UC1;compressedDepth", header(), "compressedDepth"),
        ("mono16; compressedDepth png", header(), "compressedDepth"),
        ("16UC1; png compressed ", b"", "png"),
        ("png", b"", "png"),
    ],
)
def test_millimetres_as_png(form: str, prefix: bytes, transport: str) -> None:
    message = compressed(prefix + png(MM), form)
    np.testing.assert_array_equal(depth_m(message), metres(MM))
    assert depth_format(message)[0] == transport
    assert depth_format(message)[2:] == (4, 3)


def quantised(depth: Float32s, depth_max_m: float, depth_z0_m: float) -> bytes:
    """32FC1 as the plugin's encoder writes it, from its description."""
    a = depth_z0_m * (depth_z0_m + 1.0)
    b = 1.0 - a / depth_max_m
    inverse = np.zeros(depth.shape, dtype=np.uint16)
    seen = np.isfinite(depth) & (depth > 0) & (depth < depth_max_m)
    inverse[seen] = (a / depth[seen] + b).astype(np.uint16)
    return header(a, b) + png(inverse)


def test_inverse_depth_comes_back_within_a_step_of_its_quantisation() -> None:
    depth = np.linspace(0.3, 12.0, 40, dtype=np.float32).reshape(4, 10)
    depth[1, 3], depth[2, 7] = np.nan, 0.0
    message = compressed(quantised(depth, 10.0, 100.0), "32FC1; compressedDepth")
    found = depth_m(message)
    seen = (depth > 0) & (depth < 10.0)
    np.testing.assert_array_equal(np.isnan(found), ~seen)
    a = 100.0 * 101.0
    assert (np.abs(found[seen] - depth[seen]) <= 1.05 * depth[seen] ** 2 / a + 1e-6).all()
    assert depth_format(message).encoding == "32FC1"


def changed(message: SimpleNamespace, **fields: object) -> SimpleNamespace:
    return SimpleNamespace(**(vars(message) | fields))


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (image(MM, "rgb8"), "encoding 'rgb8' is none"),
        (image(MM, "64FC1"), "encoding '64FC1' is none"),
        (changed(image(MM, "16UC1"), width=0), "no pixels"),
        (changed(image(MM, "16UC1"), step=7), "row step"),
        (changed(image(MM, "16UC1"), height=4), "shorter than its size"),
        (changed(image(MM, "16UC1"), height=2**32 - 1, width=2**30), "row step"),
        (compressed(header() + png(MM), "16UC1; compressedDepth rvl"), "rvl"),
        (compressed(png(MM), "8UC3; png compressed bgr8"), "8UC3"),
        (compressed(b"\xff\xd8\xff", "jpeg"), "jpeg"),
        (compressed(header() + png(MM)[:-30], "16UC1; compressedDepth"), "damaged"),
        (compressed(header()[:5], "32FC1; compressedDepth"), "damaged"),
        (compressed(header(np.nan) + png(MM), "32FC1; compressedDepth"), "header is damaged"),
        (compressed(header() + png(MM), "32FC1; compressedDepth"), "header is damaged"),
        (compressed(png(MM.astype(np.uint8)), "png"), "16 bits"),
    ],
)
def test_what_is_no_depth_image_says_why(message: SimpleNamespace, reason: str) -> None:
    with pytest.raises(BadImageError, match=reason):
        depth_m(message)


@pytest.mark.parametrize("place", range(0, len(png(MM)), 3))
def test_a_changed_byte_of_a_png_is_found_and_nothing_is_printed(
    place: int, capfd: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(png(MM))
    data[place] ^= 0x10
    with pytest.raises(BadImageError):
        depth_m(compressed(header() + bytes(data), "16UC1; compressedDepth"))
    assert capfd.readouterr() == ("", "")


FORMATS = ["16UC1; compressedDepth", "32FC1; compressedDepth png", "png", "16UC1; png", "", ";"]


def only_counted(message: SimpleNamespace) -> None:
    """Whatever it holds: a depth image of its size, or the one error."""
    with suppress(BadImageError):
        depth = depth_m(message)
        assert depth.dtype == np.float32
        assert (np.isnan(depth) | ((depth > 0) & (depth < np.inf))).all()
        assert depth.shape == depth_format(message)[2:][::-1]


@settings(deadline=None, max_examples=150)
@given(
    st.one_of(st.sampled_from(FORMATS), st.text(max_size=20)),
    st.one_of(
        st.binary(max_size=80),
        st.binary(max_size=60).map(lambda tail: header(1.0, 1.0) + png(MM)[:33] + tail),
        st.binary(max_size=12).map(lambda head: head + png(MM)),
    ),
)
def test_no_compressed_bytes_raise_anything_else(form: str, data: bytes) -> None:
    only_counted(compressed(data, form))


U32 = st.one_of(st.integers(0, 12), st.integers(0, 2**32 - 1))


@settings(deadline=None, max_examples=150)
@given(
    st.sampled_from(["16UC1", "32FC1", "mono16", "bgr8", ""]),
    U32, U32, U32, st.integers(0, 255), st.binary(max_size=200),
)  # fmt: skip
def test_no_raw_bytes_raise_anything_else(
    encoding: str, height: int, width: int, step: int, bigendian: int, data: bytes
) -> None:
    only_counted(
        SimpleNamespace(
            encoding=encoding,
            height=height,
            width=width,
            step=step,
            is_bigendian=bigendian,
            data=np.frombuffer(data, dtype=np.uint8),
        )
    )


@settings(deadline=None, max_examples=80)
@given(st.floats(width=32), st.floats(width=32), st.integers(0, 2**31 - 1))
def test_any_header_of_inverse_depth_gives_depths_or_the_error(a: float, b: float, n: int) -> None:
    only_counted(compressed(struct.pack("<iff", n, a, b) + png(MM), "32FC1; compressedDepth"))
