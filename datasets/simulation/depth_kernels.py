"""Hot loops over the pixels of a simulated depth image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Float32s = npt.NDArray[np.float32]
Int32s = npt.NDArray[np.int32]

SAME_PLANE_PX = 0.004
"""Disparities this near to a neighbour's plane are of it: float32 rays leave some 0.001 px."""


class Pinhole(NamedTuple):
    """Intrinsics in pixels."""

    focal: float
    centre_u: float
    centre_v: float


class Effects(NamedTuple):
    """What ``degrade`` does; lengths and disparities in px, wave_from in m; see ``DepthModel``.

    edge : a pixel that is so far from its window's mean stands at an edge. zone : share of the
    window that must see a surface for it to be found, less one half. mixed : the more, the fewer
    holes at edges. per_px : of the window, by a line of pixels. speckle : above it the ragged field
    makes holes. least, most : disparities of the farthest and the nearest point.
    """

    noise: float
    quantum: float
    wave: float
    wave_from: float
    edge: float
    zone: float
    mixed: float
    band: float
    ragged: float
    per_px: float
    least_signal: float
    speckle: float
    least: float
    most: float


@njit(cache=True)
def pixel_rays(
    columns: Int32s, rows: Int32s, T_map_camera: npt.NDArray[np.float64], eye: Pinhole
) -> Float32s:  # pragma: no cover
    """Rays through pixels, (N, 6): origin and direction in the map frame, 1 long along the axis.

    So the distance along a ray is the depth z. columns, rows : (N,).
    """
    rays = np.empty((columns.size, 6), dtype=np.float32)
    T = T_map_camera.astype(np.float32)
    for i in range(columns.size):
        x = np.float32((columns[i] - eye.centre_u) / eye.focal)
        y = np.float32((rows[i] - eye.centre_v) / eye.focal)
        for k in range(3):
            rays[i, k] = T[k, 3]
            rays[i, 3 + k] = T[k, 0] * x + T[k, 1] * y + T[k, 2]
    return rays


@njit(cache=True)
def surface(
    rays: Float32s,
    depth_m: Float32s,
    normals: Float32s,
    materials: Int32s,
    reflectances: Float32s,
    focal_baseline: float,
) -> tuple[Float32s, Float32s]:  # pragma: no cover
    """Disparity in px, 0 where nothing was hit, and the signal: reflectance times cosine, (N,).

    reflectances : of each material, 0 for those that return nothing; O(N).
    """
    disparity = np.zeros(depth_m.size, dtype=np.float32)
    signal = np.zeros(depth_m.size, dtype=np.float32)
    scale = np.float32(focal_baseline)
    for i in range(depth_m.size):
        if materials[i] < 0:
            continue
        disparity[i] = scale / depth_m[i]
        dx, dy, dz = rays[i, 3], rays[i, 4], rays[i, 5]
        towards = abs(normals[i, 0] * dx + normals[i, 1] * dy + normals[i, 2] * dz)
        signal[i] = reflectances[materials[i]] * towards / np.sqrt(dx * dx + dy * dy + dz * dz)
    return disparity, signal


@njit(cache=True)
def fill_between(
    shape: tuple[int, int],
    rays: Float32s,
    normals: Float32s,
    materials: Int32s,
    disparity: Float32s,
    signal: Float32s,
) -> tuple[Float32s, Float32s, Int32s, Int32s]:  # pragma: no cover
    """From hits at every second pixel of every second row to all pixels, where these are sure.

    shape : (H, W), both even. The rest: (H/2 + 1) (W/2 + 1) of them, in rows, from pixel (0, 0).
    Between neighbours on one plane the disparity is their mean: it is linear on planes, exactly.
    Returns disparity and signal, (H, W), and columns and rows, (M,), of pixels to be cast yet;
    O(H W).
    """
    height, width = shape
    stride = width // 2 + 1
    full = np.empty((height, width), dtype=np.float32)
    strength = np.empty((height, width), dtype=np.float32)
    columns = np.empty(height * width, dtype=np.int32)
    rows = np.empty(height * width, dtype=np.int32)
    count = 0
    half, quarter = np.float32(0.5), np.float32(0.25)
    tolerance = np.float32(SAME_PLANE_PX)
    steps = (1, stride, stride + 1)
    alike = np.zeros(3, dtype=np.bool_)
    for v in range(0, height, 2):
        for u in range(0, width, 2):
            a = (v // 2) * stride + u // 2
            b, c, d = a + 1, a + stride, a + stride + 1
            full[v, u], strength[v, u] = disparity[a], signal[a]
            # On a plane n X = c the disparity is f B (n m) / c, m being the ray: that of a, carried
            # on to its neighbours. (A function of arrays would count references for each pixel.)
            material = materials[a]
            x, y, z = normals[a, 0], normals[a, 1], normals[a, 2]
            at_a = x * rays[a, 3] + y * rays[a, 4] + z * rays[a, 5]
            carried, allowed = disparity[a], tolerance * abs(at_a)
            for k in range(3):
                other = a + steps[k]
                at_other = x * rays[other, 3] + y * rays[other, 4] + z * rays[other, 5]
                off = abs(disparity[other] * at_a - carried * at_other)
                alike[k] = materials[other] == material and (material < 0 or off < allowed)
            with_b, with_c = alike[0], alike[1]
            if with_b:
                full[v, u + 1] = half * (disparity[a] + disparity[b])
                strength[v, u + 1] = half * (signal[a] + signal[b])
            else:
                columns[count], rows[count] = u + 1, v
                count += 1
            if with_c:
                full[v + 1, u] = half * (disparity[a] + disparity[c])
                strength[v + 1, u] = half * (signal[a] + signal[c])
            else:
                columns[count], rows[count] = u, v + 1
                count += 1
            if with_b and with_c and alike[2]:
                full[v + 1, u + 1] = half * (disparity[a] + disparity[d])
                strength[v + 1, u + 1] = quarter * (signal[a] + signal[b] + signal[c] + signal[d])
            else:
                columns[count], rows[count] = u + 1, v + 1
                count += 1
    return full, strength, columns[:count].copy(), rows[:count].copy()


@njit(cache=True)
def mark_hidden(
    disparity: Float32s, right: Float32s, hidden: npt.NDArray[np.bool_]
) -> None:  # pragma: no cover
    """Which pixels of a row the right imager does not see, as something nearer covers them; O(W).

    disparity, right, hidden : (W,); ``right`` is scratch: the largest disparity seen there.
    """
    width = disparity.size
    right[:] = 0.0
    for u in range(width):
        column = int(np.floor(u - disparity[u]))
        for k in range(max(column, 0), min(column + 2, width)):
            right[k] = max(right[k], disparity[u])
    for u in range(width):
        column = int(np.floor(u - disparity[u] + np.float32(0.5)))
        hidden[u] = column >= 0 and right[column] > disparity[u] + np.float32(1.0)


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def degrade(
    disparity: Float32s,
    nearest: Float32s,
    farthest: Float32s,
    smooth: Float32s,
    signal: Float32s,
    noise: Float32s,
    ragged: Float32s,
    waves: Float32s,
    focal_baseline: float,
    effects: Effects,
) -> Float32s:  # pragma: no cover
    """The depth image that a matcher of blocks makes of true disparities, in m, 0 for holes.

    All (H, W). disparity : true, px. nearest, farthest, smooth : the maximum, minimum and mean of
    it over the matcher's window. signal : mean over it. noise, ragged, waves : random fields of
    variance 1 with correlation lengths of their own. O(H W).
    """
    height, width = disparity.shape
    depth_m = np.zeros((height, width), dtype=np.float32)
    right = np.empty(width, dtype=np.float32)
    hidden = np.empty(width, dtype=np.bool_)
    one, half = np.float32(1.0), np.float32(0.5)
    scale = np.float32(focal_baseline)
    quantum, per_quantum = np.float32(effects.quantum), np.float32(1.0 / effects.quantum)
    sigma, wave, wave_from = (
        np.float32(effects.noise),
        np.float32(effects.wave),
        np.float32(effects.wave_from),
    )
    edge, zone = np.float32(effects.edge), np.float32(effects.zone)
    mixed, speckle = np.float32(effects.mixed), np.float32(effects.speckle)
    band, jitter = np.float32(effects.band), np.float32(effects.ragged)
    lean = np.float32(effects.ragged * effects.per_px)
    least_signal = np.float32(effects.least_signal)
    most, least = np.float32(effects.most), np.float32(effects.least)
    for v in range(height):
        mark_hidden(disparity[v], right, hidden)
        for u in range(width):
            here, wander = disparity[v, u], ragged[v, u]
            found = smooth[v, u]
            doubt = max(one + np.float32(0.3) * wander, np.float32(0.1))
            away_px = int(np.rint(jitter * wander))
            beside = min(max(u + away_px, 0), width - 1)
            below = min(max(v + away_px, 0), height - 1)
            if signal[below, beside] < least_signal * doubt or wander > speckle:
                continue
            if abs(here - found) > edge:
                near, far = nearest[v, u], farthest[v, u]
                jump = near - far
                share = (found - far) / jump
                shifted = share + lean * wander - half
                if shifted > zone:
                    found = here if here + here > near + far else near
                elif shifted < -zone:
                    found = far if here + here > near + far else here
                    if hidden[u]:
                        continue
                # A window on two surfaces mostly agrees with neither, the less the further apart.
                elif hidden[u] or abs(noise[v, u]) * jump > mixed:
                    continue
            elif hidden[beside] and abs(disparity[v, beside] - here) < one:
                continue
            if u < found + band + jitter * wander or found > most:
                continue
            rise = scale / max(found, least) / wave_from - one
            rise = min(max(rise, np.float32(0.0)), np.float32(1.5))
            found += sigma * noise[v, u] + wave * rise * waves[v, u]
            found = quantum * np.rint(found * per_quantum)
            if found >= least:
                depth_m[v, u] = scale / found
    return depth_m
