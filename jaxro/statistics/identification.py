"""Identification: how large an error must be to be attributed to its own row.

An error that moves w_i by delta moves the w of the other rows by rho_ij delta. Row i is
*identified* by a test if it is the only one that is named (see `explanations`): |w_i|
exceeds the limit, no other |w| is larger, and no other row explains the misfit as well.
With x = w_i and v_j normal, independent of x, w_j = rho x + sqrt(1 - rho²) v_j, so that
for a positive error all of this is

    x > limit,    x > sqrt((1 + rho) / (1 - rho)) v_j,    x > -sqrt((1 - rho) / (1 + rho)) v_j,
    x > (k + rho v_j) / sqrt(1 - rho²),

k the normal value of `doubt`. With X the largest right-hand side, P(i is identified) is
the mean of Φ(delta - X) over the v. The *minimal identifiable error* is the delta for
which this mean is the wanted power, as the minimal detectable error (Baarda 1968) is
the delta for which P(|w_i| > limit) is. With doubt = 1 it is the minimal identifiable
bias of the largest |w| (Teunissen 2018; Rofatto et al. 2020). It is infinite where
|rho| = 1.

Everything is of first order, with a known sigma0. Probabilities that depend on several
residuals are simulated from a key, with the same draws for all rows.
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
from ..xla.programs import compiled
from .explanations import DOUBT, explanations
from .familywise import largest_w
from .normalised import Normalised, PerRow

HALVINGS = 50
"""Of the interval in which the size of an error is sought."""

SAME = 1e-6
"""1 - |rho| below which nothing tells two rows apart."""


class Identified(NamedTuple):
    """The smallest errors that would be found, and those that would be attributed to
    their row, in standard deviations of w.

    `tested`: rows that others check. `partner`: the row with which a row is confused
    most easily, the one with the largest |rho|; `correlation`: this rho. `limit` of |w|.
    An error makes the |w| of its row exceed the limit with the wanted power if it is
    `found` large, and is identified with this power if it is `identified` large
    (infinite where this never happens).
    """

    tested: Bool[Array, " row"]
    partner: Int[Array, " row"]
    correlation: PerRow
    limit: Float[Array, ""]
    found: Float[Array, ""]
    identified: PerRow


class Chances(eqx.Module):
    """Probabilities of what becomes of an error in each row: one row is named, the right
    one (`correct`) or another one (`wrong`); several rows are named, the right one
    among them (`undecided`) or not (`misled`); or none is named (`missed`). They add up
    to 1; zero where a row is not tested."""

    correct: PerRow
    wrong: PerRow
    undecided: PerRow
    misled: PerRow
    missed: PerRow


@compiled(static=("familywise", "draws"))
def identify(
    known: Normalised,
    key: PRNGKeyArray,
    *,
    level: ScalarLike = 0.001,
    power: ScalarLike = 0.80,
    familywise: bool = False,
    doubt: ScalarLike = DOUBT,
    draws: int = 4096,
) -> Identified:
    """The minimal detectable and the minimal identifiable errors of every row.

    `level` of the test of each row, or (`familywise`) of all together. `doubt` as in
    `explanations`: 1 if the largest |w| alone decides. `draws` of all residuals: with
    4,096 the power of the identifiable errors is right to 0.005; the work is draws ×
    rows².
    """
    limit = critical_w(known, level, familywise)
    found = jnp.asarray(critical.delta_normal(2 * ndtr(-limit), power))
    errors = _draw_errors(known, key, draws)
    correlation, partner = _partners(known)

    def size(row: Int[Array, ""]) -> Float[Array, ""]:
        least, able = _least(known, errors, row, limit, doubt)
        return _size(least, jnp.asarray(power, float), able)

    sizes = lax.map(size, jnp.arange(known.w.shape[0]))
    return Identified(
        tested=known.tested,
        partner=partner,
        correlation=correlation,
        limit=limit,
        found=found,
        identified=jnp.where(known.tested, sizes, jnp.inf),
    )


@compiled(static=("familywise", "draws"))
def chances(
    known: Normalised,
    key: PRNGKeyArray,
    delta: Float[ArrayLike, " row"],
    *,
    level: ScalarLike = 0.001,
    familywise: bool = False,
    doubt: ScalarLike = DOUBT,
    draws: int = 4096,
) -> Chances:
    """What becomes of an error that moves the w of its own row by `delta`, for every row
    in turn, by simulation of the w. Other arguments as of `identify`."""
    limit = critical_w(known, level, familywise)
    errors = _draw_errors(known, key, draws)

    def with_error(row: Int[Array, ""]) -> tuple[Float[Array, ""], ...]:
        own = jnp.arange(known.w.shape[0]) == row
        shift = known.row(row) * jnp.sum(jnp.where(own, delta, 0.0))
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


def critical_w(
    known: Normalised, level: ScalarLike, familywise: bool
) -> Float[Array, ""]:
    """The limit of |w|, of each row or of all together."""
    if familywise:
        return largest_w(level, known)
    return critical.normal(level) + 0 * known.squares


def _judge(
    known: Normalised,
    w: PerRow,
    own: Bool[Array, " row"],
    limit: Array,
    doubt: ScalarLike,
) -> tuple[Bool[Array, ""], ...]:
    """Which of the fields of `Chances` happens with these w, if the error is in the
    `own` row: exactly one is True."""
    size = jnp.abs(w)
    named = explanations(known._replace(w=w), jnp.argmax(size), doubt)
    found = jnp.max(size) > limit
    alone, among = jnp.sum(named) == 1, jnp.any(named & own)
    correct, wrong = found & among & alone, found & ~among & alone
    several, misled = found & among & ~alone, found & ~among & ~alone
    return correct, wrong, several, misled, ~found


def _draw_errors(
    known: Normalised, key: PRNGKeyArray, draws: int
) -> Float[Array, "draw row"]:
    """The w of errorless observations."""
    root = jnp.sqrt(jnp.where(known.tested, known.redundancy, 1.0))
    noise = jax.random.normal(key, (draws, known.w.shape[0]), float)
    along = noise @ (known.basis * root[:, None])
    w = noise / root[None, :] - along @ known.basis.T
    return jnp.where(known.tested[None, :], w, 0.0)


def _partners(known: Normalised) -> tuple[PerRow, Int[Array, " row"]]:
    """The correlation largest in size of each row with another, and that other row."""
    rows = jnp.arange(known.w.shape[0])

    def partner(row: Int[Array, ""]):
        rho = jnp.where(rows == row, 0.0, known.row(row))
        other = jnp.argmax(jnp.abs(rho))
        return rho[other], other

    return lax.map(partner, rows)


def _least(
    known: Normalised,
    errors: Float[Array, "draw row"],
    row: Int[Array, ""],
    limit: Array,
    doubt: ScalarLike,
) -> tuple[Float[Array, " draw"], Bool[Array, ""]]:
    """X of every draw, and whether any size of error can be told from one in another
    row."""
    own = jnp.arange(known.w.shape[0]) == row
    others = known.tested & ~own
    rho = jnp.where(others, known.row(row), 0.0)[None, :]
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
    least: Float[Array, " draw"], power: Array, able: Bool[Array, ""]
) -> Float[Array, ""]:
    """delta with mean Φ(delta - X) = power; infinite where it is not able."""
    enough = lambda delta: jnp.mean(ndtr(delta - least)) >= power
    most = jnp.max(least) + 9
    delta = bisect(enough, most * 0, most, HALVINGS)
    return jnp.where(able, delta, jnp.inf)
