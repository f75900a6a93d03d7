"""Steps of the drive that nothing shows the length of, neither scans nor odometry nor closures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from backend.graph_arrays import ConstraintArrays
from backend.graph_covariance import relative_covariances
from datasets.messages import Array
from datasets.se2 import xyyaw_rows
from frontend.nodes import Node

WEAK_SIGMA_M: Final = 0.2
"""Only steps that local SLAM knew no better than this are looked at."""
LOOSE_SIGMA_M: Final = 0.12
"""Loose is what the whole graph knows no better than this. Of weak steps that turned out right it
knew 0.01 to 0.08 m, of those that turned out wrong 0.17 m, since its pairs are over-confident."""


@dataclass(frozen=True, slots=True)
class LooseStep:
    """A step between two nodes. sigma_m : as the final graph has it. node : the later one."""

    node: int
    sigma_m: float


def loose_steps(
    nodes: Sequence[Node], T_map_nodes: Array, constraints: ConstraintArrays
) -> tuple[LooseStep, ...]:
    """The steps whose length is a guess, in the order of the drive.

    T_map_nodes : (N, 3, 3), optimised; constraints : the whole graph between the nodes.
    """
    weak = np.array(
        [
            node.index
            for node in nodes[1:]
            if np.linalg.eigvalsh(node.step_covariance[:2, :2])[-1] > WEAK_SIGMA_M**2
        ],
        dtype=np.int64,
    )
    if not len(weak) or not len(constraints):
        return ()
    count = len(weak)
    asked = ConstraintArrays(
        weak - 1, weak, np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
    )
    covariances = relative_covariances(xyyaw_rows(T_map_nodes), constraints, asked)
    sigmas_m = np.sqrt(np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1].clip(0.0))
    return tuple(
        LooseStep(index, sigma_m)
        for index, sigma_m in zip(weak.tolist(), sigmas_m.tolist(), strict=True)
        if sigma_m > LOOSE_SIGMA_M
    )
