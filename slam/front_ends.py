"""Which front end a configuration asks for."""

from __future__ import annotations

from frontend.comparison.pose_increment import PoseIncrementTracker
from frontend.tracker import ScanMatchingTracker, Tracker
from slam.config import Config


def tracker_of(config: Config) -> Tracker:
    """The tracker that ``config.frontend`` names."""
    if config.frontend == "kiss-icp":
        from frontend.kiss import KissTracker  # noqa: PLC0415

        return KissTracker(config.kiss)
    if config.frontend == "pose-increment":
        return PoseIncrementTracker(config.pose_increment, config.tracker)
    if config.frontend == "correlative":
        from frontend.comparison.correlative import FieldAlignment  # noqa: PLC0415

        align = FieldAlignment(config.correlative)
        return ScanMatchingTracker(config.tracker, align, config.correlative.penalty)
    return ScanMatchingTracker(config.tracker)
