"""All that the sensors of a run saw, compact: what its maps are drawn from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.trajectory import Stamps

BEAM: Final = 0
"""Role of a point that was hit by a ray, which frees the cells up to it: a lidar's beam;"""
SURFACE: Final = 1
"""of one that was hit and frees nothing: a camera sees it over, behind or above nearer things;"""
CLEAR: Final = 2
"""of the end of a ray that hit nothing there: so far the camera saw the bare floor;"""
VAGUE: Final = 3
"""of a SURFACE seen from too far to tell its cell: drawn where no surer one explains it."""

LIDAR: Final = "lidar"
"""The usual name of the layer of the lidars,"""
CAMERA: Final = "camera"
"""and that of the depth cameras, whose votes are remembered for so long only."""


@dataclass(frozen=True, slots=True)
class ScanStore:
    """All scans and views of a run: what the map can be drawn from without the recording.

    stamps_ns    : (N,) int64, not decreasing (two sensors may share a stamp).
    sensor_index : (N,) int64, which sensor took the scan: a row of all that is by sensor.
    offsets      : (N + 1,) int64; scan i owns rows offsets[i]:offsets[i + 1] of the points.
    points_base  : (M, 2) float32, m, in order of the beams, de-skewed, base frame of the scan's
                   stamp, finite.
    roles        : (M,) uint8, what each point is: BEAM, SURFACE, CLEAR or VAGUE.
    sensors      : (K names,) several sensors have several origins.
    layers       : (K names,) the layer of the map that each sensor's scans are drawn into.
    origins_base : (K, 2) float64, m, the sensors' places in the base frame.
    clear_from_m : (K,) float64, m, nearer than this a sensor's rays free nothing.

    Raises ValueError if shapes or dtypes disagree, a number is not finite or a role is unknown.
    """

    stamps_ns: Stamps
    sensor_index: npt.NDArray[np.int64]
    offsets: npt.NDArray[np.int64]
    points_base: npt.NDArray[np.float32]
    roles: npt.NDArray[np.uint8]
    sensors: tuple[str, ...]
    layers: tuple[str, ...]
    origins_base: Array
    clear_from_m: Array

    def __post_init__(self) -> None:
        n, m, k = self.stamps_ns.size, len(self.points_base), len(self.sensors)
        for name, dtype, shape in (
            ("stamps_ns", np.int64, (n,)),
            ("sensor_index", np.int64, (n,)),
            ("offsets", np.int64, (n + 1,)),
            ("points_base", np.float32, (m, 2)),
            ("roles", np.uint8, (m,)),
            ("origins_base", np.float64, (k, 2)),
            ("clear_from_m", np.float64, (k,)),
        ):
            array = getattr(self, name)
            if array.dtype != dtype or array.shape != shape:
                raise ValueError(f"{name} is {array.dtype} {array.shape}, not {dtype} {shape}")
        if len(self.layers) != k or not all(self.layers):
            raise ValueError(f"{len(self.layers)} names of layers for {k} sensors")
        steps = np.diff(self.offsets)
        if self.offsets[0] != 0 or self.offsets[-1] != m or (steps < 0).any():
            raise ValueError("offsets must rise from 0 to the number of points")
        if n and not 0 <= self.sensor_index.min() <= self.sensor_index.max() < k:
            raise ValueError("sensor_index names a sensor that is not there")
        if (np.diff(self.stamps_ns) < 0).any():
            raise ValueError("stamps_ns must not decrease")
        for name in ("points_base", "origins_base", "clear_from_m"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} must be finite")
        if self.roles.max(initial=0) > VAGUE:
            raise ValueError("roles are BEAM, SURFACE, CLEAR or VAGUE")

    def __len__(self) -> int:
        return int(self.stamps_ns.size)

    @property
    def layer_names(self) -> tuple[str, ...]:
        """The layers that have scans, in alphabetical order."""
        return tuple(sorted({self.layers[k] for k in np.unique(self.sensor_index)}))

    def of_layer(self, layer: str) -> ScanStore:
        """The scans of one layer's sensors; the sensors stay all. The same store if that is all."""
        wanted = np.array([name == layer for name in self.layers], dtype=bool)
        chosen = wanted[self.sensor_index]
        if chosen.all():
            return self
        counts = np.diff(self.offsets)
        rows = np.repeat(chosen, counts)
        return ScanStore(
            self.stamps_ns[chosen],
            self.sensor_index[chosen],
            _offsets(counts[chosen]),
            self.points_base[rows],
            self.roles[rows],
            self.sensors,
            self.layers,
            self.origins_base,
            self.clear_from_m,
        )

    def with_points(self, kept: npt.NDArray[np.bool_]) -> ScanStore:
        """All scans, with some of their points only. kept : (M,)."""
        before = np.concatenate([[0], np.cumsum(kept, dtype=np.int64)])
        return replace(
            self,
            offsets=before[self.offsets].astype(np.int64),
            points_base=self.points_base[kept],
            roles=self.roles[kept],
        )

    @classmethod
    def from_scans(
        cls,
        stamps_ns: Sequence[int],
        sensors: Sequence[str],
        points_base: Sequence[npt.NDArray[np.floating]],
        origins_base: Mapping[str, npt.ArrayLike],
        *,
        roles: Sequence[npt.NDArray[np.uint8]] | None = None,
        layers: Mapping[str, str] | None = None,
        clear_from_m: Mapping[str, float] | None = None,
    ) -> ScanStore:
        """One entry a scan: its stamp, its sensor, its (n, 2) points and their (n,) roles.

        By sensor: origins (2,), layers and clear_from_m. Without roles all points are BEAM,
        without a layer a sensor is one of LIDAR, without clear_from_m its rays free all the way.
        """
        names = tuple(sorted(origins_base))
        counts = np.array([len(points) for points in points_base], dtype=np.int64)
        flat = [np.asarray(points, np.float32).reshape(-1, 2) for points in points_base]
        layer_of, near_m = layers or {}, clear_from_m or {}
        if roles is None:
            all_roles = np.full(counts.sum(), BEAM, np.uint8)
        else:
            all_roles = np.concatenate([np.empty(0, np.uint8), *roles])
        return cls(
            stamps_ns=np.asarray(stamps_ns, np.int64),
            sensor_index=np.asarray([names.index(name) for name in sensors], np.int64),
            offsets=_offsets(counts),
            points_base=np.concatenate([np.empty((0, 2), np.float32), *flat]),
            roles=all_roles,
            sensors=names,
            layers=tuple(layer_of.get(name, LIDAR) for name in names),
            origins_base=np.array([origins_base[name] for name in names]).reshape(-1, 2) * 1.0,
            clear_from_m=np.array([near_m.get(name, 0.0) for name in names], np.float64),
        )


def _offsets(counts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Where each scan's points begin, and where the last one's end."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).astype(np.int64)
