"""Identification of wrong points: how large an error of a coordinate must be to be found,
and to be attributed to its own point (`statistics.identification`).

Everything is of first order, at the measured coordinates, with a known sigma0.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, ScalarLike

from ..adjustment import critical_values as critical
from ..geometry.linear import Linear, Values, linearise
from ..geometry.pairs import Coordinates, Pair, mask_unusable
from ..orientation.orient import Orientation
from ..statistics import identification
from ..statistics.explanations import DOUBT
from ..statistics.identification import Chances
from ..statistics.normalised import Normalised
from .correlations import normalise


class Identification(eqx.Module):
    """The smallest errors of a pair that would be found, and those that would be
    attributed to their point; zero or False where masked.

    `tested`: points that others check. `partner`: the point with which a point is
    confused most easily, the one with the largest |rho|; `correlation`: this rho.
    `limit` of |w|. Two sizes of errors in standard deviations of w: an error in a point
    makes its |w| exceed the limit with the wanted power if it is `found` large, and is
    identified with this power if it is `identified` large. `detectable` and
    `identifiable`: the same errors of the coordinates (x_left, y_left, x_right,
    y_right) in their unit; infinite where an error does not show, or is never
    attributed to its point.
    """

    tested: Bool[Array, "point"]
    partner: Int[Array, "point"]
    correlation: Values
    limit: Float[Array, ""]
    found: Float[Array, ""]
    identified: Values
    detectable: Coordinates
    identifiable: Coordinates


def correlations(pair: Pair, orientation: Orientation) -> Float[Array, "point point"]:
    """Correlations of the w of all points of one pair; zero where a point is masked or
    not checked by others."""
    return _read(pair, orientation).known.matrix()


def identify(
    pair: Pair,
    orientation: Orientation,
    key: PRNGKeyArray,
    *,
    sigma0: ArrayLike = 1.0,
    level: ScalarLike = 0.001,
    power: ScalarLike = 0.80,
    familywise: bool = False,
    doubt: ScalarLike = DOUBT,
    draws: int = 4096,
) -> Identification:
    """The minimal detectable and the minimal identifiable errors of one pair at its
    orientation.

    `sigma0`: the standard deviation of unit weight: 1 where pair.sigma are the standard
    deviations. `level` of the test of each point, or (`familywise`) of all together.
    `doubt` as in `undecided`: 1 if the largest |w| alone decides. `draws` of all
    residuals: with 4,096 the power of the identifiable errors is right to 0.005; the
    work is draws × points². Under jit and vmap the options but sigma0 and the key are
    static.
    """
    pair, linear, known = _read(pair, orientation)
    how = {"level": level, "power": power, "familywise": familywise, "doubt": doubt}
    sizes = identification.identify(known, key, draws=draws, **how)
    per_coordinate = lambda delta: _of_coordinates(pair, linear, known, delta, sigma0)
    return Identification(
        tested=sizes.tested,
        partner=sizes.partner,
        correlation=sizes.correlation,
        limit=sizes.limit,
        found=sizes.found,
        identified=jnp.where(pair.mask, sizes.identified, 0.0),
        detectable=per_coordinate(jnp.ones_like(known.w) * sizes.found),
        identifiable=per_coordinate(jnp.where(known.tested, sizes.identified, 1.0)),
    )


def chances(
    pair: Pair,
    orientation: Orientation,
    key: PRNGKeyArray,
    *,
    size: ArrayLike,
    coordinate: int = 3,
    sigma0: ArrayLike = 1.0,
    level: ScalarLike = 0.001,
    familywise: bool = False,
    doubt: ScalarLike = DOUBT,
    draws: int = 4096,
) -> Chances:
    """What becomes of an error of given size in one point, for every point in turn, by
    simulation of the w.

    `size`: in the unit of the coordinates, one or one per point, of the `coordinate` (0
    to 3: x_left, y_left, x_right, y_right). Other arguments as of `identify`.
    """
    _, linear, known = _read(pair, orientation)
    size = jnp.broadcast_to(jnp.asarray(size, float), known.w.shape)
    root = jnp.sqrt(linear.weight * known.redundancy)
    delta = linear.gradient[coordinate] * size * root / jnp.asarray(sigma0)
    how = {"level": level, "familywise": familywise, "doubt": doubt}
    return identification.chances(known, key, delta, draws=draws, **how)


class _Read(NamedTuple):
    pair: Pair
    linear: Linear
    known: Normalised


def _read(pair: Pair, orientation: Orientation) -> _Read:
    """The cleaned pair, its conditions at the orientation, and its normalised
    residuals."""
    if pair.x_left.ndim != 1:
        raise ValueError(
            f"one pair is wanted, but the coordinates have shape {pair.x_left.shape}: "
            "use jax.vmap"
        )
    pair, _ = mask_unusable(pair)
    linear = linearise(pair, orientation.pose)
    return _Read(pair, linear, normalise(linear, pair.mask & orientation.usable))


def _of_coordinates(
    pair: Pair, linear: Linear, known: Normalised, delta: Values, sigma0: ArrayLike
) -> Coordinates:
    """Errors of the coordinates that move w by delta: delta sigma0 sigma / sqrt(r_k),
    r_k = r B_k² Q_k / D the redundancy number of the coordinate."""

    def size(b: Values) -> Values:
        part = b**2 * pair.sigma**2 * linear.weight * known.redundancy
        seen = known.tested & (part > critical.UNTESTABLE)
        root = jnp.sqrt(jnp.where(seen, part, 1.0))
        error = delta * jnp.asarray(sigma0) * pair.sigma / root
        return jnp.where(pair.mask, jnp.where(seen, error, jnp.inf), 0.0)

    return tuple(size(b) for b in linear.gradient)
