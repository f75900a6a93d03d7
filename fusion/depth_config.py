"""The knobs of the way from a depth image to a pseudo-laser scan."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from datasets.section import Section


class DepthConfig(Section):
    """Which pixels of a depth image are obstacles, and how good they are."""

    lower_m: float = Field(
        0.03,
        ge=0.005,
        le=1.0,
        description="height over the floor from which a thing is an obstacle; "
        "more where tilt and noise may lift the floor",
    )
    upper_m: float = Field(1.0, gt=0.0, le=3.0, description="height up to which it is one")
    max_range_m: float = Field(
        4.0, gt=0.3, le=20.0, description="horizontal; farther the camera isn't trusted"
    )
    tilt_error_rad: float = Field(
        0.009, ge=0.0, le=0.2, description="the camera may stand so much otherwise than it is said"
    )
    spacing_rad: float = Field(0.005, ge=0.001, le=0.05, description="of the bearings")
    support_height_m: float = Field(
        0.012, ge=0.002, le=0.3, description="a thing must stand out so high to be believed"
    )
    subpixel_px: float = Field(
        0.08, ge=0.01, le=1.0, description="rms noise of disparity; of depth z^2 subpixel / (f B)"
    )
    wave_px: float = Field(
        0.35, ge=0.0, le=2.0, description="rms of disparity's slow waves at 5 m, from 2.5 m on"
    )
    baseline_m: float = Field(
        0.05, gt=0.0, le=1.0, description="B, between the imagers of the stereo pair"
    )

    @model_validator(mode="after")
    def _gate_is_open(self) -> Self:
        if self.lower_m >= self.upper_m:
            raise ValueError(f"lower_m {self.lower_m} must be below upper_m {self.upper_m}")
        return self
