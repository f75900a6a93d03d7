"""The types that kernels take and give, and the liberties that their compiler has."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FAST = {"reassoc", "contract", "arcp", "nsz"}
"""Floating point may be reordered, but NaN and infinity keep their meaning."""

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Links = npt.NDArray[np.int32]
Bytes = npt.NDArray[np.uint8]

Cloud = tuple[Floats, Floats, Floats]
"""Points (N, 2), their normals (N, 2; zero: none), and weights (N,) relative to a lidar's point."""
Surface = tuple[Floats, Floats, Floats, Links, Links]
"""Map points, their normals and weights, and the linked lists: following by point, head by cell."""
