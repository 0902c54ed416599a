"""Factors and selected inverses of sparse symmetric matrices of equal blocks.

Blocks are arranged in levels: a block meets blocks of its own level and of the two next
to it, as the photos of a strip do. With the diagonal matrices A_k of the levels and
their neighbours E_k = N[k + 1, k], the matrix is L Lᵀ with

    L_k L_kᵀ = A_k - M_{k-1} M_{k-1}ᵀ,    M_k = E_k L_k⁻ᵀ,

and the parts of its inverse where the matrix itself may differ from zero follow from
the last level back (Takahashi, Fagan and Chin 1973), with G_k = M_k L_k⁻¹:

    Q[k, k] = (L_k L_kᵀ)⁻¹ + G_kᵀ Q[k + 1, k + 1] G_k,
    Q[k + 1, k] = -Q[k + 1, k + 1] G_k

All of it is NumPy on the host: it calls LAPACK, which compiled programs must not.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

Rows = Float[np.ndarray, "_ _"]

LEAST_ROWS = 96
"""Rows of a level, at least: products of smaller matrices take as long."""


class Singular(ArithmeticError):
    """The matrix is not positive definite."""


class Levels(NamedTuple):
    """The order of the blocks: `order[i]` is the block at place i, `place` its inverse;
    level k holds the places `begin[k]` to `begin[k + 1]`."""

    order: Int[np.ndarray, " block"]
    place: Int[np.ndarray, " block"]
    begin: Int[np.ndarray, " bound"]


class Factor(NamedTuple):
    """The factor L: its diagonal matrices L_k and what is left of them, M_k; the
    `scale` by which the diagonal of the matrix became 1; and the least pivot, the part
    of its diagonal that the rows before one leave."""

    diagonal: list[Rows]
    below: list[Rows]
    scale: Float[np.ndarray, " row"]
    pivot: float


class Selected(NamedTuple):
    """The inverse, as far as the levels reach: Q[k, k] and Q[k + 1, k]."""

    diagonal: list[Rows]
    below: list[Rows]


def arrange(
    first: Int[np.ndarray, " slot"],
    second: Int[np.ndarray, " slot"],
    blocks: int,
    size: int,
) -> Levels:
    """Levels of blocks of which `first[i]` meets `second[i]`, by the distance from a
    block at the rim (reverse Cuthill-McKee)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    rows, columns = np.concatenate([[first, second], [second, first]], axis=1)
    meets = coo_array((np.ones(len(rows)), (rows, columns)), (blocks, blocks)).tocsr()
    order = reverse_cuthill_mckee(meets, symmetric_mode=True).astype(int)
    place = np.empty(blocks, int)
    place[order] = np.arange(blocks)
    # the farthest place that those up to each one meet
    ahead = np.arange(blocks)
    np.maximum.at(ahead, place[rows], place[columns])
    ahead = np.maximum.accumulate(ahead)
    begin, least = [0], max(1, LEAST_ROWS // size)
    end = min(least, blocks)
    while begin[-1] < blocks:
        begin.append(end)
        end = min(blocks, max(int(ahead[end - 1]) + 1, end + least))
    return Levels(order, place, np.array(begin))


def assemble(
    levels: Levels,
    first: Int[np.ndarray, " slot"],
    second: Int[np.ndarray, " slot"],
    blocks: Float[np.ndarray, "slot d d"],
) -> tuple[list[Rows], list[Rows]]:
    """A_k and E_k, from the blocks N[first, second], each pair of blocks once."""
    size = blocks.shape[1]
    lengths = np.diff(levels.begin) * size
    diagonal = [np.zeros((n, n)) for n in lengths]
    below = [np.zeros((m, n)) for n, m in pairwise(lengths)]
    at = _find(levels, first, second)
    values = np.where(at.turned[:, None, None], np.swapaxes(blocks, 1, 2), blocks)
    for k, (inside, outside) in enumerate(_by_level(levels, at)):
        _put(diagonal[k], at.row[inside], at.column[inside], values[inside])
        # each block above the diagonal as well
        apart = inside[at.row[inside] != at.column[inside]]
        turned = np.swapaxes(values[apart], 1, 2)
        _put(diagonal[k], at.column[apart], at.row[apart], turned)
        if k < len(below):
            _put(below[k], at.row[outside], at.column[outside], values[outside])
    return diagonal, below


class _At(NamedTuple):
    """Where blocks stand: the levels of their row and column, row and column within
    these, and whether they are transposed there."""

    row_level: Int[np.ndarray, " slot"]
    column_level: Int[np.ndarray, " slot"]
    row: Int[np.ndarray, " slot"]
    column: Int[np.ndarray, " slot"]
    turned: Bool[np.ndarray, " slot"]


def _find(levels: Levels, first, second) -> _At:
    """On or below the diagonal."""
    i, j = levels.place[first], levels.place[second]
    turned = i < j
    i, j = np.where(turned, j, i), np.where(turned, i, j)
    level = lambda place: np.searchsorted(levels.begin, place, side="right") - 1
    rows, columns = level(i), level(j)
    begin = levels.begin
    return _At(rows, columns, i - begin[rows], j - begin[columns], turned)


def _by_level(levels: Levels, at: _At) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Of each level: the blocks on its diagonal, and those below it."""
    order = np.argsort(at.column_level, kind="stable")
    ends = np.searchsorted(at.column_level[order], np.arange(len(levels.begin)))
    for k, (start, end) in enumerate(pairwise(ends)):
        own = order[start:end]
        yield own[at.row_level[own] == k], own[at.row_level[own] == k + 1]


def _parts(matrix: Rows, size: int) -> Float[np.ndarray, "i d j d"]:
    """A matrix by its blocks; no copy."""
    return matrix.reshape(matrix.shape[0] // size, size, -1, size)


def _put(matrix: Rows, rows, columns, blocks: Float[np.ndarray, "slot d d"]) -> None:
    _parts(matrix, blocks.shape[1])[rows, :, columns, :] = blocks


def factorise(diagonal: list[Rows], below: list[Rows]) -> Factor:
    """The `Factor` of a matrix. Raises `Singular` where it is not positive definite."""
    from scipy.linalg import solve_triangular

    squares = np.concatenate([np.diagonal(a) for a in diagonal])
    scale = 1 / np.sqrt(np.where(squares > 0, squares, 1.0))
    parts = np.split(scale, np.cumsum([len(a) for a in diagonal])[:-1])
    factors, rests, pivot, taken = [], [], np.inf, None
    for k, (a, own) in enumerate(zip(diagonal, parts, strict=True)):
        left = a * own[:, None] * own
        if taken is not None:
            left -= taken @ taken.T
        try:
            factor = np.linalg.cholesky(left)
        except np.linalg.LinAlgError:
            raise Singular from None
        factors.append(factor)
        pivot = min(pivot, float(np.min(np.diagonal(factor)) ** 2))
        if k < len(below):
            e = below[k] * parts[k + 1][:, None] * own
            taken = solve_triangular(factor, e.T, lower=True, check_finite=False).T
            rests.append(taken)
    return Factor(factors, rests, scale, pivot)


def solve(factor: Factor, right: Rows) -> Rows:
    """N⁻¹ of some columns, rows in the order of the places."""
    from scipy.linalg import solve_triangular

    bounds = np.cumsum([len(a) for a in factor.diagonal])[:-1]
    parts = np.split(right * factor.scale[:, None], bounds)
    for k, own in enumerate(factor.diagonal):
        if k > 0:
            parts[k] = parts[k] - factor.below[k - 1] @ parts[k - 1]
        parts[k] = solve_triangular(own, parts[k], lower=True, check_finite=False)
    for k in reversed(range(len(parts))):
        if k < len(factor.below):
            parts[k] = parts[k] - factor.below[k].T @ parts[k + 1]
        parts[k] = solve_triangular(
            factor.diagonal[k], parts[k], lower=True, trans=1, check_finite=False
        )
    return np.concatenate(parts) * factor.scale[:, None]


def select_inverse(factor: Factor) -> Selected:
    """The `Selected` inverse."""
    from scipy.linalg import solve_triangular

    parts = np.split(factor.scale, np.cumsum([len(a) for a in factor.diagonal])[:-1])
    diagonal: list[Rows] = []
    below: list[Rows] = []
    for k in reversed(range(len(parts))):
        own = factor.diagonal[k]
        inverse = solve_triangular(
            own, np.eye(len(own)), lower=True, check_finite=False
        )
        q = inverse.T @ inverse
        if k < len(factor.below):
            g = factor.below[k] @ inverse
            crossed = diagonal[-1] @ g
            q += g.T @ crossed
            below.append(-crossed)
        diagonal.append(q)
    diagonal.reverse()
    below.reverse()
    scaled = [q * a[:, None] * a for q, a in zip(diagonal, parts, strict=True)]
    crossed = [
        q * b[:, None] * a for q, a, b in zip(below, parts, parts[1:], strict=False)
    ]
    return Selected(scaled, crossed)


def read_blocks(
    levels: Levels,
    selected: Selected,
    first: Int[np.ndarray, " slot"],
    second: Int[np.ndarray, " slot"],
    size: int,
) -> Float[np.ndarray, "slot d d"]:
    """The blocks Q[first, second], which the levels have to reach."""
    at = _find(levels, first, second)
    found = np.empty((len(first), size, size))
    for k, (inside, outside) in enumerate(_by_level(levels, at)):
        own = _parts(selected.diagonal[k], size)
        found[inside] = own[at.row[inside], :, at.column[inside], :]
        if len(outside) > 0:
            own = _parts(selected.below[k], size)
            found[outside] = own[at.row[outside], :, at.column[outside], :]
    return np.where(at.turned[:, None, None], np.swapaxes(found, 1, 2), found)
