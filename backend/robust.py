"""Batch optimisation in which loop closures are suspects and everything else is believed.

Measured on graphs of the literature with 100 random false closures added (M3500b, Intel, CSAIL,
FRH; 20 on MIT): all true ones kept, 0 or 1 false; 5-11 CPU-seconds on M3500b, about 1 on Intel,
less on the others. False closures in runs of ten that agree with each other go as well where the
odometry can tell (CSAIL, FRH); of ten runs on Intel one stays, on M3500b most do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backend.consistency import CHI2_LIMIT, Consistency, consistency, odometry_chain
from backend.graph import optimise
from backend.graph_arrays import ConstraintArrays, Indices, Mask, joined, pseudo_inverses
from backend.graph_covariance import relative_covariances
from datasets.messages import Array
from datasets.se2 import pose_matrices, xyyaw_rows

GRADUATED_ROUNDS = 12
TEST_ROUNDS = 25
GROUP_ROUNDS = 6
GROUPS_TRIED = 6
NEIGHBOUR_NODES = 5
# A group is tried without when its neighbours' residuals are this many times the usual.
SUSPICIOUS = 4.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of one loop closure. chi2: of its residual at the final poses."""

    kept: bool
    reason: str
    chi2: float


@dataclass(frozen=True, slots=True)
class RobustResult:
    """Poses, and what can be said of the constraints.

    T_map_nodes  : (N, 3, 3).
    verdicts     : one for each loop, in their order.
    scale        : factor the covariances were taken to be too small by, >= 1.
    known_ratio  : chi2 of the known constraints over what is expected of them after the fit: near
                   1 where information is right, above where it claims too much; NaN where a
                   graph has nothing to spare.
    loops_ratio  : the same for the closures kept.
    """

    T_map_nodes: Array
    verdicts: tuple[Verdict, ...]
    scale: float
    known_ratio: float
    loops_ratio: float


def robust_optimise(
    T_map_nodes: Array, known: ConstraintArrays, loops: ConstraintArrays
) -> RobustResult:
    """Find the poses, and the closures that belong to them.

    T_map_nodes : (N, 3, 3), start, not changed.
    known       : odometry and scan matches, taken as right; they should join consecutive nodes.
    loops       : suspects.

    1. Pairwise consistency chooses closures that agree with near ones and contradict none.
    2. Truncated least squares over these, by graduated non-convexity (Yang et al., RA-L 2020).
    3. Each closure left out is tested against the graph, with the graph's own uncertainty, and
       taken in where it fits; each one kept is tested against the graph without it, and taken
       back where it does not, worst first.
    4. The same for groups that hold each other up, where their neighbours' residuals are high.
    """
    start = xyyaw_rows(T_map_nodes)
    if not len(loops):
        found = xyyaw_rows(optimise(T_map_nodes, known).T_map_nodes)
        return _result(found, known, loops, np.zeros(0, dtype=bool), 1.0, ())
    agreement = consistency(odometry_chain(start, known), loops)
    search = _Search(known, loops, CHI2_LIMIT * agreement.scale, start)
    search.kept = ~agreement.contrary & (agreement.support > 0)
    search.graduate()
    search.test_each(TEST_ROUNDS)
    search.test_groups(agreement.groups)
    search.solve(iterations=50)
    reasons = _reasons(search, agreement)
    return _result(search.xyyaw, known, loops, search.kept, agreement.scale, reasons)


class _Search:
    """The closures kept so far and the poses that belong to them."""

    def __init__(
        self, known: ConstraintArrays, loops: ConstraintArrays, limit: float, start: Array
    ) -> None:
        self.known, self.loops, self.limit = known, loops, limit
        self.xyyaw = start
        self.kept: Mask = np.zeros(len(loops), dtype=bool)
        self.taken_back: Indices = np.zeros(len(loops), dtype=np.int64)

    def solve(self, weights: Array | None = None, iterations: int = 30) -> None:
        self.xyyaw, _ = self._solved(self.kept, weights, iterations)

    def graduate(self) -> None:
        """Truncated least squares over the closures kept, from nearly convex to truncated."""
        suspects = self.kept.copy()
        weights = suspects.astype(float)
        self.solve()
        chi2 = self.loops.chi2(self.xyyaw)
        worst = float(chi2[suspects].max(initial=0.0))
        if worst <= self.limit:
            return
        mu = self.limit / (2.0 * worst - self.limit)
        step = max(1.4, (20.0 / mu) ** (1.0 / GRADUATED_ROUNDS))
        for _ in range(GRADUATED_ROUNDS):
            chi2 = self.loops.chi2(self.xyyaw).clip(1e-12)
            between = np.sqrt(self.limit * mu * (mu + 1.0) / chi2) - mu
            new = np.where(suspects, between.clip(0.0, 1.0), 0.0)
            if np.abs(new - weights).max() < 0.01 and ((new < 0.01) | (new > 0.99)).all():
                break
            weights, self.kept = new, new > 1e-3
            self.solve(weights, iterations=5)
            mu *= step
        self.kept = suspects & (self.loops.chi2(self.xyyaw) <= self.limit)
        self.solve()

    def test_each(self, rounds: int) -> None:
        """Take back what the rest contradicts, take in what fits the rest, until it rests."""
        for _ in range(rounds):
            chi2 = self._against_the_rest()
            worst = float(chi2[self.kept].max(initial=0.0))
            if worst > self.limit:
                # One false closure makes its neighbours look bad: only the worst go at once.
                out = self.kept & (chi2 > max(self.limit, 0.5 * worst))
                self.kept &= ~out
                self.taken_back += out
            else:
                # Once taken back by mistake, a closure may return, but must fit well.
                limit = self.limit * np.array([1.0, 0.5, -1.0])[self.taken_back.clip(0, 2)]
                fits = ~self.kept & (chi2 <= limit)
                if not fits.any():
                    return
                self.kept |= fits
            self.solve()

    def test_groups(self, groups: Indices) -> None:
        """Take back groups without which the others' residuals fall by more than chance."""
        for _ in range(GROUP_ROUNDS):
            total = self._total(self.kept, self.xyyaw)
            best, gain = None, 1.0
            for group in self._suspicious(groups):
                without = self.kept & (groups != group)
                xyyaw, _ = self._solved(without, None, 10)
                members = int((self.kept & (groups == group)).sum())
                fall = (total - self._total(without, xyyaw)) / self.limit
                fall *= CHI2_LIMIT / _chi2_limit(3 * members)
                if fall > gain:
                    best, gain = group, fall
            if best is None:
                return
            out = self.kept & (groups == best)
            self.kept &= ~out
            self.taken_back += 2 * out
            self.solve()
            self.test_each(GROUP_ROUNDS)

    def _against_the_rest(self) -> Array:
        """Squared Mahalanobis length of each closure's residual in the graph without it."""
        graph = joined(self.known, self.loops.pick(self.kept))
        explained = relative_covariances(self.xyyaw, graph, self.loops)
        measured = pseudo_inverses(self.loops.information)
        total = np.where(self.kept[:, None, None], measured - explained, measured + explained)
        values, vectors = np.linalg.eigh(total)
        residuals = np.einsum("mij,mi->mj", vectors, self.loops.residuals(self.xyyaw))
        # Where nothing but the closure itself holds a direction, there is nothing to compare.
        least = 1e-3 * np.linalg.eigvalsh(measured)[:, :1]
        chi2: Array = (residuals**2 / np.maximum(values, least)).sum(axis=1)
        return chi2

    def _suspicious(self, groups: Indices) -> list[int]:
        """Groups with the highest residuals around their ends, the highest first."""
        graph = joined(self.known, self.loops.pick(self.kept))
        around = np.ones(2 * NEIGHBOUR_NODES + 1)
        chi2 = graph.chi2(self.xyyaw)
        count = len(self.xyyaw)
        ends = np.concatenate([graph.from_nodes, graph.to_nodes])
        sums = np.bincount(ends, np.tile(chi2, 2), count)
        hits = np.bincount(ends, minlength=count).astype(float)
        level = np.convolve(sums, around, "same") / np.convolve(hits, around, "same").clip(1.0)
        kept = np.flatnonzero(self.kept)
        of_loop = np.maximum(level[self.loops.from_nodes], level[self.loops.to_nodes])[kept]
        size = int(groups.max(initial=-1)) + 1
        number = np.bincount(groups[kept], minlength=size)
        score = np.bincount(groups[kept], of_loop, size) / number.clip(1)
        usual = float(np.median(level))
        order = np.argsort(-score, kind="stable")[:GROUPS_TRIED]
        return [int(g) for g in order if score[g] > SUSPICIOUS * usual and number[g]]

    def _solved(self, kept: Mask, weights: Array | None, iterations: int) -> tuple[Array, float]:
        chosen = self.loops.pick(kept)
        if weights is not None:
            chosen = chosen.weighted(weights[kept])
        graph = joined(self.known, chosen)
        found = optimise(pose_matrices(self.xyyaw), graph, iterations=iterations)
        return xyyaw_rows(found.T_map_nodes), found.chi2

    def _total(self, kept: Mask, xyyaw: Array) -> float:
        return float(self.known.chi2(xyyaw).sum() + self.loops.pick(kept).chi2(xyyaw).sum())


def _chi2_limit(degrees: int) -> float:
    """What chi2 passes once in a thousand times (Wilson and Hilferty 1931)."""
    part = 2.0 / (9.0 * degrees)
    return float(degrees * (1.0 - part + 3.09 * np.sqrt(part)) ** 3)


def _reasons(search: _Search, agreement: Consistency) -> tuple[str, ...]:
    reasons = []
    for row, kept in enumerate(search.kept.tolist()):
        if kept:
            reasons.append("fits")
        elif agreement.contrary[row]:
            reasons.append(f"its group contradicts {agreement.conflicts[row]} other closures")
        elif search.taken_back[row]:
            reasons.append("taken back: it raised its neighbours' residuals")
        else:
            reasons.append("does not fit the graph of the others")
    return tuple(reasons)


def _result(
    xyyaw: Array,
    known: ConstraintArrays,
    loops: ConstraintArrays,
    kept: Mask,
    scale: float,
    reasons: tuple[str, ...],
) -> RobustResult:
    chi2 = loops.chi2(xyyaw)
    graph = joined(known, loops.pick(kept))
    spared = _spared(xyyaw, graph)
    known_ratio = _ratio(known.chi2(xyyaw), spared[: len(known)])
    loops_ratio = _ratio(chi2[kept], spared[len(known) :])
    verdicts = tuple(
        Verdict(bool(k), reason, float(c)) for k, reason, c in zip(kept, reasons, chi2, strict=True)
    )
    return RobustResult(pose_matrices(xyyaw), verdicts, scale, known_ratio, loops_ratio)


def _spared(xyyaw: Array, graph: ConstraintArrays) -> Array:
    """The chi2 expected of each constraint after the fit: 3 less what the fit took up."""
    if not len(graph):
        return np.zeros(0)
    explained = relative_covariances(xyyaw, graph, graph)
    taken = np.einsum("mij,mji->m", graph.information, explained)
    rank: Array = (np.linalg.eigvalsh(graph.information) > 1e-6).sum(axis=1).astype(float)
    return (rank - taken).clip(0.0)


def _ratio(chi2: Array, expected: Array) -> float:
    spare = float(expected.sum())
    return float(chi2.sum()) / spare if spare > 1.0 else float("nan")
