"""Sparse LDL' factorisation and the part of the inverse that lies on its pattern.

GTSAM gives the covariance of two poses in 2-5 ms a pair; a robust back end asks for all loop
closures at once, again and again. The entries of the inverse that have a place in the factor cost
about as much as the factor itself, and every constraint has its place there.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fusion.kernel_types import FAST, Floats, Ints


@njit(cache=True)
def ldl_pattern(starts: Ints, rows: Ints) -> tuple[Ints, Ints]:
    """Elimination tree (n,) and column starts (n + 1,) of the factor L of a symmetric matrix.

    starts, rows : the upper triangle by columns (CSC), diagonal included. O(|L|).
    Source: Davis, Algorithm 849: a concise sparse Cholesky factorization package, TOMS 2005.
    """
    n = starts.size - 1
    parent = np.full(n, -1, dtype=np.int64)
    seen = np.full(n, -1, dtype=np.int64)
    counts = np.zeros(n + 1, dtype=np.int64)
    for k in range(n):
        seen[k] = k
        for p in range(starts[k], starts[k + 1]):
            i = rows[p]
            while i < k and seen[i] != k:
                if parent[i] == -1:
                    parent[i] = k
                counts[i + 1] += 1
                seen[i] = k
                i = parent[i]
    return parent, np.cumsum(counts)


@njit(cache=True, fastmath=FAST)
def ldl_factor(
    starts: Ints, rows: Ints, values: Floats, parent: Ints, l_starts: Ints
) -> tuple[Ints, Floats, Floats]:
    """L (unit lower triangle by columns, rows ascending: indices and values) and diagonal D.

    A = L D L'. D holds 0 or less where A is not positive definite. Source: as ``ldl_pattern``.
    """
    n = starts.size - 1
    l_rows = np.empty(l_starts[n], dtype=np.int64)
    l_values = np.empty(l_starts[n])
    filled = l_starts[:n].copy()
    D = np.zeros(n)
    y = np.zeros(n)
    path = np.empty(n, dtype=np.int64)
    seen = np.full(n, -1, dtype=np.int64)
    for k in range(n):
        top = n
        seen[k] = k
        for p in range(starts[k], starts[k + 1]):
            i = rows[p]
            if i > k:
                continue
            y[i] += values[p]
            length = 0
            while seen[i] != k:
                path[length] = i
                length += 1
                seen[i] = k
                i = parent[i]
            while length > 0:
                top -= 1
                length -= 1
                path[top] = path[length]
        D[k] = y[k]
        y[k] = 0.0
        for q in range(top, n):
            i = path[q]
            y_i = y[i]
            y[i] = 0.0
            for p in range(l_starts[i], filled[i]):
                y[l_rows[p]] -= l_values[p] * y_i
            l_ki = y_i / D[i]
            D[k] -= l_ki * y_i
            l_rows[filled[i]] = k
            l_values[filled[i]] = l_ki
            filled[i] += 1
    return l_rows, l_values, D


@njit(cache=True, fastmath=FAST)
def inverse_on_pattern(
    l_starts: Ints, l_rows: Ints, l_values: Floats, D: Floats
) -> tuple[Floats, Floats]:
    """The inverse of L D L': its entries in the places of L, and its diagonal.

    Column j from those after it: Z_ij = -sum_k L_kj Z_ik over the rows k of column j; each Z_ik
    has its place, because the rows of one column are all joined in the filled pattern.
    Source: Takahashi, Fagan, Chen, Formation of a sparse bus impedance matrix, PICA 1973.
    """
    n = D.size
    Z = np.zeros(l_values.size)
    diagonal = np.zeros(n)
    place = np.full(n, -1, dtype=np.int64)
    total = np.zeros(n)
    for j in range(n - 1, -1, -1):
        first, last = l_starts[j], l_starts[j + 1]
        for p in range(first, last):
            place[l_rows[p]] = p
            total[p - first] = 0.0
        for p in range(first, last):
            k, l_kj = l_rows[p], l_values[p]
            total[p - first] += l_kj * diagonal[k]
            for q in range(l_starts[k], l_starts[k + 1]):
                at = place[l_rows[q]]
                if at >= 0:
                    total[at - first] += l_kj * Z[q]
                    total[p - first] += l_values[at] * Z[q]
        own = 1.0 / D[j]
        for p in range(first, last):
            Z[p] = -total[p - first]
            own -= l_values[p] * Z[p]
        diagonal[j] = own
        for p in range(first, last):
            place[l_rows[p]] = -1
    return Z, diagonal


@njit(cache=True)
def entries(l_starts: Ints, l_rows: Ints, Z: Floats, diagonal: Floats, i: Ints, j: Ints) -> Floats:
    """Entries (i, j) of the symmetric inverse; NaN where the pattern has no place for them."""
    found = np.empty(i.size)
    for m in range(i.size):
        low, high = min(i[m], j[m]), max(i[m], j[m])
        if low == high:
            found[m] = diagonal[low]
            continue
        first, last = l_starts[low], l_starts[low + 1]
        at = first + np.searchsorted(l_rows[first:last], high)
        found[m] = Z[at] if at < last and l_rows[at] == high else np.nan
    return found
