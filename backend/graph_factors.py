"""GTSAM's side of the graph: factors, values and what comes back out of them.

Measured with 4.3.0 (15,000 constraints): factors built one by one cost 3 us each, so no vector
form is missed. ``noiseModel.Gaussian.Information`` silently gives a wrong root where a direction
has no information; ``SqrtInformation`` takes any root. BetweenFactorPose2 has its noise in the
axes of the to-node, and since 4.3 its error is the logarithm, as ``ConstraintArrays`` says. The
METIS ordering prints and raises where a node stands alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from backend.graph_arrays import ConstraintArrays, Mask, square_roots
from datasets.messages import Array

if TYPE_CHECKING:
    import gtsam

Loss = Literal["huber", "cauchy", "geman-mcclure"]

# No constraint is believed to better than 0.1 mm and 0.1 mrad: recorded graphs hold steps of a
# standing robot with information up to 3e12, on which Cholesky breaks down (Intel, MIT).
MAX_INFORMATION = 1e8
# Strong enough to hold the gauge, weak enough to leave the linear system well conditioned.
ANCHOR_SIGMA = 1e-3


def add_constraints(
    graph: gtsam.NonlinearFactorGraph,
    constraints: ConstraintArrays,
    loss: Loss | None = None,
    loss_scale: float = 2.0,
    suspects: Mask | None = None,
) -> None:
    """Append one BetweenFactorPose2 a constraint, in order; ``suspects`` carry the robust loss."""
    import gtsam  # noqa: PLC0415

    sqrt_information = gtsam.noiseModel.Gaussian.SqrtInformation
    factor, pose2, robust = gtsam.BetweenFactorPose2, gtsam.Pose2, gtsam.noiseModel.Robust.Create
    estimator = None if loss is None else _estimator(loss, loss_scale)
    doubted = np.ones(len(constraints), dtype=bool) if suspects is None else suspects
    rows = zip(
        constraints.from_nodes.tolist(),
        constraints.to_nodes.tolist(),
        constraints.xyyaw.tolist(),
        square_roots(constraints.information, MAX_INFORMATION),
        doubted.tolist(),
        strict=True,
    )
    for a, b, (x, y, yaw), root, doubt in rows:
        noise = sqrt_information(root, False)
        whole = robust(estimator, noise) if doubt and estimator is not None else noise
        graph.add(factor(a, b, pose2(x, y, yaw), whole))


def add_anchor(
    graph: gtsam.NonlinearFactorGraph, node: int, xyyaw: Array, sigma: float = ANCHOR_SIGMA
) -> None:
    """Hold a node where it is, as the gauge of its connected part; sigma in m and rad."""
    import gtsam  # noqa: PLC0415

    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    graph.addPriorPose2(node, gtsam.Pose2(*xyyaw.tolist()), noise)


def values_of(nodes_xyyaw: Array, first: int = 0) -> gtsam.Values:
    """Poses (N, 3) as gtsam.Values under the keys first, first + 1, ..."""
    import gtsam  # noqa: PLC0415

    values = gtsam.Values()
    for key, (x, y, yaw) in enumerate(nodes_xyyaw.tolist(), start=first):
        values.insert(key, gtsam.Pose2(x, y, yaw))
    return values


def poses_of(values: gtsam.Values) -> Array:
    """All poses of gtsam.Values in the order of their keys, (N, 3)."""
    import gtsam  # noqa: PLC0415

    xyyaw: Array = np.asarray(gtsam.utilities.extractPose2(values), dtype=np.float64)
    return xyyaw


def _estimator(loss: Loss, scale: float) -> gtsam.noiseModel.mEstimator.Base:
    import gtsam  # noqa: PLC0415

    kinds = gtsam.noiseModel.mEstimator
    if loss == "huber":
        return kinds.Huber.Create(scale)
    if loss == "cauchy":
        return kinds.Cauchy.Create(scale)
    return kinds.GemanMcClure.Create(scale)
