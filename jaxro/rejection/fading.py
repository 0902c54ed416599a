"""Weights that fade with the distance from the pose, for the last solution of points
that a search has kept."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..geometry.elements import RelativePose
from ..geometry.linear import linearised
from ..geometry.pairs import Pair
from ..xla.kernels import if_needed
from ..xla.passes import count, total
from .hypotheses import squares
from .robust import stepped

Use = Bool[Array, "point"]

FADING = 3.0
"""Multiple of the noise at which the weight of a point has faded to a quarter, where
the noise is not normal."""

HEAVY = 3.0
"""Standard deviations by which the mean fourth power of residuals exceeds that of
normal ones where they are none."""

LIMIT, EXPECTED, MANY = 3.3, 3.0, 20.0
"""Multiple of sigma, number of points expected within it by accident from which weights
fade, and the fewest points to estimate a noise from."""

CORE, WITHIN_CORE = 2.0, 0.774
"""Multiple of the noise within which it is estimated, and the mean square there of
normal numbers of variance 1."""

ESTIMATES, STEPS = 6, 6
"""Turns of the estimate of the noise, and steps with fading weights."""


def faded(pair: Pair, pose: RelativePose, use: Use) -> Pair:
    """The pair with weights that fade with the distance from a robust pose where the
    noise of the points in use is not normal, or wrong points among them are to be
    expected: where the mean fourth power of their residuals tells it by more than
    chance, or the points out are so many and so near that some of them agree by
    accident. The weights are those of Geman and McClure, on the scale of the noise that
    the residuals show, whatever sigma was given.

    Elsewhere the pair as it is: least squares are then best, and every point that is
    kept counts fully.
    """
    fixed = lax.stop_gradient(pair)
    k = jnp.maximum(count(use), 1.0)
    every = squares(fixed, pose)
    s = jnp.where(use, every, 0.0)
    out = fixed.mask & ~use
    near = total(jnp.where(out, LIMIT / jnp.maximum(jnp.sqrt(every), LIMIT), 0.0))
    mean, fourth = total(s) / k, total(s * s) / k
    heavy = (fourth > mean**2 * (3 + HEAVY * jnp.sqrt(24 / k))) | (
        (near > EXPECTED) & (k >= MANY)
    )
    one = jnp.ones_like(every)
    factor = if_needed(heavy, lambda needed: _factors(fixed, pose, use & needed), one)
    return Pair(
        *pair.coordinates,
        pair.sigma * factor,
        pair.mask,
        pair.focal_left,
        pair.focal_right,
    )


def _factors(pair: Pair, pose: RelativePose, use: Use) -> Float[Array, "point"]:
    """The factors of the standard deviations by which they have the weights of a
    solution with fading weights."""
    s = squares(pair, pose)
    mean = total(jnp.where(use, s, 0.0)) / jnp.maximum(count(use), 1.0)
    noise = lax.fori_loop(0, ESTIMATES, lambda _, square: _core(s, use, square), mean)
    fade = lambda s: jnp.where(use, 1 / (1 + s / (FADING**2 * noise)) ** 2, 0.0)

    def step(_, pose):
        linear = linearised(pair, pose)
        return stepped(pose, linear, linear.weight * fade(linear.squares))

    pose = lax.fori_loop(0, STEPS, step, pose)
    return jnp.where(
        use, jnp.sqrt(1 / jnp.maximum(fade(squares(pair, pose)), 1e-6)), 1.0
    )


def _core(
    s: Float[Array, "point"], use: Use, square: Float[Array, ""]
) -> Float[Array, ""]:
    """The mean square of normal noise, from the points within CORE standard deviations
    of a first value for it."""
    near = use & (s <= CORE**2 * square)
    return total(jnp.where(near, s, 0.0)) / jnp.maximum(count(near), 1.0) / WITHIN_CORE
