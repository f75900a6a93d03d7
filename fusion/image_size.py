"""A depth image must be of the size that its camera's intrinsics are for."""

from __future__ import annotations

from datasets.messages import DepthImage


def require_size(image: DepthImage, size_px: tuple[int, int]) -> None:
    """Raise ValueError, in words for the report, if it isn't. size_px : (height, width)."""
    height_px, width_px = image.depth_m.shape
    if (height_px, width_px) != size_px:
        raise ValueError(
            f"the depth image has {width_px} x {height_px} pixels, "
            f"its intrinsics are for {size_px[1]} x {size_px[0]}"
        )
