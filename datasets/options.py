"""What a person may choose about how a recording is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Choices that hold for every kind of recording; the defaults find everything by themselves.

    start_s, duration_s : the part to read, seconds from the first message; None reads to the end.
    lidars              : topics (bags) to take as lidars; empty takes all.
    use_lidars          : False leaves them out: the depth cameras alone are read.
    cameras             : topics (bags) to take as depth cameras; empty takes all.
    use_cameras         : False leaves them out (``--no-camera``).
    unmounted_cameras   : read cameras that nothing says the mounting of, too; their calibration
                          then has T_base_camera None. For whoever finds it out.
    odometry            : topic of odometry, or "tf", or None to find it.
    use_odometry        : False leaves odometry out (``--no-odometry``).
    ground_truth        : topic of ground truth, or None to find it.
    calibration         : a calibration YAML that supplies or overrides what the recording says.
    salvage             : read what is readable of a truncated or unindexed file.
    """

    start_s: float = 0.0
    duration_s: float | None = None
    lidars: tuple[str, ...] = ()
    use_lidars: bool = True
    cameras: tuple[str, ...] = ()
    use_cameras: bool = True
    unmounted_cameras: bool = False
    odometry: str | None = None
    use_odometry: bool = True
    ground_truth: str | None = None
    calibration: Path | None = None
    salvage: bool = False
