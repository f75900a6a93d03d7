"""The systems that the tables compare: each is one configuration of this application."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from slam.config import Config, load_config


@dataclass(frozen=True, slots=True)
class System:
    """A row of the tables. settings : what differs from the default configuration."""

    name: str
    settings: tuple[str, ...] = ()

    def config(self) -> Config:
        """The whole configuration."""
        return load_config(None, self.settings)

    def but(self, *settings: str) -> System:
        """The same system under further settings, by the same name."""
        return System(self.name, (*self.settings, *settings))


LIDAR = System("Lidar", ("sensors=lidar",))
CAMERA = System("Camera", ("sensors=camera",))
CAMERA_PAPER = System("Camera, paper mode", ("sensors=camera", "fusion=paper"))
FUSED_PAPER = System("Lidar + Camera, paper mode", ("fusion=paper",))
FUSED = System("Lidar + Camera, better mode")
UNION = System("Lidar + Camera, union", ("fusion=union",))
POSE_INCREMENT = System("Paper [16]", ("sensors=lidar", "frontend=pose-increment"))
CORRELATIVE = System("Paper [17]", ("sensors=lidar", "frontend=correlative"))

BAYES = "Lidar + Camera, Bayes"
"""No system: the layers of ``FUSED``, put together in another way."""


def others_systems() -> tuple[System, ...]:
    """[16] and [17], those of them that this version has a front end for."""
    known = get_args(Config.model_fields["frontend"].annotation)
    rows = ((POSE_INCREMENT, "pose-increment"), (CORRELATIVE, "correlative"))
    return tuple(system for system, frontend in rows if frontend in known)


def every_system() -> tuple[System, ...]:
    """All that the tables compare."""
    alone = (LIDAR, CAMERA, CAMERA_PAPER)
    return (*alone, *others_systems(), FUSED_PAPER, FUSED, UNION)
