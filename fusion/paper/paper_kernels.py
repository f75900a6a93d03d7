"""The loop of the paper's pseudo-laser: the column minimum over a depth image's middle rows."""

from __future__ import annotations

import math

from numba import njit

from fusion.kernel_types import Float32s, Floats


@njit(cache=True)
def column_minimum(
    depth: Float32s,
    top: int,
    fx: float,
    fy: float,
    u0: float,
    v0: float,
    alpha: float,
    beta: float,
    sense: Floats,
    points: Floats,
) -> None:
    """The smallest r of the pixels in each of N parts of [alpha, beta] (paper, section 3.1).

    depth (H, W) float32, m; 0 or less, and NaN, are holes. top : row of the image that depth[0] is.
    sense (N,) out: r m, inf where there is none. points (N, 3) out: the pixel that it is of, m, in
    the camera's axes; untouched where there is none. Cost: H W.
    """
    parts = sense.size
    sense[:] = math.inf
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = float(depth[row, column])
            if not 0.0 < z < math.inf:
                continue
            x = (column - u0) / fx * z  # (1)
            theta = math.atan2(x, z)  # (2)
            r = math.sqrt(x * x + z * z)  # (3)
            n = int(math.floor(parts * (theta - alpha) / (beta - alpha)))  # (4)
            n = min(max(n, 0), parts - 1)  # the last border belongs to the last part
            if r < sense[n]:
                sense[n] = r
                points[n, 0] = x
                points[n, 1] = (top + row - v0) / fy * z
                points[n, 2] = z
