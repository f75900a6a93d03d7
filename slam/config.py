"""The whole configuration: one section beside each part, put together here."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, ValidationError

from backend.loop_search import LoopConfig
from backend.refine import RefineConfig
from datasets.errors import InputError
from datasets.section import Section
from frontend.comparison.correlative_config import CorrelativeConfig
from frontend.comparison.pose_increment import PoseIncrementConfig
from frontend.kiss import KissConfig
from frontend.motion import MotionConfig
from frontend.nodes import NodeConfig
from frontend.tracker import TrackerConfig
from fusion.compensation import CompensationConfig
from fusion.depth_config import DepthConfig
from fusion.lidar_only import BeamLimits
from fusion.paper.mode import PaperConfig
from slam.mapping.occupancy import MapConfig

STATED = ("corridor-slam", "numpy", "numba", "gtsam", "scipy", "kiss-icp", "opencv-python-headless")


class Config(Section):
    """Every knob of a run; the defaults are one set for all recordings."""

    sensors: Literal["fused", "lidar", "camera"] = Field(
        "fused", description="which take part; fused: all there are; lidar: the highest alone"
    )
    fusion: Literal["better", "paper", "union"] = Field(
        "better", description="how: paper and union lay all into a single grid"
    )
    second_lidar: Literal["view", "scan"] = Field(
        "view",
        description="lidars lower than the highest: fused like a camera, or matched for themselves",
    )
    frontend: Literal["scan-matching", "kiss-icp", "pose-increment", "correlative"] = (
        "scan-matching"
    )
    odometry: bool = Field(True, description="False leaves odometry out")
    loops: bool = Field(True, description="False leaves loop closure and final passes out")
    beams: BeamLimits = BeamLimits()
    depth: DepthConfig = DepthConfig()
    compensation: CompensationConfig = CompensationConfig()
    paper: PaperConfig = PaperConfig()
    motion: MotionConfig = MotionConfig()
    tracker: TrackerConfig = TrackerConfig()
    kiss: KissConfig = KissConfig()
    pose_increment: PoseIncrementConfig = PoseIncrementConfig()
    correlative: CorrelativeConfig = CorrelativeConfig()
    nodes: NodeConfig = NodeConfig()
    loop_search: LoopConfig = LoopConfig()
    refine: RefineConfig = RefineConfig()
    map: MapConfig = MapConfig()


def load_config(path: Path | None, settings: Sequence[str] = ()) -> Config:
    """A configuration from a YAML file and ``section.key=value`` settings over it.

    Raises InputError that names file or setting, key and remedy.
    """
    tree: dict[str, Any] = {}
    where = "the configuration"
    if path is not None:
        where = str(path)
        tree = _read(path)
        # a run folder's config.yaml states versions and the recording beside the configuration
        if isinstance(tree.get("config"), dict):
            tree = tree["config"]
    for setting in settings:
        key, sign, text = setting.partition("=")
        if not sign or not key:
            raise InputError(
                f"'{setting}' is not of the form section.key=value",
                where="--set",
                remedy="Write it like --set map.resolution_m=0.025",
            )
        branch = tree
        *parents, leaf = key.split(".")
        for parent in parents:
            branch = branch.setdefault(parent, {})
            if not isinstance(branch, dict):
                raise InputError(
                    f"'{parent}' has no keys", where=f"--set {setting}", remedy="See 'slam config'"
                )
        branch[leaf] = _value(setting, text)
        where = f"{where}, --set {setting}" if path is None else where
    try:
        return Config.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        words = {"extra_forbidden": "no such key", "model_type": "a section, its keys are needed"}
        raise InputError(
            f"{key}: {words.get(first['type'], first['msg'])}",
            where=where,
            remedy="'slam config' prints every key with its default",
        ) from None


def effective(config: Config) -> dict[str, Any]:
    """The configuration as plain data."""
    return config.model_dump(mode="json")


def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    return {name: version(name) for name in STATED}


def _value(setting: str, text: str) -> object:
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError):  # ValueError: a date that there is not
        raise InputError(
            f"'{text}' is not a value",
            where=f"--set {setting}",
            remedy="Write a number, true, false or a word",
        ) from None


def _read(path: Path) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"can't be read ({error})", where=str(path), remedy="Give a YAML file"
        ) from None
    except (yaml.YAMLError, ValueError) as error:
        place = getattr(error, "problem_mark", None)
        line = f", line {place.line + 1}" if place else ""
        raise InputError(
            "is not valid YAML", where=f"{path}{line}", remedy="Correct the file"
        ) from None
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise InputError(
            "holds no keys",
            where=str(path),
            remedy="Write 'section:' and below it 'key: value' as 'slam config' prints them",
        )
    return tree
