"""Points that explain a misfit as well as the one with the largest |w| does: one of
them is wrong, but which?

Let i have the largest |w|. If the error is in j instead, the adjustment without j has
no error, and the w of i in it,

    w_i|j = (w_i - rho_ij w_j) / sqrt(1 - rho_ij²),

is normal with standard deviation 1 whatever the size of the error. So j is named
together with i unless |w_i|j| exceeds the two-sided normal value of `doubt`: a wrong j
is passed over in favour of one given other point with this probability (of the tau
distribution with one degree of freedom less where sigma0 is estimated, from the
residuals without j). This is a likelihood ratio: Σ r² grows by w_i|j² when i is put
back into the adjustment without both. Points with |rho_ij| = 1 are always named
together; only i is named where the others are little correlated with it, or its error
is large.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import critical_values
from ..geometry.elements import RelativePose
from ..geometry.linear import linearised
from ..geometry.pairs import Pair
from ..xla.kernels import while_loop
from ..xla.passes import count
from .correlations import UNTESTABLE, Normalised, normalised, orthonormal

Use = Bool[Array, "point"]

DOUBT = 0.01
"""Probability with which a wrong point is passed over for another one that is named
alone."""

ROUNDING = 1e-6
"""Part of |w| by which two residuals that are the same may differ."""


def explaining(
    normalised: Normalised,
    point: Int[Array, ""],
    doubt: float = DOUBT,
    estimated: bool = False,
) -> Use:
    """The points whose omission explains the misfit as well as that of `point`, which
    is one of them."""
    rho, w = normalised.row(point), normalised.w
    own = jnp.arange(w.shape[0]) == point
    w_own = jnp.sum(jnp.where(own, w, 0.0))
    limit = jnp.broadcast_to(critical_values.normal(doubt), w.shape)
    if estimated:
        freedom = normalised.freedom - 1  # without j
        value = lambda n: critical_values.tau(doubt, jnp.maximum(n - 6, 1.0))
        alone = critical_values.by_count(value, w.shape[0], normalised.freedom + 5)
        square = jnp.maximum(normalised.squares - w**2, 0.0) / jnp.maximum(freedom, 1.0)
        # with one degree of freedom left there is no test, and everything is named
        limit = jnp.where(
            freedom > 1, jnp.where(freedom > 1, alone, 1.0) * jnp.sqrt(square), jnp.inf
        )
    spread = jnp.sqrt(jnp.maximum(1 - rho**2, UNTESTABLE**2))
    near = jnp.abs(w_own - rho * w) <= limit * spread + ROUNDING * jnp.abs(w_own)
    return normalised.tested & (near | own)


def undecided(
    pair: Pair,
    pose: RelativePose,
    use: Use,
    rejected: Use | None = None,
    doubt: float = DOUBT,
) -> Use:
    """The points of which some are wrong, though nothing tells which, after a verdict
    that all but `use` are: every rejected point that could change places with one of
    those in use, and these. Empty where all is decided.

    `pose`: the least-squares solution of the points in use; sigma is known. `rejected`:
    those of the others that are in question, all if None (points behind a photo are not
    in question). As many of the points named are wrong as were rejected of them; a
    procedure that decides nothing for the others takes them back.

    With h_ij = a_i N⁻¹ a_j of the points in use, w_i of a rejected point has the
    variance 1 + h_ii, and

        w_i|j = (w_i + k_ij w_j) / sqrt(1 + k_ij²),    k_ij = h_ij / sqrt((1 + h_ii) (1 - h_jj)).

    Only rejected points for which the largest k and w leave this possible are looked
    at, one after the other: many points with large errors cost nothing.
    """
    linear = linearised(pair, pose)
    rejected = pair.mask & ~use if rejected is None else rejected & pair.mask & ~use
    known = normalised(linear, use)
    spanned = jnp.stack(orthonormal(linear, use)[0], axis=-1)
    leverage = jnp.sum(spanned**2, axis=-1)
    outside = jnp.sqrt(1 + leverage)
    w = jnp.where(use, known.w, linear.g * jnp.sqrt(linear.weight) / outside)
    inside = jnp.sqrt(jnp.maximum(known.redundancy, UNTESTABLE))
    limit = critical_values.normal(doubt)

    most = (
        jnp.max(jnp.where(use, jnp.sqrt(leverage) / inside, 0.0))
        * jnp.sqrt(leverage)
        / outside
    )
    largest = jnp.max(jnp.where(use, jnp.abs(w), 0.0))
    possible = rejected & (jnp.abs(w) <= most * largest + limit * jnp.sqrt(1 + most**2))

    def turn(state):
        left, named = state
        own = jnp.arange(w.shape[0]) == jnp.argmax(left)
        of_own = lambda values: jnp.sum(jnp.where(own, values, 0.0))
        chosen = jnp.sum(jnp.where(own[:, None], spanned, 0.0), axis=0)
        k = jnp.sum(spanned * chosen[None, :], axis=-1) / (of_own(outside) * inside)
        others = use & (jnp.abs(of_own(w) + k * w) <= limit * jnp.sqrt(1 + k**2))
        return left & ~own, named | others | (own & (count(others) > 0))

    start = possible, jnp.zeros_like(use)
    return while_loop(lambda state: count(state[0]) > 0, turn, start, pair.focal_left)[
        1
    ]


def misfit(
    normalised: Normalised,
    limit: Float[Array, ""],
    doubt: float = DOUBT,
    estimated: bool = False,
) -> tuple[Float[Array, "point"], Use]:
    """|w| (|tau| if `estimated`) of the points, and the points of which one is wrong:
    those that explain the largest value if that exceeds the limit, else none."""
    unit = (
        jnp.sqrt(normalised.squares / jnp.maximum(normalised.freedom, 1.0))
        if estimated
        else 1.0
    )
    positive = jnp.where(unit > 0, unit, 1.0)
    w = jnp.where(unit > 0, jnp.abs(normalised.w) / positive, 0.0)
    found = jnp.max(w) > limit
    return w, explaining(normalised, jnp.argmax(w), doubt, estimated) & found
