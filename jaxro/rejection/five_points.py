"""The orientations of many subsets of five points, solved together: the hypotheses of
`search`.

The equations, and the functions for them, are those of `orientation.starts.five_point`
(Nister 2004), which finds every solution exactly. A search can do without some
solutions if the others come sooner, so that three steps differ here. The null space and
the cubics are eliminated without pivots. The real roots of the polynomial of degree ten
are sought where it changes its sign between 2 NODES places of the projective line, so
that two roots that lie closer together are lost: one subset of seven loses the right
orientation. The solutions are not polished: they are right to some thousandths.

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
    equations_in_z,
    essential_coefficients,
)
from ..orientation.starts.problems_last import cross, merging_last

SOLUTIONS = 10
"""Real solutions that five points may have."""

NODES = 32
"""Intervals on each half of the projective line: |z| <= |w|, and |z| > |w|."""

NEWTON_STEPS = 3

TINY = 1e-30
"""No pivot and no squared length is taken as smaller than this."""

WIDTH = 2 / NODES
EDGES = np.linspace(-1, 1, NODES + 1)
POWERS = EDGES[:, None] ** np.arange(11)
LEFT_EDGES = np.concatenate([EDGES[:-1], EDGES[:-1]])[:, None]
IN_SECOND_HALF = (np.arange(2 * NODES) >= NODES)[:, None]

Image = Float[Array, "5 3 subset"]
Numbers = Float[Array, " subset"]


class Solutions(NamedTuple):
    """Orientations by solution and subset; `exist`: which of them are solutions with
    all five points in front of both photos."""

    rotation: Float[Array, "solution 3 3 subset"]
    base: Float[Array, "solution 3 subset"]
    exist: Bool[Array, "solution subset"]


class Brackets(NamedTuple):
    """The intervals in which the polynomial changes its sign: their ordinal numbers
    from 1 (0: no change), the zero of the chord over each, and how many there are."""

    ordinal: Int[Array, "interval subset"]
    crossing: Float[Array, "interval subset"]
    count: Int[Array, " subset"]


@merging_last
def solve(left: Image, right: Image) -> Solutions:
    """The orientations of five points with image vectors (x/f, y/f, -1)."""
    products = left[:, :, None] * right[:, None]
    basis = _basis(products.reshape(5, 9, -1)).reshape(4, 3, 3, -1)
    equations = _eliminate(constraints(basis))
    polynomial = determinant(equations)
    brackets = _bracket(polynomial)

    def solution(number: Int[Array, ""]) -> Solutions:
        z, w = _root(polynomial, brackets, number)
        coefficients = essential_coefficients(equations, z[None], w[None])[:, 0]
        essential = jnp.sum(basis * coefficients[:, None, None], axis=0)
        rotation, base, in_front = _facing(essential, left, right)
        exist = in_front & (number < brackets.count)
        return Solutions(rotation, base, exist)

    numbers = jnp.arange(SOLUTIONS, dtype=brackets.count.dtype)
    return lax.map(solution, numbers)


def _basis(rows: Float[Array, "5 9 subset"]) -> Float[Array, "4 9 subset"]:
    """Four orthonormal vectors at right angles to five rows: elimination without
    pivots, then Gram and Schmidt."""
    m = rows
    for k in range(5):
        row = m[k] / _safe(m[k, k])[None]
        this = jnp.asarray(np.arange(5) == k)[:, None, None]
        others = m - m[:, k][:, None] * row[None]
        m = jnp.where(this, row[None], others)
    bound = -jnp.swapaxes(m[:, 5:], 0, 1)
    free = jnp.eye(4, dtype=rows.dtype)[:, :, None]
    free = jnp.broadcast_to(free, (4, 4, rows.shape[-1]))
    found: list[Array] = []
    for vector in jnp.concatenate([bound, free], axis=1):
        for other in found:
            along = jnp.sum(other * vector, axis=0)
            vector = vector - other * along[None]
        found.append(_unit(vector))
    return jnp.stack(found)


def _eliminate(m: Float[Array, "10 20 subset"]) -> Float[Array, "3 3 5 subset"]:
    """B(z) of `equations_in_z`, by elimination without pivots."""
    number = jnp.arange(10)[:, None, None]

    def step(k: Int[Array, ""], m: Array) -> Array:
        row = lax.dynamic_index_in_dim(m, k, 0, keepdims=False)
        column = lax.dynamic_index_in_dim(m, k, 1, keepdims=True)
        pivot = lax.dynamic_index_in_dim(row, k, 0, keepdims=True)
        row = (row / _safe(pivot))[None]
        others = m - column * row
        return jnp.where(number == k, row, others)

    reduced = lax.fori_loop(0, 10, step, m)
    return equations_in_z(reduced[4:, 10:])


def _bracket(c: Float[Array, "11 subset"]) -> Brackets:
    """Where the sum of c_k z^k w^(10-k) changes its sign: for z in [-1, 1] with w = 1,
    then for w in [-1, 1] with z = 1."""
    powers = jnp.asarray(POWERS, c.dtype)
    first = jnp.dot(powers, c)
    second = jnp.dot(powers, c[::-1])
    low = jnp.concatenate([first[:-1], second[:-1]])
    high = jnp.concatenate([first[1:], second[1:]])
    change = (low >= 0) != (high >= 0)
    ordinal = jnp.where(change, jnp.cumsum(change.astype(int), axis=0), 0)
    fall = jnp.where(change, low - high, 1.0)
    share = jnp.where(change, low / fall, 0.0)
    return Brackets(
        ordinal=ordinal,
        crossing=jnp.asarray(LEFT_EDGES, c.dtype) + share * WIDTH,
        count=jnp.max(ordinal, axis=0),
    )


def _root(
    c: Float[Array, "11 subset"], brackets: Brackets, number: Int[Array, ""]
) -> tuple[Numbers, Numbers]:
    """(z, w) of the root in the bracket of this number, by Newton's method kept in the
    bracket."""
    here = brackets.ordinal == number + 1
    pick = lambda values: jnp.sum(jnp.where(here, values, 0.0), axis=0)
    second = jnp.any(here & jnp.asarray(IN_SECOND_HALF), axis=0)
    low = pick(jnp.asarray(LEFT_EDGES, c.dtype))
    t = pick(brackets.crossing)
    ascending = [jnp.where(second, c[10 - k], c[k]) for k in range(11)]
    for _ in range(NEWTON_STEPS):
        value, slope = jnp.zeros_like(t), jnp.zeros_like(t)
        for coefficient in reversed(ascending):
            slope = slope * t + value
            value = value * t + coefficient
        step = value / _safe(slope)
        t = jnp.clip(t - step, low, low + WIDTH)
    one = jnp.ones_like(t)
    return jnp.where(second, one, t), jnp.where(second, t, one)


def _facing(
    essential: Float[Array, "3 3 subset"], left: Image, right: Image
) -> tuple[Array, Array, Array]:
    """Of the four orientations of E = -[b]x R the one with all points in front, and
    whether there is one.

    Horn (1990): cof(E) is b times a row; (b . b) R = cof(E) + [b]x E, and cof(E) - [b]x
    E for -b.
    """
    columns = cofactors(essential)
    base = _longest_row(columns)
    # E has the length of its b, unknown here: with unit b both parts of R need the same
    # scale
    half = jnp.sum(essential * essential, axis=(0, 1)) / 2
    scale = jnp.sqrt(jnp.maximum(half, TINY))
    across = cross(base[:, None], essential) * scale[None, None]
    one = columns + across
    other = columns - across
    ahead, behind = _in_front(one, base, left, right)
    also_ahead, also_behind = _in_front(other, base, left, right)
    second = also_ahead | also_behind
    rotation = jnp.where(second[None, None], other, one)
    rotation = rotation / (scale * scale)[None, None]
    turned = jnp.where(second, also_behind, behind)
    base = jnp.where(turned[None], -base, base)
    return rotation, base, ahead | behind | second


def _longest_row(columns: Float[Array, "3 3 subset"]) -> Float[Array, "3 subset"]:
    """The longest of three rows, given as columns, as a unit vector."""
    rows = jnp.swapaxes(columns, 0, 1)
    one, two, three = jnp.sum(rows * rows, axis=1, keepdims=True)
    first = (one >= two) & (one >= three)
    other = jnp.where(two >= three, rows[1], rows[2])
    return _unit(jnp.where(first, rows[0], other))


def _in_front(
    rotation: Float[Array, "3 3 subset"],
    base: Float[Array, "3 subset"],
    left: Image,
    right: Image,
) -> tuple[Bool[Array, " subset"], Bool[Array, " subset"]]:
    """Whether all five points lie in front of both photos with the base b, and with
    -b."""
    p1 = jnp.swapaxes(left, 0, 1)
    p2 = jnp.swapaxes(right, 0, 1)
    p2 = jnp.sum(rotation[:, :, None] * p2[None], axis=1)
    normal = cross(p1, p2)
    depth = lambda ray: jnp.sum(cross(base[:, None], ray) * normal, axis=0)
    first, second = depth(p2), depth(p1)
    ahead = (first > 0) & (second > 0)
    behind = (first < 0) & (second < 0)
    return jnp.all(ahead, axis=0), jnp.all(behind, axis=0)


def _safe(pivot: Array) -> Array:
    return jnp.where(jnp.abs(pivot) > TINY, pivot, TINY)


def _unit(vector: Float[Array, "n subset"]) -> Float[Array, "n subset"]:
    square = jnp.sum(vector * vector, axis=0)
    return vector * lax.rsqrt(jnp.maximum(square, TINY))[None]
