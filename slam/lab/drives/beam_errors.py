"""How far the ranges of single beams are from the truth (paper, table 3), over many scans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from datasets.messages import Array
from fusion.kernel_types import Bytes
from slam.evaluation.surfaces import Ints

BEAMS_DEG = tuple(range(0, 360, 36))
"""Of the table: counter-clockwise from backwards, so 180 deg is forward."""


class PlacedScan(Protocol):
    """What is asked of a scan: the one that fusion gives, or the one that is matched."""

    @property
    def origin_base(self) -> Array: ...
    @property
    def points_base(self) -> Array: ...
    @property
    def layer(self) -> Bytes: ...


@dataclass(frozen=True, slots=True)
class BeamErrors:
    """Errors of beams over scans; range minus truth. NaN where no scan has the beam.

    beams_deg   : (B,) as the table counts them. actual_m : (B,).
    mean_m, std_m : (B,) of the ranges of each beam. counts : (B,) scans that have it.
    mae_m, rmse_m : (S,) over the beams of each scan; of a scan with all beams missing NaN.
    missing     : readings that are not there and so in none of the errors.
    """

    beams_deg: Array
    actual_m: Array
    mean_m: Array
    std_m: Array
    counts: Ints
    mae_m: Array
    rmse_m: Array
    missing: int

    def __str__(self) -> str:
        mae_m, rmse_m = (each[np.isfinite(each)] for each in (self.mae_m, self.rmse_m))
        if not mae_m.size:
            return f"no beam in any of {self.mae_m.size} scans"
        return (
            f"MAE {mae_m.mean():.4f} +- {mae_m.std():.4f} m, RMSE {rmse_m.mean():.4f} +- "
            f"{rmse_m.std():.4f} m; n = {mae_m.size} scans of {self.actual_m.size} beams, "
            f"{self.missing} readings missing"
        )


def bearings_of(beams_deg: Array) -> Array:
    """Bearings in the base frame, rad, of beams as the table counts them."""
    bearings: Array = np.radians(np.asarray(beams_deg, dtype=np.float64) - 180.0)
    return bearings


def ranges_at(scan: PlacedScan, bearings_rad: Array, half_width_rad: float) -> Array:
    """(B,) m from the scan's sensor, in given directions of the base frame; NaN without a point.

    The median of the points within ``half_width_rad`` of each bearing; where both layers have
    some, the nearer of their medians, as the paper's single scan keeps the nearer one.
    """
    offset = scan.points_base - scan.origin_base
    bearing, range_m = np.arctan2(offset[:, 1], offset[:, 0]), np.hypot(*offset.T)
    apart = np.abs(np.angle(np.exp(1j * (bearing - bearings_rad[:, None]))))
    out = np.full(bearings_rad.size, np.inf)
    for layer in np.unique(scan.layer).tolist():
        for k, near in enumerate((apart <= half_width_rad) & (scan.layer == layer)):
            if near.any():
                out[k] = min(out[k], float(np.median(range_m[near])))
    out[np.isinf(out)] = np.nan
    return out


def beam_errors(ranges_m: Array, actual_m: Array, beams_deg: Array) -> BeamErrors:
    """Errors of readings (S, B) against (B,).

    NaN and inf are readings that are missing. MAE = mean |e| and RMSE = sqrt(mean e^2) over the
    beams of each scan, as the table has them for its one scan.
    Raises ValueError if shapes disagree or a true range is not finite and positive.
    """
    actual_m = np.asarray(actual_m, dtype=np.float64)
    beams_deg = np.asarray(beams_deg, dtype=np.float64)
    if ranges_m.ndim != 2 or ranges_m.shape[1:] != actual_m.shape or actual_m.ndim != 1:
        raise ValueError(f"ranges {ranges_m.shape} for {actual_m.shape} beams")
    if beams_deg.shape != actual_m.shape:
        raise ValueError(f"directions {beams_deg.shape} for {actual_m.shape} beams")
    if not (np.isfinite(actual_m) & (actual_m > 0.0)).all():
        raise ValueError("true ranges must be finite and positive")
    known = np.isfinite(ranges_m)
    error_m = np.where(known, ranges_m - actual_m, 0.0)
    per_beam, per_scan = known.sum(axis=0), known.sum(axis=1)
    mean_error_m = _ratio(error_m.sum(axis=0), per_beam)
    deviation = np.where(known, error_m - mean_error_m, 0.0)
    return BeamErrors(
        beams_deg=beams_deg,
        actual_m=actual_m,
        mean_m=actual_m + mean_error_m,
        std_m=np.sqrt(_ratio((deviation**2).sum(axis=0), per_beam)),
        counts=per_beam.astype(np.int64),
        mae_m=_ratio(np.abs(error_m).sum(axis=1), per_scan),
        rmse_m=np.sqrt(_ratio((error_m**2).sum(axis=1), per_scan)),
        missing=int((~known).sum()),
    )


def _ratio(total: Array, count: Ints) -> Array:
    out = np.full(total.shape, np.nan)
    np.divide(total, count, out=out, where=count > 0)
    return out
