"""Gauss-Newton steps of one pose, by which all searches improve what they find.

A step minimises Σ p g², g the coplanarity conditions linearised at the pose, p any
weights. Searches differ in the weights alone: ones that fall with the distance r from
the pose (`step_by_weights`), points in use (`improve`), or points within a limit
(`improve_within`).
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree, ScalarLike

from ..adjustment.normal_equations import accumulate, solve
from ..geometry.elements import RelativePose, vertical
from ..geometry.linear import Linear, linearise
from ..geometry.pairs import Pair
from .masked import Use, Values

LONGEST = 0.3
"""The longest component of a step (rad)."""


NARROWER, NARROWINGS = 0.7, 12
"""The factor by which the limit narrows in two steps, and the number of steps: down to
an eighth."""


def take_step(pose: RelativePose, linear: Linear, weight: Values) -> RelativePose:
    """The pose after one step with these weights in place of those of `linear`, no
    component longer than LONGEST. A step that is no number is not taken."""
    n, h = normal_equations(linear, weight)
    delta = solve(n, h)
    longest = delta[0] * 0
    for component in delta:
        longest = jnp.maximum(longest, jnp.abs(component))
    safe = jnp.maximum(longest, jnp.finfo(longest.dtype).tiny)
    shrink = jnp.minimum(1.0, LONGEST / safe)
    shrink = jnp.where(jnp.isfinite(longest), shrink, 0.0)
    finite = lambda a: jnp.where(jnp.isfinite(a), a, 0.0)
    moved = pose.move(tuple(finite(-shrink * d) for d in delta))
    return moved.normalise()


def normal_equations(linear: Linear, weight: Values) -> tuple:
    """N = AᵀPA and h = AᵀPg of a linearised pair with these weights."""
    columns = [[column] for column in linear.columns]
    n, h, _ = accumulate([linear.g], columns, [weight])
    return n, h


def inner(one: Sequence[Values], other: Sequence[Float[Array, "..."]]) -> Values:
    """The scalar product of two vectors, of every point; `other` may be one vector for
    all points."""
    product = one[0] * other[0]
    for a, b in zip(one[1:], other[1:], strict=True):
        product = product + a * b
    return product


def improve(pair: Pair, pose: RelativePose, use: Use) -> RelativePose:
    """The pose after one step of least squares on the points in use."""
    linear = linearise(pair, pose)
    return take_step(pose, linear, jnp.where(use, linear.weight, 0.0))


def improve_within(
    pair: Pair, pose: RelativePose, limit: ScalarLike, margin: ScalarLike, steps: int
) -> RelativePose:
    """The pose after steps on the points with |r| <= margin limit sigma, the last one
    on those with |r| <= limit sigma."""

    def step(k, pose):
        width = limit * jnp.where(k < steps - 1, margin, 1.0)
        linear = linearise(pair, pose)
        near = linear.squares <= width**2
        return take_step(pose, linear, jnp.where(near, linear.weight, 0.0))

    return lax.fori_loop(0, steps, step, pose)


def step_by_weights(
    pair: Pair, pose: RelativePose, weight: Callable[[Values], Values]
) -> RelativePose:
    """The pose after one step in which each point counts by weight((r / sigma)²)."""
    linear = linearise(pair, pose)
    return take_step(pose, linear, linear.weight * weight(linear.squares))


def geman_mcclure(squares: Values, variance: Float[Array, ""] | float) -> Values:
    """The weights of Geman and McClure (1985), (k² / (k² + s))², of squared residuals
    s; `variance` = k². They fall to a quarter at s = k²."""
    return (variance / (variance + squares)) ** 2


def narrow(pair: Pair, pose: RelativePose, limit: ScalarLike) -> RelativePose:
    """The pose that the points near it lead to, as the limit within which they count
    narrows (weights of Geman and McClure): where sigma is too large, wrong points
    within the limit hide the right pose from a search."""

    def step(pose, k):
        width = limit * NARROWER ** (k / 2)
        weight = lambda s: geman_mcclure(s, width**2)
        return step_by_weights(pair, pose, weight), None

    steps = jnp.arange(NARROWINGS, dtype=pair.focal_left.dtype)
    return lax.scan(step, pose, steps)[0]


def from_vertical(pair: Pair, steps: int) -> RelativePose:
    """All points by steps of least squares from the vertical."""
    start = vertical(jnp.zeros_like(pair.focal_left))
    step = lambda _, pose: improve(pair, pose, pair.mask)
    return lax.fori_loop(0, steps, step, start)


def in_single(tree: PyTree) -> PyTree:
    """The tree with its floating-point numbers in single precision."""

    def single(a):
        floating = jnp.issubdtype(a.dtype, jnp.floating)
        return a.astype(jnp.float32) if floating else a

    return jax.tree.map(single, tree)
