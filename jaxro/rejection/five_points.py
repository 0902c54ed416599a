"""The orientations of many subsets of five points, solved together: the hypotheses of a
search.

The equations are those of `starts.five_point` (Nister 2004). A search can do without
some solutions if the others come sooner, so that two steps differ. The cubics are
eliminated without pivots. The real roots of the polynomial of degree ten are sought
where it changes its sign between NODES places of the projective line, so that two roots
that lie closer together are lost: one subset of seven loses the right orientation. What
is found is right to some thousandths.

Arrays carry the subsets on their last axis.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..orientation.starts.decomposition import cofactors
from ..orientation.starts.five_point import (
    constraints,
    determinant,
    essential_coefficients,
)
from ..orientation.starts.problems_last import cross, merging_last

SOLUTIONS = 10
"""Real solutions that five points may have."""

NODES = 32
"""Intervals on each half of the projective line: |z| <= |w|, and |z| > |w|."""

NEWTON_STEPS = 3
TINY = 1e-30

EDGES = np.linspace(-1, 1, NODES + 1)
POWERS = EDGES[:, None] ** np.arange(11)
LEFT_EDGES = np.concatenate([EDGES[:-1], EDGES[:-1]])[:, None]
IN_SECOND_HALF = (np.arange(2 * NODES) >= NODES)[:, None]

Image = Float[Array, "5 3 subset"]
Numbers = Float[Array, " subset"]


class Solutions(NamedTuple):
    """Orientations by solution and subset, and which of them exist with all five points
    in front of both photos."""

    rotation: Float[Array, "solution 3 3 subset"]
    base: Float[Array, "solution 3 subset"]
    exist: Bool[Array, "solution subset"]


class Brackets(NamedTuple):
    """The intervals in which the polynomial changes its sign: their ordinal numbers (0:
    no change), where a straight line meets zero, and how many there are."""

    ordinal: Int[Array, "interval subset"]
    crossing: Float[Array, "interval subset"]
    count: Int[Array, " subset"]


@merging_last
def solve(left: Image, right: Image) -> Solutions:
    """The orientations of five points with image vectors (x/f, y/f, -1)."""
    rows = (left[:, :, None] * right[:, None]).reshape(5, 9, -1)
    basis = _basis(rows).reshape(4, 3, 3, -1)
    equations = _eliminated(constraints(basis))
    polynomial = determinant(equations)
    brackets = _bracketed(polynomial)

    def solution(number: Int[Array, ""]) -> tuple:
        z, w = _root(polynomial, brackets, number)
        coefficients = essential_coefficients(equations, z[None], w[None])
        essential = jnp.sum(basis * coefficients[:, 0][:, None, None], axis=0)
        rotation, base, in_front = _facing(essential, left, right)
        return rotation, base, in_front & (number < brackets.count)

    return Solutions(
        *lax.map(solution, jnp.arange(SOLUTIONS, dtype=brackets.count.dtype))
    )


def _basis(rows: Float[Array, "5 9 subset"]) -> Float[Array, "4 9 subset"]:
    """Four orthonormal vectors at right angles to five rows: elimination without
    pivots, then Gram and Schmidt."""
    m = rows
    for k in range(5):
        row = m[k] / _safe(m[k, k])[None]
        this = jnp.asarray(np.arange(5) == k)[:, None, None]
        m = jnp.where(this, row[None], m - m[:, k][:, None] * row[None])
    identity = jnp.broadcast_to(
        jnp.eye(4, dtype=rows.dtype)[:, :, None], (4, 4, rows.shape[-1])
    )
    found: list[Array] = []
    for vector in jnp.concatenate([-jnp.swapaxes(m[:, 5:], 0, 1), identity], axis=1):
        for other in found:
            vector = vector - other * jnp.sum(other * vector, axis=0)[None]
        found.append(_unit(vector))
    return jnp.stack(found)


def _eliminated(m: Float[Array, "10 20 subset"]) -> Float[Array, "3 3 5 subset"]:
    """B(z) of three equations B (x, y, 1)ᵀ = 0, [equation, unknown, power of z], from
    the last six reduced rows."""
    number = jnp.arange(10)[:, None, None]

    def step(k: Int[Array, ""], m: Array) -> Array:
        row = lax.dynamic_index_in_dim(m, k, 0, keepdims=False)
        column = lax.dynamic_index_in_dim(m, k, 1, keepdims=True)
        pivot = lax.dynamic_index_in_dim(row, k, 0, keepdims=True)
        row = row / _safe(pivot)
        return jnp.where(number == k, row[None], m - column * row[None])

    reduced = lax.fori_loop(0, 10, step, m)[4:, 10:].reshape(3, 2, 10, -1)
    # ascending powers of z: rows e, f of x²z, x² (then y², xy) combine to e - z f
    parts = [reduced[:, :, i:j][:, :, ::-1] for i, j in ((0, 3), (3, 6), (6, 10))]
    columns = [jnp.pad(p, ((0, 0), (0, 0), (0, 5 - p.shape[2]), (0, 0))) for p in parts]
    b = jnp.stack(columns, axis=1)
    return b[:, :, 0] - jnp.pad(b[:, :, 1, :-1], ((0, 0), (0, 0), (1, 0), (0, 0)))


def _bracketed(c: Float[Array, "11 subset"]) -> Brackets:
    """Where the sum of c_k z^k w^(10-k) changes its sign: for z in [-1, 1] with w = 1,
    then for w with z = 1."""
    powers = jnp.asarray(POWERS, c.dtype)
    halves = [jnp.dot(powers, c), jnp.dot(powers, c[::-1])]
    low = jnp.concatenate([half[:-1] for half in halves])
    high = jnp.concatenate([half[1:] for half in halves])
    change = (low >= 0) != (high >= 0)
    ordinal = jnp.where(change, jnp.cumsum(change.astype(int), axis=0), 0)
    share = jnp.where(change, low / jnp.where(change, low - high, 1.0), 0.0)
    crossing = jnp.asarray(LEFT_EDGES, c.dtype) + share * (2 / NODES)
    return Brackets(ordinal, crossing, jnp.max(ordinal, axis=0))


def _root(
    c: Float[Array, "11 subset"], brackets: Brackets, number: Int[Array, ""]
) -> tuple[Numbers, Numbers]:
    """(z, w) of the root in the bracket of this number, by Newton's method kept in the
    bracket."""
    here = brackets.ordinal == number + 1
    second = jnp.any(here & jnp.asarray(IN_SECOND_HALF), axis=0)
    low = jnp.sum(jnp.where(here, jnp.asarray(LEFT_EDGES, c.dtype), 0.0), axis=0)
    t = jnp.sum(jnp.where(here, brackets.crossing, 0.0), axis=0)
    for _ in range(NEWTON_STEPS):
        value, slope = jnp.zeros_like(t), jnp.zeros_like(t)
        for k in reversed(range(11)):
            slope = slope * t + value
            value = value * t + jnp.where(second, c[10 - k], c[k])
        t = jnp.clip(t - value / _safe(slope), low, low + 2 / NODES)
    one = jnp.ones_like(t)
    return jnp.where(second, one, t), jnp.where(second, t, one)


def _facing(essential: Float[Array, "3 3 subset"], left: Image, right: Image):
    """Of the four orientations of E = -[b]x R the one with all points in front, and
    whether there is one (Horn 1990: cof(E) is b times a row; (b . b) R = cof(E) + [b]x
    E, and cof(E) - [b]x E for -b)."""
    columns = cofactors(essential)
    rows = jnp.swapaxes(columns, 0, 1)
    length = jnp.sum(rows * rows, axis=1)
    first = (length[:1] >= length[1:2]) & (length[:1] >= length[2:])
    base = _unit(
        jnp.where(
            first, rows[0], jnp.where(length[1:2] >= length[2:], rows[1], rows[2])
        )
    )
    # E has the length of its b, unknown here: with unit b both parts of R need the same
    # scale
    scale = jnp.sqrt(jnp.maximum(jnp.sum(essential * essential, axis=(0, 1)) / 2, TINY))
    across = cross(base[:, None], essential) * scale[None, None]
    one, other = columns + across, columns - across
    (ahead, behind), (also_ahead, also_behind) = (
        _in_front(r, base, left, right) for r in (one, other)
    )
    second = also_ahead | also_behind
    rotation = jnp.where(second[None, None], other, one) / (scale * scale)[None, None]
    turned = jnp.where(second, also_behind, behind)
    return rotation, jnp.where(turned[None], -base, base), ahead | behind | second


def _in_front(
    rotation: Float[Array, "3 3 subset"],
    base: Float[Array, "3 subset"],
    left: Image,
    right: Image,
):
    """Whether all five points lie in front of both photos with the base b, and with
    -b."""
    p1 = jnp.swapaxes(left, 0, 1)
    p2 = jnp.sum(rotation[:, :, None] * jnp.swapaxes(right, 0, 1)[None], axis=1)
    normal = cross(p1, p2)
    first = jnp.sum(cross(base[:, None], p2) * normal, axis=0)
    second = jnp.sum(cross(base[:, None], p1) * normal, axis=0)
    return jnp.all((first > 0) & (second > 0), axis=0), jnp.all(
        (first < 0) & (second < 0), axis=0
    )


def _safe(pivot: Array) -> Array:
    return jnp.where(jnp.abs(pivot) > TINY, pivot, TINY)


def _unit(vector: Float[Array, "n subset"]) -> Float[Array, "n subset"]:
    return vector * lax.rsqrt(jnp.maximum(jnp.sum(vector * vector, axis=0), TINY))[None]
