"""The whole configuration: one section beside each part, put together here."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from backend.loop_search import LoopConfig
from backend.refine import RefineConfig
from datasets.errors import InputError
from datasets.section import Section
from datasets.yaml_file import MarkedYaml
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

    Raises InputError that names file and line or setting, key and remedy.
    """
    file: MarkedYaml | None = None
    tree: dict[str, Any] = {}
    within: tuple[str, ...] = ()
    if path is not None:
        file = MarkedYaml.read(path, "the configuration", "", "Give a YAML file")
        tree = file.content if file.content is not None else {}
        if not isinstance(tree, dict):
            raise InputError(
                "holds no keys",
                where=str(path),
                remedy="Write 'section:' and below it 'key: value' as 'slam config' prints them",
            )
        # a run folder's config.yaml states versions and the recording beside the configuration
        if isinstance(tree.get("config"), dict):
            tree, within = tree["config"], ("config",)
    said: dict[tuple[str, ...], str] = {}
    for setting in settings:
        said[_set(tree, setting)] = setting
    try:
        return Config.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        keys = first["loc"]
        words = {"extra_forbidden": "no such key", "model_type": "a section, its keys are needed"}
        what = f"{'.'.join(map(str, keys))}: {words.get(first['type'], first['msg'])}"
        remedy = "'slam config' prints every key with its default"
        guilty = [s for of, s in said.items() if of[: len(keys)] == keys or keys[: len(of)] == of]
        if file is None or guilty:
            where = f"--set {guilty[-1]}" if guilty else "the configuration"
            raise InputError(what, where=where, remedy=remedy) from None
        raise file.error((*within, *keys), what, remedy) from None


def _set(tree: dict[str, Any], setting: str) -> tuple[str, ...]:
    """Put a setting into the tree. Returns its keys."""
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
    try:
        branch[leaf] = MarkedYaml.parse(text, f"--set {setting}", "").content
    except InputError:
        raise InputError(
            f"'{text}' is not a value",
            where=f"--set {setting}",
            remedy="Write a number, true, false or a word",
        ) from None
    return (*parents, leaf)


def effective(config: Config) -> dict[str, Any]:
    """The configuration as plain data."""
    return config.model_dump(mode="json")


def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    return {name: version(name) for name in STATED}
