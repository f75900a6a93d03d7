"""A constraint of the pose graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from datasets.messages import Array

Kind = Literal["odometry", "match", "loop"]


@dataclass(frozen=True, slots=True)
class Constraint:
    """A measured relative pose between two nodes.

    T_from_to   : (3, 3), pose of node ``to_node`` in the frame of ``from_node``.
    information : (3, 3) symmetric, positive semi-definite (a direction that was not observed has
                  information 0), in the axes of ``to_node``: x, y, yaw (1/m^2, 1/rad^2).
    """

    from_node: int
    to_node: int
    T_from_to: Array
    information: Array
    kind: Kind


def inverted(matrices: Array) -> Array:
    """Covariance to information and back, (..., 3, 3). Raises LinAlgError if one is singular."""
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
