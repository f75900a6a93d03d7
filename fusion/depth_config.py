"""The knobs of the way from a depth image to a pseudo-laser scan."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from datasets.section import Section


class DepthConfig(Section):
    """Which pixels of a depth image are obstacles, and how good they are.

    lower_m, upper_m : heights over the floor between which a thing is an obstacle. The lower edge
                       rises with range, by what tilt and noise may lift the floor.
    max_range_m      : horizontal; farther the camera isn't trusted.
    tilt_error_rad   : by how much the camera may stand otherwise than the calibration says.
    spacing_rad      : of the bearings.
    support_height_m : how high a thing must stand out of the gate's lower edge to be believed.
    subpixel_px      : rms noise of the disparity; of depth it is z^2 subpixel / (f B).
    wave_px          : rms of the slow waves in the disparity at 5 m; they begin at 2.5 m.
    baseline_m       : B, between the imagers of the stereo pair.
    bilateral        : smooth the disparity before. It costs more than all the rest and gains some
                       3 % of the ranges' noise (docs/fusion.md), since a range is a mean anyway.
    """

    lower_m: float = Field(0.03, ge=0.005, le=1.0)
    upper_m: float = Field(1.0, gt=0.0, le=3.0)
    max_range_m: float = Field(4.0, gt=0.3, le=20.0)
    tilt_error_rad: float = Field(0.009, ge=0.0, le=0.2)
    spacing_rad: float = Field(0.005, ge=0.001, le=0.05)
    support_height_m: float = Field(0.012, ge=0.002, le=0.3)
    subpixel_px: float = Field(0.08, ge=0.01, le=1.0)
    wave_px: float = Field(0.35, ge=0.0, le=2.0)
    baseline_m: float = Field(0.05, gt=0.0, le=1.0)
    bilateral: bool = False

    @model_validator(mode="after")
    def _gate_is_open(self) -> Self:
        if self.lower_m >= self.upper_m:
            raise ValueError(f"lower_m {self.lower_m} must be below upper_m {self.upper_m}")
        return self
