"""The linearised distance to the surface: a plain twin, finite differences, small systems."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.messages import Array
from datasets.se2 import inverse, se2, transform
from frontend import match_kernels
from frontend.local_map import NO_CLOUD, NO_POINTS
from tests.frontend.rooms import box, off_by, prepared, walls

SEEDS = st.integers(0, 2**32 - 1)
LIST_CELL_M, GATE_M = 0.2, 0.2
ORIGIN = (-6.0, -6.0)
SQUARE_CORNERS = walls(
    ((-3, -2), (3, -2), (3, 1), (4, 1), (4, 2.5), (-3, 2.5), (-3, -2)), box(1.0, 0.5, 0.6, 0.4)
)
"""Only right angles: walls that meet are never near each other in their normals."""


@dataclass
class Surface:
    """Map points in their lists, none merged."""

    points: Array
    normals: Array
    weights: Array

    def __post_init__(self) -> None:
        self.head = np.full((60, 60), -1, dtype=np.int32)
        self.following = np.full(len(self.points), -1, dtype=np.int32)
        cells = np.floor((self.points - ORIGIN) / LIST_CELL_M).astype(np.int64)
        for k, (col, row) in enumerate(cells.tolist()):
            self.following[k] = self.head[row, col]
            self.head[row, col] = k

    def equations(
        self,
        points: Array,
        normals: Array,
        pose: Array,
        robust_m: float,
        weights: Array | None = None,
    ) -> tuple[Array, Array, int, float, float]:
        H, g = np.full((3, 3), np.nan), np.full(3, np.nan)
        matched, weight, error = match_kernels.imls_normal_equations(
            points,
            normals,
            np.ones(len(points)) if weights is None else weights,
            float(pose[0]),
            float(pose[1]),
            float(pose[2]),
            self.points,
            self.normals,
            self.weights,
            self.following,
            self.head,
            *ORIGIN,
            LIST_CELL_M,
            GATE_M,
            robust_m,
            H,
            g,
        )
        return H, g, matched, weight, error

    def match(
        self,
        points: Array,
        normals: Array,
        start: Array,
        expected: Array,
        prior: Array,
        iterations: int = 12,
    ) -> tuple[Array, Array, int, int]:
        """(pose, information, matched, iterations done)."""
        pose, H = np.full(3, np.nan), np.full((3, 3), np.nan)
        surface = (self.points, self.normals, self.weights, self.following, self.head)
        matched, _, _, _, _, done = match_kernels.imls_match(
            (points, normals, np.ones(len(points))),
            surface,
            NO_CLOUD,
            surface,
            NO_POINTS,
            surface,
            np.ones(3),
            start,
            expected,
            prior,
            *ORIGIN,
            LIST_CELL_M,
            GATE_M,
            0.2,
            0.04,
            0.03,
            iterations,
            pose,
            H,
            np.zeros((3, 3)),
        )
        return pose, H, matched, done


def surface_of(pose: Array, *, noise_m: float = 0.0, seed: int = 0) -> Surface:
    """What a scan at a pose (3,) shows of the room, in the room's frame."""
    random = np.random.default_rng(seed)
    T = se2(*pose)
    scan = prepared(SQUARE_CORNERS, T, beams=540, noise_m=noise_m, random=random)
    known = scan.normals_base.any(axis=1)
    normals = scan.normals_base[known] @ T[:2, :2].T
    weights = random.integers(1, 20, int(known.sum())).astype(np.float64)
    return Surface(transform(T, scan.points_base[known]), normals, weights)


def errors(
    surface: Surface, points: Array, normals: Array, pose: Array
) -> tuple[Array, Array, Array]:
    """Residual (N,), Jacobian (N, 3) and whether there is a partner (N,), by the formula."""
    T = se2(*pose)
    q, n = transform(T, points), normals @ T[:2, :2].T
    d = q[:, None] - surface.points
    d2 = (d**2).sum(axis=2)
    near = (d2 < GATE_M**2) & (n @ surface.normals.T > 0.8)
    w = np.where(near, surface.weights * ((1.0 - d2 / GATE_M**2) ** 12 + 1e-9), 0.0)
    partner = n.any(axis=1) & (w.sum(axis=1) > 0.0)
    w[~partner] = 1.0
    w /= w.sum(axis=1, keepdims=True)
    e = (w * np.einsum("nmk,mk->nm", d, surface.normals)).sum(axis=1)
    mean = w @ surface.normals
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    arm = q - pose[:2]
    J = np.column_stack([mean, mean[:, 1] * arm[:, 0] - mean[:, 0] * arm[:, 1]])
    return e, J, partner


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS, robust_m=st.sampled_from([0.02, 0.1, 1.0]))
def test_agrees_with_the_plain_twin(seed: int, robust_m: float) -> None:
    random = np.random.default_rng(seed)
    surface = surface_of(np.array([0.3, -0.2, 0.4]), noise_m=0.01, seed=seed)
    pose = np.array([0.0, 0.3, -0.8])
    scan = prepared(SQUARE_CORNERS, se2(*pose), beams=150, noise_m=0.01, random=random)
    pose = pose + random.normal(0.0, [0.05, 0.05, 0.03])
    e, J, partner = errors(surface, scan.points_base, scan.normals_base, pose)
    w = np.where(partner, (robust_m**2 / (robust_m**2 + e**2)) ** 2, 0.0)
    H, g, matched, weight, error = surface.equations(
        scan.points_base, scan.normals_base, pose, robust_m
    )
    assert matched == partner.sum() > 50
    assert pytest.approx(w.sum()) == weight
    assert pytest.approx((w * e**2).sum()) == error
    assert pytest.approx(np.einsum("n,ni,nj->ij", w, J, J)) == H
    assert g == pytest.approx(np.einsum("n,ni,n->i", w, J, e), abs=1e-9)


@pytest.mark.parametrize("robust_m", [0.05, 0.3])
@pytest.mark.parametrize("offset", [(0.03, -0.02, 0.01), (-0.06, 0.05, -0.02)])
def test_is_the_gradient_of_the_robust_cost(
    offset: tuple[float, float, float], robust_m: float
) -> None:
    """Geman-McClure: r^2 e^2 / 2 (r^2 + e^2) has the derivative w e, w = (r^2 / (r^2 + e^2))^2."""
    pose = np.array([0.2, 0.1, 0.3])
    surface = surface_of(np.array([0.0, 0.0, 0.0]))
    scan = prepared(SQUARE_CORNERS, se2(*pose), beams=200)
    pose = pose + offset
    _, _, partner = errors(surface, scan.points_base, scan.normals_base, pose)
    points, normals = scan.points_base[partner], scan.normals_base[partner]

    def cost(at: Array) -> float:
        e, _, still = errors(surface, points, normals, at)
        assert still.all(), "the partners must stay the same for the difference to mean something"
        return float((0.5 * robust_m**2 * e**2 / (robust_m**2 + e**2)).sum())

    step = 1e-6
    sides = [(cost(pose + step * unit), cost(pose - step * unit)) for unit in np.eye(3)]
    numeric = np.array([(up - down) / (2.0 * step) for up, down in sides])
    _, g, _, _, _ = surface.equations(points, normals, pose, robust_m)
    assert g == pytest.approx(numeric, rel=0.02, abs=0.02 * float(np.abs(numeric).max()))


def test_hessian_is_that_of_the_quadratic_cost() -> None:
    pose = np.array([0.2, 0.1, 0.3])
    surface = surface_of(np.array([0.0, 0.0, 0.0]))
    scan = prepared(SQUARE_CORNERS, se2(*pose), beams=200)
    args = (scan.points_base, scan.normals_base)
    H, _, _, _, _ = surface.equations(*args, pose, 100.0)
    step = 1e-4
    columns = []
    for unit in np.eye(3):
        up = surface.equations(*args, pose + step * unit, 100.0)[1]
        down = surface.equations(*args, pose - step * unit, 100.0)[1]
        columns.append((up - down) / (2.0 * step))
    assert pytest.approx(np.array(columns), rel=0.02, abs=0.02 * H.max()) == H


@pytest.mark.parametrize("pose", [[50.0, 0.0, 0.0], [-1e7, 1e7, 1.0], [0.0, 0.0, 0.0]])
def test_no_partner_no_equation(pose: list[float]) -> None:
    """Far away, or (at the right place) seen from the back of the walls."""
    surface = surface_of(np.zeros(3))
    scan = prepared(SQUARE_CORNERS, np.eye(3))
    H, g, *sums = surface.equations(scan.points_base, -scan.normals_base, np.array(pose), 0.1)
    assert sums == [0, 0.0, 0.0]
    assert not H.any()
    assert not g.any()


# ---- small systems ---------------------------------------------------------------------------


@settings(deadline=None)
@given(seed=SEEDS, scale=st.floats(1e-3, 1e6))
def test_solves_what_numpy_solves(seed: int, scale: float) -> None:
    random = np.random.default_rng(seed)
    root = random.normal(size=(3, 3))
    A = scale * (root @ root.T + 0.05 * np.eye(3))
    b, x = random.normal(size=3), np.full(3, np.nan)
    assert match_kernels.solve3(A, b, x)
    assert pytest.approx(b, rel=1e-8, abs=1e-8) == A @ x
    assert x == pytest.approx(np.linalg.solve(A, b), rel=1e-6, abs=1e-9 / scale)


@settings(deadline=None)
@given(seed=SEEDS, least=st.sampled_from([-1.0, -1e-3, 0.0]), place=st.integers(0, 2))
def test_refuses_what_is_not_positive_definite(seed: int, least: float, place: int) -> None:
    random = np.random.default_rng(seed)
    Q, _ = np.linalg.qr(random.normal(size=(3, 3)))
    values = random.uniform(0.5, 2.0, 3)
    values[place] = least
    A = Q @ np.diag(values) @ Q.T
    if least == 0.0:
        A = np.diag(values)  # rounding can't hide a zero here
    x = np.full(3, np.nan)
    assert not match_kernels.solve3(A, np.ones(3), x)
    assert np.isnan(x).all(), "nothing may be taken from a system that was refused"


# ---- Gauss-Newton ----------------------------------------------------------------------------

NO_PRIOR = np.zeros((3, 3))


@settings(deadline=None, max_examples=30)
@given(seed=SEEDS)
def test_recovers_a_motion_from_a_wrong_start_over_noise(seed: int) -> None:
    random = np.random.default_rng(seed)
    true = np.array([*random.uniform([-0.5, -0.5], [0.5, 0.5]), random.uniform(-3.1, 3.1)])
    surface = surface_of(np.zeros(3), noise_m=0.01, seed=seed)
    scan = prepared(SQUARE_CORNERS, se2(*true), beams=200, noise_m=0.01, random=random)
    start = true + random.uniform(-1.0, 1.0, 3) * [0.1, 0.1, np.radians(5.0)]
    pose, _, matched, done = surface.match(
        scan.points_base, scan.normals_base, start, start, NO_PRIOR
    )
    away_m, away_rad = off_by(se2(*true), se2(*pose))
    assert away_m < 0.015
    assert away_rad < np.radians(0.5)
    assert matched > 100
    assert done >= 5


def test_a_motion_and_its_inverse_undo_each_other() -> None:
    a, b = np.array([0.0, 0.0, 0.0]), np.array([0.4, -0.3, 0.7])
    scans = {k: prepared(SQUARE_CORNERS, se2(*pose), beams=540) for k, pose in enumerate((a, b))}
    T_a_b = inverse(se2(*a)) @ se2(*b)
    found = []
    for of, on, T in ((1, 0, T_a_b), (0, 1, inverse(T_a_b))):
        known = scans[on].normals_base.any(axis=1)
        surface = Surface(
            scans[on].points_base[known], scans[on].normals_base[known], np.ones(int(known.sum()))
        )
        true = np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])])
        start = true + np.array([0.06, -0.05, 0.04])
        pose, _, _, _ = surface.match(
            scans[of].points_base, scans[of].normals_base, start, start, NO_PRIOR
        )
        found.append(se2(*pose))
    assert max(off_by(T_a_b, found[0])) < 0.003
    assert max(off_by(np.eye(3), found[0] @ found[1])) < 0.003


def test_covariance_is_that_of_many_noisy_scans() -> None:
    """Against a Monte Carlo with noise along the normals."""
    sigma_m = 0.01
    true = np.array([0.2, -0.1, 0.5])
    surface = surface_of(np.zeros(3))
    scan = prepared(SQUARE_CORNERS, se2(*true), beams=120)
    known = scan.normals_base.any(axis=1)
    points, normals = scan.points_base[known], scan.normals_base[known]
    random = np.random.default_rng(8)
    poses = []
    for _ in range(300):
        noise = sigma_m * random.standard_normal((len(points), 1))
        noisy = np.ascontiguousarray(points + noise * normals)
        pose, H, matched, _ = surface.match(noisy, normals, true, true, NO_PRIOR)
        poses.append(pose)
    expected = np.linalg.inv(H * (0.03 / sigma_m) ** 2)
    measured = np.cov(np.array(poses).T)
    assert matched > 0.9 * len(points)
    ratio = np.linalg.eigvals(np.linalg.solve(expected, measured)).real
    assert (ratio > 0.6).all(), "the information promises too little"
    assert (ratio < 1.8).all(), "the information promises too much"


def test_the_prior_holds_what_the_data_do_not() -> None:
    surface = surface_of(np.zeros(3))
    scan = prepared(SQUARE_CORNERS, np.eye(3), beams=200)
    start = np.array([0.05, 0.0, 0.0])
    pose, *_ = surface.match(
        scan.points_base, scan.normals_base, start, start, np.diag([1e12, 1e12, 1e12])
    )
    assert pose == pytest.approx(start, abs=1e-4)
    away = np.array([40.0, 40.0, 1.0])
    expected = np.array([40.1, 39.95, 1.1])
    prior = np.diag([100.0, 100.0, 100.0])
    pose, H, matched, done = surface.match(
        scan.points_base, scan.normals_base, away, expected, prior
    )
    assert (matched, done > 0) == (0, True)
    assert not H.any()
    assert pose == pytest.approx(expected), "with no data the pose goes to the prior's mean"


def test_without_data_and_prior_nothing_is_done() -> None:
    surface = surface_of(np.zeros(3))
    scan = prepared(SQUARE_CORNERS, np.eye(3), beams=200)
    away = np.array([40.0, 40.0, 1.0])
    pose, _, matched, done = surface.match(
        scan.points_base, scan.normals_base, away, away, NO_PRIOR
    )
    assert (matched, done) == (0, 0)
    assert pose == pytest.approx(away)
