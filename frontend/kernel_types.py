"""The types that the kernels of the front end take and give."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fusion.kernel_types import FAST, Bytes, Floats, Ints

__all__ = ["FAST", "Bytes", "Cloud", "Floats", "Ints", "Links", "Surface"]

Links = npt.NDArray[np.int32]

Cloud = tuple[Floats, Floats, Floats]
"""Points (N, 2), their normals (N, 2; zero: none), and weights (N,) relative to a lidar's point."""
Surface = tuple[Floats, Floats, Floats, Links, Links]
"""Map points, their normals and weights, and the linked lists: following by point, head by cell."""
