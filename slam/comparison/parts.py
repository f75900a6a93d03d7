"""Which runs a recording allows, so that they can be laid side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from datasets.errors import InputError
from datasets.options import ReadOptions
from datasets.recording import Calibration
from slam.config import Config
from slam.mapping.layers import SAME_HEIGHT_M

LIDAR_PART, CAMERA_PART, FUSED_PART = "lidar", "camera", "fused"
PAPER_PART, UNION_PART, BAYES_PART = "paper", "union", "bayes"


@dataclass(frozen=True, slots=True)
class Part:
    """One run of a comparison: its name is that of its folder.

    words : what takes part in it, for people.
    """

    name: str
    words: str
    reading: ReadOptions
    config: Config


def parts_of(
    calibration: Calibration,
    reading: ReadOptions,
    config: Config,
    where: str,
    extra: Sequence[str] = (),
) -> list[Part]:
    """The runs of a comparison, in the order in which they are done.

    calibration : of the recording. extra : PAPER_PART, UNION_PART or both, too.

    Raises InputError if a single sensor is all there is.
    """
    highest = _highest(calibration)
    lower = [name for name in sorted(calibration.lidars) if name not in highest]
    cameras = sorted(calibration.cameras)
    views = [*cameras, *(lower if config.second_lidar == "view" else [])]
    if not (highest and (cameras or lower)):
        alone = ", ".join(sorted(calibration.lidars) or cameras) or "nothing"
        raise InputError(
            f"there is nothing to compare: of sensors that could be fused it has {alone} alone",
            where=where,
            remedy="Compare a recording with a lidar and a depth camera, or with lidars at "
            "different heights; 'slam run' maps this one",
        )

    def part(name: str, words: str, sensors: str, fusion: str, wanted: ReadOptions) -> Part:
        changed = config.model_copy(update={"sensors": sensors, "fusion": fusion})
        return Part(name, words, wanted, changed)

    chosen = replace(reading, lidars=tuple(highest)) if lower else reading
    parts = [part(LIDAR_PART, ", ".join(highest), "lidar", "better", chosen)]
    if cameras:
        parts.append(part(CAMERA_PART, ", ".join(cameras), "camera", "better", reading))
    everything = ", ".join([*highest, *lower, *cameras])
    parts.append(part(FUSED_PART, everything, "fused", "better", reading))
    if views:
        for name in (PAPER_PART, UNION_PART):
            if name in extra:
                parts.append(part(name, f"{everything}, {name} mode", "fused", name, reading))
    return parts


def _highest(calibration: Calibration) -> list[str]:
    """The lidars that stand less than SAME_HEIGHT_M below the highest one."""
    heights = {name: float(each.T_base_lidar[2, 3]) for name, each in calibration.lidars.items()}
    top_m = max(heights.values(), default=0.0)
    return sorted(name for name, z_m in heights.items() if z_m > top_m - SAME_HEIGHT_M)
