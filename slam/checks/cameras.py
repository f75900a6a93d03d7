"""One depth camera of a recording: what ``slam check`` measures and finds in it."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from datasets.calibration_file import T_BODY_OPTICAL
from datasets.messages import Array, DepthImage
from slam.checks.streams import (
    FEW_SCANS,
    LONG_GAP_INTERVALS,
    LONG_GAP_S,
    Finding,
    ImageReport,
    StreamReport,
    distance_s,
    timing,
    timing_findings,
    xyz_rpy_deg,
)

MOST_HOLES = 0.7
STEEPEST_DEG = 45.0
"""A camera for obstacles looks ahead; one that is turned further is more likely mounted wrongly."""

SCAN_REACH_S = 1.0
"""An image further than this from any scan belongs to none."""


@dataclass(slots=True)
class CameraCheck:
    """Takes the images of one depth camera, one by one."""

    name: str
    T_base_camera: Array
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    width_px: int = 0
    height_px: int = 0
    pixels: int = 0
    holes: int = 0

    def add(self, image: DepthImage) -> None:
        self.stamps_ns.append(image.stamp_ns)
        self.height_px, self.width_px = image.depth_m.shape
        self.pixels += image.depth_m.size
        self.holes += int(np.count_nonzero(np.isnan(image.depth_m)))

    @property
    def blind(self) -> bool:
        """Whether not one pixel measured anything."""
        return self.holes == self.pixels

    def report(self) -> StreamReport:
        images = ImageReport(
            width_px=self.width_px,
            height_px=self.height_px,
            hole_share=self.holes / self.pixels,
            mounting_m_deg=xyz_rpy_deg(self.T_base_camera @ T_BODY_OPTICAL.T),
        )
        return StreamReport(
            f"images of {self.name}", len(self.stamps_ns), *timing(self.stamps_ns), images=images
        )

    def findings(self, scans_ns: npt.NDArray[np.int64]) -> list[Finding]:
        """scans_ns : the sorted stamps of all lidars' scans."""
        report = self.report()
        found = timing_findings(report)
        if report.count < FEW_SCANS:
            found.append(
                Finding("warning", f"only {report.count} {report.name}", "Record for longer")
            )
        if self.blind:
            remedy = "Check that it is not covered, and its encoding"
            found.append(
                Finding("warning", f"not one pixel of the {report.name} measured anything", remedy)
            )
        elif self.holes > MOST_HOLES * self.pixels:
            found.append(
                Finding(
                    "warning",
                    f"{self.holes / self.pixels:.0%} of the pixels of {self.name} are holes",
                    "Look for something before its lens, sunlight, or surfaces too near to it",
                )
            )
        up_deg = float(np.degrees(np.arcsin(np.clip(self.T_base_camera[2, 2], -1.0, 1.0))))
        if abs(up_deg) > STEEPEST_DEG:
            found.append(
                Finding(
                    "warning",
                    f"{self.name} looks {abs(up_deg):.0f} deg {'up' if up_deg > 0 else 'down'}",
                    "If it does not, its frame is no optical one: give its mounting with "
                    "--calibration",
                )
            )
        return found + self._against(scans_ns, report)

    def _against(self, scans_ns: npt.NDArray[np.int64], report: StreamReport) -> list[Finding]:
        """What the times of the scans say about those of the images."""
        if not scans_ns.size:
            return []
        found = []
        stamps_ns = np.frombuffer(self.stamps_ns, dtype=np.int64)
        longest_s = max(LONG_GAP_S, LONG_GAP_INTERVALS / max(report.rate_hz, 1e-9))
        early_s = float(scans_ns[-1] - stamps_ns[-1]) * 1e-9
        late_s = float(stamps_ns[0] - scans_ns[0]) * 1e-9
        for apart_s, what in ((early_s, "end {} s before"), (late_s, "begin {} s after")):
            if stamps_ns.size > 1 and apart_s > longest_s:
                found.append(
                    Finding(
                        "warning",
                        f"the {report.name} {what.format(f'{apart_s:.1f}')} the scans",
                        "That part is mapped by the lidar alone; look for what stopped the camera, "
                        "or for its clock",
                    )
                )
        lost = int(np.count_nonzero(distance_s(stamps_ns, scans_ns) > SCAN_REACH_S))
        if lost:
            found.append(
                Finding(
                    "warning",
                    f"{lost} of {stamps_ns.size} images of {self.name} are more than "
                    f"{SCAN_REACH_S:g} s away from any scan",
                    "If the clocks differ by a constant, give clock_offset_s in --calibration",
                )
            )
        return found
