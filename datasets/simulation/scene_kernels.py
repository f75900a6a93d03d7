"""Hot loops over rays."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

Rays = npt.NDArray[np.float32]


@njit(cache=True)
def rays_near_spheres(
    rays: Rays, spheres: npt.NDArray[np.float32]
) -> npt.NDArray[np.int64]:  # pragma: no cover
    """Which rays come near enough to one of a few spheres to hit what is in it; O(N M).

    rays : (N, 6), origin and direction (any length); spheres : (M, 4), centre and radius.
    Returns indices, increasing. Starting in a sphere counts, leaving it behind not.
    """
    near = np.empty(rays.shape[0], dtype=np.int64)
    count = 0
    for i in range(rays.shape[0]):
        dx, dy, dz = rays[i, 3], rays[i, 4], rays[i, 5]
        length2 = dx * dx + dy * dy + dz * dz
        for j in range(spheres.shape[0]):
            x = spheres[j, 0] - rays[i, 0]
            y = spheres[j, 1] - rays[i, 1]
            z = spheres[j, 2] - rays[i, 2]
            radius2 = spheres[j, 3] * spheres[j, 3]
            along = x * dx + y * dy + z * dz
            beside2 = x * x + y * y + z * z
            if beside2 > radius2:
                if along <= 0.0:
                    continue
                if (beside2 - radius2) * length2 > along * along:
                    continue
            near[count] = i
            count += 1
            break
    return near[:count].copy()
