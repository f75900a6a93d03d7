"""The types that kernels take and give, and the liberties that their compiler has."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

FAST: Final = {"reassoc", "contract", "arcp", "nsz"}
"""Floating point may be reordered, but NaN and infinity keep their meaning."""

Floats = npt.NDArray[np.float64]
Float32s = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
