"""Constraints as arrays: the form in which thousands of them are measured, weighted and chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from backend.constraint import Constraint
from datasets.messages import Array
from datasets.se2 import between, logarithm, xyyaw_rows

Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ConstraintArrays:
    """M measured relative poses between nodes, one a row; ``Constraint`` says what each means.

    from_nodes, to_nodes : (M,) int64.
    xyyaw                : (M, 3) float64, pose of ``to`` in the frame of ``from``: m, m, rad.
    information          : (M, 3, 3) float64, positive semi-definite, in the axes of ``to``.

    Raises ValueError if shapes disagree, a value is not finite, an index is negative or a
    constraint joins a node to itself.
    """

    from_nodes: Indices
    to_nodes: Indices
    xyyaw: Array
    information: Array

    def __post_init__(self) -> None:
        count = self.from_nodes.size
        shapes = (self.from_nodes.shape, self.to_nodes.shape)
        if shapes != ((count,), (count,)):
            raise ValueError(f"node indices must be (M,) and (M,), not {shapes}")
        if self.xyyaw.shape != (count, 3) or self.information.shape != (count, 3, 3):
            raise ValueError(
                f"{count} constraints need xyyaw (M, 3) and information (M, 3, 3), "
                f"not {self.xyyaw.shape} and {self.information.shape}"
            )
        if not (np.isfinite(self.xyyaw).all() and np.isfinite(self.information).all()):
            raise ValueError("constraints must be finite")
        if count and min(self.from_nodes.min(), self.to_nodes.min()) < 0:
            raise ValueError("node indices start at 0")
        if (self.from_nodes == self.to_nodes).any():
            raise ValueError("a constraint must join two different nodes")

    def __len__(self) -> int:
        return int(self.from_nodes.size)

    @classmethod
    def of(cls, constraints: Sequence[Constraint]) -> Self:
        """The same constraints, in the same order."""
        T_from_to = np.array([c.T_from_to for c in constraints]).reshape(-1, 3, 3)
        return cls(
            np.array([c.from_node for c in constraints], dtype=np.int64),
            np.array([c.to_node for c in constraints], dtype=np.int64),
            xyyaw_rows(T_from_to),
            np.array([c.information for c in constraints], dtype=np.float64).reshape(-1, 3, 3),
        )

    def pick(self, rows: Indices | Mask) -> Self:
        """Some of the constraints, by index or mask."""
        return type(self)(
            self.from_nodes[rows], self.to_nodes[rows], self.xyyaw[rows], self.information[rows]
        )

    def weighted(self, weights: Array) -> Self:
        """The same constraints with each information times its weight, (M,) >= 0."""
        scaled = self.information * weights[:, None, None]
        return type(self)(self.from_nodes, self.to_nodes, self.xyyaw, scaled)

    def residuals(self, nodes_xyyaw: Array) -> Array:
        """What the nodes say more than was measured, (M, 3): x, y, yaw in the axes of ``to``.

        nodes_xyyaw : (N, 3), poses of all nodes in the map.

        The residual is the logarithm of T_measured^-1 @ T_from_to, as in GTSAM 4.3 (g2o takes
        plain x, y, yaw: the same for small ones).
        """
        a, b = nodes_xyyaw[self.from_nodes], nodes_xyyaw[self.to_nodes]
        return logarithm(between(self.xyyaw, between(a, b)))

    def chi2(self, nodes_xyyaw: Array) -> Array:
        """Squared Mahalanobis length of each residual, (M,); 3 on average where all is right."""
        r = self.residuals(nodes_xyyaw)
        return np.einsum("mi,mij,mj->m", r, self.information, r)


def joined(first: ConstraintArrays, second: ConstraintArrays) -> ConstraintArrays:
    """All of both, in order."""
    return ConstraintArrays(
        np.concatenate([first.from_nodes, second.from_nodes]),
        np.concatenate([first.to_nodes, second.to_nodes]),
        np.concatenate([first.xyyaw, second.xyyaw]),
        np.concatenate([first.information, second.information]),
    )


def square_roots(information: Array, most: float = np.inf) -> Array:
    """R, (M, 3, 3), with R.T @ R = information; by eigenvectors, so that zeros are allowed.

    most : eigenvalues above it are taken as this.

    Cholesky would serve only where every direction is observed. Rounding below zero is taken as
    zero. Raises ValueError where an information is clearly not positive semi-definite.
    """
    values, vectors = np.linalg.eigh(information)
    if (values[:, 0] < -1e-6 * np.abs(values[:, 2]).clip(1e-12)).any():
        row = int(np.argmin(values[:, 0]))
        raise ValueError(f"information {row} has the negative eigenvalue {values[row, 0]:g}")
    roots = np.sqrt(values.clip(0.0, most))
    R: Array = roots[:, :, None] * np.swapaxes(vectors, 1, 2)
    return R


def pseudo_inverses(information: Array, most: float = 1e6) -> Array:
    """Covariances (M, 3, 3); a direction without information gets the variance ``most``."""
    values, vectors = np.linalg.eigh(information)
    variances = 1.0 / values.clip(1.0 / most)
    covariances: Array = (vectors * variances[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return covariances


def first_nodes(count: int, arrays: ConstraintArrays) -> list[int]:
    """The lowest node of each connected part of a graph of ``count`` nodes, ascending."""
    from scipy.sparse import coo_matrix  # noqa: PLC0415
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    if max(arrays.from_nodes.max(), arrays.to_nodes.max()) >= count:
        raise ValueError(f"a constraint names a node beyond the {count} there are")
    ones = np.ones(len(arrays))
    links = coo_matrix((ones, (arrays.from_nodes, arrays.to_nodes)), shape=(count, count))
    _, labels = connected_components(links, directed=False)
    firsts = np.unique(labels, return_index=True)[1]
    return sorted(firsts.tolist())
