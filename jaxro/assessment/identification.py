"""Identification: not only that an error is found, but in which point.

An error that moves w_i by delta moves the w of the other points by rho_ij delta. Point
i is *identified* by a test if it is the one point that is named
(`rejection.undecided`): |w_i| exceeds the limit, no other |w| is larger, and no other
point explains the misfit as well. With x = w_i and v_j normal, independent of x, w_j =
rho x + sqrt(1 - rho²) v_j, so that for a positive error all of this is

    x > limit,    x > sqrt((1 + rho) / (1 - rho)) v_j,    x > -sqrt((1 - rho) / (1 + rho)) v_j,
    x > (k + rho v_j) / sqrt(1 - rho²),

k the normal value of `doubt`. With X the largest right-hand side, P(i is identified) is
the mean of Φ(delta - X) over the v. The *minimal identifiable error* is that of which
the mean is the wanted power, as the minimal detectable error (Baarda 1968) is that of
which P(|w_i| > limit) is. With doubt = 1 it is the minimal identifiable bias of the
largest |w| (Teunissen 2018; Rofatto et al. 2020). It is infinite where |rho| = 1.

All is of first order, at the measured coordinates, with a known sigma0. What depends on
several residuals at once is simulated from a key, with the same draws for all points.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import ndtr
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from ..adjustment import critical_values as critical
from ..geometry.linear import linearised
from ..geometry.pairs import Coordinates, Pair, mask_unusable
from ..orientation.result import Orientation
from .correlations import Normalised, normalised
from .familywise import largest_w
from .undecided import DOUBT, explaining

PerPoint = Float[Array, "point"]

HALVINGS = 50
"""Of the interval in which the size of an error is sought."""

SAME = 1e-6
"""1 - |rho| below which nothing tells two points apart."""


class Identification(eqx.Module):
    """Which errors of a pair could be found, and which attributed to their point; zero
    or False where masked.

    `tested`: points that others check. `partner`: the point with which a point is
    confused most easily, that of the largest |rho|, and this `correlation`, with its
    sign. `limit`: of |w|. Sizes of errors in units of the standard deviation of w:
    `found` with the power wanted in the point itself, and `identified` with it.
    `detectable` and `identifiable`: the same errors of the coordinates (x_left, y_left,
    x_right, y_right) in their unit; infinite where an error shows nowhere, or has no
    size at which it is attributed to its point.
    """

    tested: Bool[Array, "point"]
    partner: Int[Array, "point"]
    correlation: PerPoint
    limit: Float[Array, ""]
    found: Float[Array, ""]
    identified: PerPoint
    detectable: Coordinates
    identifiable: Coordinates


class Chances(eqx.Module):
    """Of an error in each point: how often it is attributed to its point (`correct`),
    to another one (`wrong`), to several of which it is one (`undecided`) or not one
    (`misled`), or nothing is found (`missed`). They add up to 1; zero where a point is
    not tested."""

    correct: PerPoint
    wrong: PerPoint
    undecided: PerPoint
    misled: PerPoint
    missed: PerPoint


def correlations(pair: Pair, orientation: Orientation) -> Float[Array, "point point"]:
    """Correlations of the w of all points of one pair; zero where a point is masked or
    not checked by others."""
    return _normalised(pair, orientation)[1].matrix()


def identify(
    pair: Pair,
    orientation: Orientation,
    key: PRNGKeyArray,
    *,
    sigma0: ArrayLike = 1.0,
    level: float = 0.001,
    power: float = 0.80,
    familywise: bool = False,
    doubt: float = DOUBT,
    draws: int = 4096,
) -> Identification:
    """The minimal detectable beside the minimal identifiable errors of one pair at its
    orientation.

    `sigma0`: the standard deviation of unit weight: 1 where pair.sigma are the standard
    deviations. `level` of the test of each point, or (`familywise`) of all together.
    `doubt`: of the points that are named together, 1 if the largest |w| alone decides.
    `draws` of all residuals: with 4,096 the power of the identifiable errors is right
    to 0.005; the work is draws × points². Under jit and vmap the options but sigma0 and
    the key are static.
    """
    pair, known = _normalised(pair, orientation)
    limit = _limit(known, level, familywise)
    found = critical.delta_normal(2 * ndtr(-limit), power)
    errors = _errors(known, key, draws)
    correlation, partner = _partners(known)

    def size(point: Int[Array, ""]) -> Float[Array, ""]:
        least, able = _least(known, errors, point, limit, doubt)
        return _size(least, jnp.asarray(power, float), able)

    identified = lax.map(size, jnp.arange(known.w.shape[0]))
    linear = linearised(pair, orientation.pose)

    def of_coordinates(delta: PerPoint) -> Coordinates:
        """delta sigma0 sigma / sqrt(r_k), r_k = r B_k² Q_k / D the redundancy number of
        the coordinate."""

        def one(b: PerPoint) -> PerPoint:
            part = b**2 * pair.sigma**2 * linear.weight * known.redundancy
            seen = known.tested & (part > SAME)
            size = (
                delta
                * jnp.asarray(sigma0)
                * pair.sigma
                / jnp.sqrt(jnp.where(seen, part, 1.0))
            )
            return jnp.where(pair.mask, jnp.where(seen, size, jnp.inf), 0.0)

        return tuple(one(b) for b in linear.gradient)

    return Identification(
        tested=known.tested,
        partner=partner,
        correlation=correlation,
        limit=limit,
        found=found,
        identified=jnp.where(
            known.tested, identified, jnp.where(pair.mask, jnp.inf, 0.0)
        ),
        detectable=of_coordinates(jnp.full_like(known.w, 1.0) * found),
        identifiable=of_coordinates(jnp.where(known.tested, identified, 1.0)),
    )


def chances(
    pair: Pair,
    orientation: Orientation,
    key: PRNGKeyArray,
    *,
    size: ArrayLike,
    coordinate: int = 3,
    sigma0: ArrayLike = 1.0,
    level: float = 0.001,
    familywise: bool = False,
    doubt: float = DOUBT,
    draws: int = 4096,
) -> Chances:
    """What becomes of an error of given size in one point, for every point in turn, by
    simulation of the w.

    `size`: in the unit of the coordinates, one or one per point, of the `coordinate` (0
    to 3: x_left, y_left, x_right, y_right). Other arguments as of `identify`.
    """
    pair, known = _normalised(pair, orientation)
    linear = linearised(pair, orientation.pose)
    limit = _limit(known, level, familywise)
    jump = linear.gradient[coordinate] * jnp.broadcast_to(
        jnp.asarray(size, float), known.w.shape
    )
    delta = jump * jnp.sqrt(linear.weight * known.redundancy) / jnp.asarray(sigma0)
    errors = _errors(known, key, draws)

    def one(point: Int[Array, ""]) -> tuple[Float[Array, ""], ...]:
        own = jnp.arange(known.w.shape[0]) == point
        shift = known.row(point) * jnp.sum(jnp.where(own, delta, 0.0))

        def outcome(w: PerPoint) -> tuple[Bool[Array, ""], ...]:
            w = w + shift
            largest = jnp.argmax(jnp.abs(w))
            named = explaining(known._replace(w=w), largest, doubt)
            found = jnp.max(jnp.abs(w)) > limit
            alone, among = jnp.sum(named) == 1, jnp.any(named & own)
            right, several, other = (
                found & alone & among,
                found & ~alone & among,
                found & ~among,
            )
            return right, other & alone, several, other & ~alone, ~found

        tested = jnp.any(own & known.tested)
        share = lambda happened: jnp.where(
            tested, jnp.mean(happened.astype(float)), 0.0
        )
        return jax.tree.map(share, jax.vmap(outcome)(errors))

    correct, wrong, undecided, misled, missed = lax.map(
        one, jnp.arange(known.w.shape[0])
    )
    return Chances(
        correct=correct, wrong=wrong, undecided=undecided, misled=misled, missed=missed
    )


def _normalised(pair: Pair, orientation: Orientation) -> tuple[Pair, Normalised]:
    if pair.x_left.ndim != 1:
        raise ValueError(
            f"one pair is wanted, but the coordinates have shape {pair.x_left.shape}: "
            "use jax.vmap"
        )
    pair, _ = mask_unusable(pair)
    return pair, normalised(
        linearised(pair, orientation.pose), pair.mask & orientation.usable
    )


def _limit(known: Normalised, level: float, familywise: bool) -> Float[Array, ""]:
    return (
        largest_w(level, known)
        if familywise
        else critical.normal(level) + 0 * known.squares
    )


def _errors(
    known: Normalised, key: PRNGKeyArray, draws: int
) -> Float[Array, "draw point"]:
    """The w of errorless pairs."""
    root = jnp.sqrt(jnp.where(known.tested, known.redundancy, 1.0))
    noise = jax.random.normal(key, (draws, known.w.shape[0]), float)
    along = noise @ (known.basis * root[:, None])
    return jnp.where(
        known.tested[None, :], noise / root[None, :] - along @ known.basis.T, 0.0
    )


def _partners(known: Normalised) -> tuple[PerPoint, Int[Array, "point"]]:
    """The correlation largest in size of each point with another, and that other."""

    def one(point: Int[Array, ""]):
        rho = jnp.where(jnp.arange(known.w.shape[0]) == point, 0.0, known.row(point))
        other = jnp.argmax(jnp.abs(rho))
        return rho[other], other

    return lax.map(one, jnp.arange(known.w.shape[0]))


def _least(
    known: Normalised,
    errors: Float[Array, "draw point"],
    point: Int[Array, ""],
    limit: Array,
    doubt: float,
) -> tuple[Float[Array, "draw"], Bool[Array, ""]]:
    """X of every draw, and whether any size of error can be told from one in another
    point."""
    own = jnp.arange(known.w.shape[0]) == point
    others = known.tested & ~own
    rho = jnp.where(others, known.row(point), 0.0)
    across = jnp.sqrt(jnp.maximum(1 - rho**2, SAME))
    w_own = jnp.sum(jnp.where(own[None, :], errors, 0.0), axis=1)
    v = (errors - rho[None, :] * w_own[:, None]) / across[None, :]
    larger = jnp.sqrt((1 + rho) / jnp.maximum(1 - rho, SAME))
    smaller = jnp.sqrt((1 - rho) / jnp.maximum(1 + rho, SAME))
    in_doubt = (critical.normal(doubt) + rho[None, :] * v) / across[None, :]
    needed = jnp.maximum(
        jnp.maximum(larger[None, :] * v, -smaller[None, :] * v), in_doubt
    )
    needed = jnp.max(jnp.where(others[None, :], needed, -jnp.inf), axis=1)
    return jnp.maximum(needed, limit), jnp.all(jnp.abs(rho) < 1 - SAME)


def _size(
    least: Float[Array, "draw"], power: Array, able: Bool[Array, ""]
) -> Float[Array, ""]:
    """delta with mean Φ(delta - X) = power, by bisection; infinite where it is not
    able."""

    def halved(_, interval):
        low, high = interval
        middle = (low + high) / 2
        below = jnp.mean(ndtr(middle - least)) < power
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    most = jnp.max(least) + 9
    low, high = lax.fori_loop(0, HALVINGS, halved, (most * 0, most))
    return jnp.where(able, (low + high) / 2, jnp.inf)
