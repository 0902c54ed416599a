"""Random subsets of a few points of a pair, the same for every pair and whatever its
padding, and how many of them are enough."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, ScalarLike

from ..geometry.pairs import Pair

CERTAIN = 1e-12
"""No share of good subsets is taken as nearer to 0 or 1 than this."""


def draw(
    size: int, block: int, count: int, seed: int
) -> Float[Array, "block n subset"]:
    """Uniform random numbers for `count` subsets of `size` points, in blocks."""
    shape = -(-count // block), size, block
    return jnp.asarray(np.random.default_rng(seed).random(shape, np.float32))


def choose_places(
    uniform: Float[Array, "n subset"], of: Float[Array, ""]
) -> Int[Array, "n subset"]:
    """n different numbers below `of` for each subset, every choice equally likely.

    Floyd's algorithm: each number is drawn from one number more than the one before,
    and is the new one where it would repeat another.
    """
    taken: list = []
    for j in reversed(range(uniform.shape[0])):
        last = jnp.maximum(of.astype(uniform.dtype) - j, 1.0) - 1
        number = jnp.minimum(jnp.floor(uniform[j] * (last + 1)), last)
        repeats = jnp.zeros(number.shape, bool)
        for other in taken:
            repeats = repeats | (number == other)
        taken.append(jnp.where(repeats, last, number))
    return jnp.stack(taken).astype(jnp.int32)


def move_up(
    pair: Pair, values: Float[Array, "point ..."], fill: ScalarLike = 0.0
) -> Float[Array, "point ..."]:
    """The values of the points that take part, moved before all others, so that padding
    changes no subset."""
    places = len(values)
    place = jnp.where(pair.mask, jnp.cumsum(pair.mask) - 1, places)
    return jnp.full_like(values, fill).at[place].set(values, mode="drop")


def move_up_coordinates(pair: Pair) -> Float[Array, "point 4"]:
    """The coordinates of the points that take part, before all others."""
    return move_up(pair, jnp.stack(pair.coordinates, axis=-1))


def take_points(
    pair: Pair, rows: Float[Array, "point 4"], places: Int[Array, "n subset"]
) -> Pair:
    """The subsets as a batch of pairs of n points, of unit weight."""
    few = rows.at[places.T].get(mode="clip")
    x_left, y_left, x_right, y_right = (few[:, :, k] for k in range(4))
    each = few.shape[:1]
    return Pair(
        x_left=x_left,
        y_left=y_left,
        x_right=x_right,
        y_right=y_right,
        sigma=jnp.ones_like(x_left),
        mask=jnp.ones(x_left.shape, bool),
        focal_left=jnp.broadcast_to(pair.focal_left, each),
        focal_right=jnp.broadcast_to(pair.focal_right, each),
    )


def subsets_enough(
    agree: Float[Array, ""],
    of: Float[Array, ""],
    size: int,
    confidence: ScalarLike,
    luck: ScalarLike = 1.0,
) -> Float[Array, ""]:
    """How many subsets of `size` points hold one of agreeing points alone with
    probability `confidence`: k with 1 - (1 - p / luck)^k = confidence, p the share of
    such subsets, of which one in `luck` is of use."""
    share = math.prod(
        jnp.maximum(agree - k, 0.0) / jnp.maximum(of - k, 1.0) for k in range(size)
    )
    share = jnp.clip(share / luck, CERTAIN, 1 - CERTAIN)
    return jnp.log1p(jnp.negative(confidence)) / jnp.log1p(-share)
