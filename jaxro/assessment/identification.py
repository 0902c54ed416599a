"""Identification: how large an error must be to be attributed to its own point.

An error that moves w_i by delta moves the w of the other points by rho_ij delta. Point
i is *identified* by a test if it is the only point that is named (see `undecided`):
|w_i| exceeds the limit, no other |w| is larger, and no other point explains the misfit
as well. With x = w_i and v_j normal, independent of x, w_j = rho x + sqrt(1 - rho²)
v_j, so that for a positive error all of this is

    x > limit,    x > sqrt((1 + rho) / (1 - rho)) v_j,    x > -sqrt((1 - rho) / (1 + rho)) v_j,
    x > (k + rho v_j) / sqrt(1 - rho²),

k the normal value of `doubt`. With X the largest right-hand side, P(i is identified) is
the mean of Φ(delta - X) over the v. The *minimal identifiable error* is the delta for
which this mean is the wanted power, as the minimal detectable error (Baarda 1968) is
the delta for which P(|w_i| > limit) is. With doubt = 1 it is the minimal identifiable
bias of the largest |w| (Teunissen 2018; Rofatto et al. 2020). It is infinite where
|rho| = 1.

Everything is of first order, at the measured coordinates, with a known sigma0.
Probabilities that depend on several residuals are simulated from a key, with the same
draws for all points.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import ndtr
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, ScalarLike

from ..adjustment import critical_values as critical
from ..adjustment.bisection import bisect
from ..geometry.linear import Linear, Values, linearise
from ..geometry.pairs import Coordinates, Pair, mask_unusable
from ..orientation.orient import Orientation
from .correlations import Normalised, normalise
from .familywise import largest_w
from .undecided import DOUBT, explanations

HALVINGS = 50
"""Of the interval in which the size of an error is sought."""

SAME = 1e-6
"""1 - |rho| below which nothing tells two points apart."""


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


class Chances(eqx.Module):
    """Probabilities of what becomes of an error in each point: one point is named, the
    right one (`correct`) or another one (`wrong`); several points are named, the right
    one among them (`undecided`) or not (`misled`); or none is named (`missed`). They
    add up to 1; zero where a point is not tested."""

    correct: Values
    wrong: Values
    undecided: Values
    misled: Values
    missed: Values


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
    limit = _limit(known, level, familywise)
    found = jnp.asarray(critical.delta_normal(2 * ndtr(-limit), power))
    errors = _draw_errors(known, key, draws)
    correlation, partner = _partners(known)

    def size(point: Int[Array, ""]) -> Float[Array, ""]:
        least, able = _least(known, errors, point, limit, doubt)
        return _size(least, jnp.asarray(power, float), able)

    sizes = lax.map(size, jnp.arange(known.w.shape[0]))
    identified = jnp.where(known.tested, sizes, jnp.inf)
    per_coordinate = lambda delta: _of_coordinates(pair, linear, known, delta, sigma0)
    return Identification(
        tested=known.tested,
        partner=partner,
        correlation=correlation,
        limit=limit,
        found=found,
        identified=jnp.where(pair.mask, identified, 0.0),
        detectable=per_coordinate(jnp.ones_like(known.w) * found),
        identifiable=per_coordinate(jnp.where(known.tested, sizes, 1.0)),
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
    limit = _limit(known, level, familywise)
    size = jnp.broadcast_to(jnp.asarray(size, float), known.w.shape)
    root = jnp.sqrt(linear.weight * known.redundancy)
    delta = linear.gradient[coordinate] * size * root / jnp.asarray(sigma0)
    errors = _draw_errors(known, key, draws)

    def with_error(point: Int[Array, ""]) -> tuple[Float[Array, ""], ...]:
        own = jnp.arange(known.w.shape[0]) == point
        shift = known.row(point) * jnp.sum(jnp.where(own, delta, 0.0))
        outcomes = jax.vmap(lambda w: _judge(known, w + shift, own, limit, doubt))
        tested = jnp.any(own & known.tested)
        share = lambda happened: jnp.mean(happened.astype(float))
        return jax.tree.map(
            lambda happened: jnp.where(tested, share(happened), 0.0), outcomes(errors)
        )

    correct, wrong, undecided, misled, missed = lax.map(
        with_error, jnp.arange(known.w.shape[0])
    )
    return Chances(
        correct=correct, wrong=wrong, undecided=undecided, misled=misled, missed=missed
    )


def _judge(
    known: Normalised,
    w: Values,
    own: Bool[Array, "point"],
    limit: Array,
    doubt: ScalarLike,
) -> tuple[Bool[Array, ""], ...]:
    """Which of the fields of `Chances` happens with these w, if the error is in the
    `own` point: exactly one is True."""
    size = jnp.abs(w)
    named = explanations(known._replace(w=w), jnp.argmax(size), doubt)
    found = jnp.max(size) > limit
    alone, among = jnp.sum(named) == 1, jnp.any(named & own)
    correct, wrong = found & among & alone, found & ~among & alone
    several, misled = found & among & ~alone, found & ~among & ~alone
    return correct, wrong, several, misled, ~found


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


def _limit(known: Normalised, level: ScalarLike, familywise: bool) -> Float[Array, ""]:
    if familywise:
        return largest_w(level, known)
    return critical.normal(level) + 0 * known.squares


def _draw_errors(
    known: Normalised, key: PRNGKeyArray, draws: int
) -> Float[Array, "draw point"]:
    """The w of errorless pairs."""
    root = jnp.sqrt(jnp.where(known.tested, known.redundancy, 1.0))
    noise = jax.random.normal(key, (draws, known.w.shape[0]), float)
    along = noise @ (known.basis * root[:, None])
    w = noise / root[None, :] - along @ known.basis.T
    return jnp.where(known.tested[None, :], w, 0.0)


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


def _partners(known: Normalised) -> tuple[Values, Int[Array, "point"]]:
    """The correlation largest in size of each point with another, and that other
    point."""
    points = jnp.arange(known.w.shape[0])

    def partner(point: Int[Array, ""]):
        rho = jnp.where(points == point, 0.0, known.row(point))
        other = jnp.argmax(jnp.abs(rho))
        return rho[other], other

    return lax.map(partner, points)


def _least(
    known: Normalised,
    errors: Float[Array, "draw point"],
    point: Int[Array, ""],
    limit: Array,
    doubt: ScalarLike,
) -> tuple[Float[Array, "draw"], Bool[Array, ""]]:
    """X of every draw, and whether any size of error can be told from one in another
    point."""
    own = jnp.arange(known.w.shape[0]) == point
    others = known.tested & ~own
    rho = jnp.where(others, known.row(point), 0.0)[None, :]
    across = jnp.sqrt(jnp.maximum(1 - rho**2, SAME))
    w_own = jnp.sum(jnp.where(own[None, :], errors, 0.0), axis=1)
    v = (errors - rho * w_own[:, None]) / across
    larger = jnp.sqrt((1 + rho) / jnp.maximum(1 - rho, SAME)) * v
    smaller = -jnp.sqrt((1 - rho) / jnp.maximum(1 + rho, SAME)) * v
    in_doubt = (critical.normal(doubt) + rho * v) / across
    needed = jnp.maximum(jnp.maximum(larger, smaller), in_doubt)
    needed = jnp.max(jnp.where(others[None, :], needed, -jnp.inf), axis=1)
    return jnp.maximum(needed, limit), jnp.all(jnp.abs(rho) < 1 - SAME)


def _size(
    least: Float[Array, "draw"], power: Array, able: Bool[Array, ""]
) -> Float[Array, ""]:
    """delta with mean Φ(delta - X) = power; infinite where it is not able."""
    enough = lambda delta: jnp.mean(ndtr(delta - least)) >= power
    most = jnp.max(least) + 9
    delta = bisect(enough, most * 0, most, HALVINGS)
    return jnp.where(able, delta, jnp.inf)
