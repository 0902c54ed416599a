"""Points that explain a misfit as well as the one with the largest |w| does: one of
them is wrong, but nothing tells which.

Let i have the largest |w|. If the error is in j instead, the adjustment without j has
no error, and the w of i in it,

    w_i|j = (w_i - rho_ij w_j) / sqrt(1 - rho_ij²),

is normal with standard deviation 1 whatever the size of the error. So j is named
together with i unless |w_i|j| exceeds the two-sided normal value of `doubt`. A wrong
point j is then passed over in favour of one given other point with the probability
`doubt`. If sigma0 is estimated, from the residuals without j, the value is that of the
tau distribution with one degree of freedom less.

This is a likelihood ratio: Σ r² grows by w_i|j² when i is put back into the adjustment
without both. Points with |rho_ij| = 1 are always named together. Only i is named where
the others are little correlated with it, or where its error is large.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..adjustment import critical_values
from ..adjustment.critical_values import UNTESTABLE
from ..adjustment.guarded import ratio
from ..geometry.elements import RelativePose
from ..geometry.linear import Linear, Values, linearise
from ..geometry.pairs import Pair
from ..xla.kernels import while_loop
from ..xla.passes import count
from .correlations import Normalised, normalise, orthonormal_columns

Use = Bool[Array, "point"]

DOUBT = 0.01
"""Probability with which a wrong point is passed over for another one that is named
alone."""

ROUNDING = 1e-6
"""Part of |w| by which two residuals that are the same may differ."""


def explanations(
    normalised: Normalised,
    point: Int[Array, ""],
    doubt: ScalarLike = DOUBT,
    estimated: bool = False,
) -> Use:
    """The points whose omission explains the misfit as well as the omission of `point`
    does; `point` is one of them. `estimated`: sigma0 is not known."""
    rho, w = normalised.row(point), normalised.w
    own = jnp.arange(w.shape[0]) == point
    w_own = jnp.sum(jnp.where(own, w, 0.0))
    limit = jnp.asarray(critical_values.normal(doubt))
    if estimated:
        limit = _limit_of_tau(normalised, doubt)
    spread = jnp.sqrt(jnp.maximum(1 - rho**2, UNTESTABLE**2))
    room = ROUNDING * jnp.abs(w_own)
    near = jnp.abs(w_own - rho * w) <= limit * spread + room
    return normalised.tested & (near | own)


def _limit_of_tau(normalised: Normalised, doubt: ScalarLike) -> Values:
    """The limit of |w_i|j| for every j, by sigma0 of the residuals without j; infinite
    with one degree of freedom left, where there is no test and all points are named."""
    w, freedom = normalised.w, normalised.freedom - 1
    points = freedom + 6
    value = lambda n: critical_values.tau(doubt, np.maximum(n - 6, 1.0))
    tau = critical_values.by_count(value, w.shape[0], points)
    rest = jnp.maximum(normalised.squares - w**2, 0.0)
    sigma0 = jnp.sqrt(rest / jnp.maximum(freedom, 1.0))
    return jnp.where(freedom > 1, jnp.where(freedom > 1, tau, 1.0) * sigma0, jnp.inf)


def undecided_points(
    pair: Pair,
    pose: RelativePose,
    use: Use,
    rejected: Use | None = None,
    doubt: ScalarLike = DOUBT,
) -> Use:
    """The points of which some are wrong, though nothing tells which, after a procedure
    has rejected all but `use`: every rejected point that could change places with one
    of those in use, and these. Empty if all is decided.

    `pose`: the least-squares solution of the points in use; sigma is known. `rejected`:
    those of the other points that are in question, all if None (points behind a photo
    are not in question). As many of the points named are wrong as were rejected of
    them.

    With h_ij = a_i N⁻¹ a_j of the points in use, w_i of a rejected point has the
    variance 1 + h_ii, and

        w_i|j = (w_i + k_ij w_j) / sqrt(1 + k_ij²),    k_ij = h_ij / sqrt((1 + h_ii) (1 - h_jj)).

    Only the rejected points for which the largest k and w leave this possible are
    examined, one after the other: many points with large errors cost nothing.
    """
    outside = pair.mask & ~use
    candidates = outside if rejected is None else rejected & outside
    exchange = _compare(linearise(pair, pose), use)
    limit = jnp.asarray(critical_values.normal(doubt))

    def examine(state: tuple[Use, Use]) -> tuple[Use, Use]:
        left, named = state
        own = jnp.arange(use.shape[0]) == jnp.argmax(left)
        others = exchange.partners(own, limit)
        return left & ~own, named | others | (own & (count(others) > 0))

    start = candidates & exchange.possible(limit), jnp.zeros_like(use)
    unfinished = lambda state: count(state[0]) > 0
    return while_loop(unfinished, examine, start, pair.focal_left)[1]


class _Exchange(NamedTuple):
    """What decides whether a rejected point and one in use could change places.

    `spanned`: orthonormal columns with h_ij = q_i · q_j; `leverage` h_ii; `outside`
    sqrt(1 + h_ii), the standard deviation of a rejected point's residual; `inside`
    sqrt(1 - h_jj) of points in `use`; `w` of all points.
    """

    spanned: Float[Array, "point 5"]
    leverage: Values
    outside: Values
    inside: Values
    w: Values
    use: Use

    def possible(self, limit: Array) -> Use:
        """Points that could change places with one in use at the largest k and w."""
        root = jnp.sqrt(self.leverage)
        most = jnp.max(jnp.where(self.use, root / self.inside, 0.0))
        k = most * root / self.outside
        largest = jnp.max(jnp.where(self.use, jnp.abs(self.w), 0.0))
        return jnp.abs(self.w) <= k * largest + limit * jnp.sqrt(1 + k**2)

    def partners(self, own: Use, limit: Array) -> Use:
        """The points in use that could change places with the one point of `own`."""
        choose = lambda values: jnp.sum(jnp.where(own, values, 0.0))
        chosen = jnp.sum(jnp.where(own[:, None], self.spanned, 0.0), axis=0)
        products = jnp.sum(self.spanned * chosen[None, :], axis=-1)
        k = products / (choose(self.outside) * self.inside)
        difference = jnp.abs(choose(self.w) + k * self.w)
        return self.use & (difference <= limit * jnp.sqrt(1 + k**2))


def _compare(linear: Linear, use: Use) -> _Exchange:
    known = normalise(linear, use)
    spanned = jnp.stack(orthonormal_columns(linear, use)[0], axis=-1)
    leverage = jnp.sum(spanned**2, axis=-1)
    outside = jnp.sqrt(1 + leverage)
    rejected_w = linear.g * jnp.sqrt(linear.weight) / outside
    return _Exchange(
        spanned=spanned,
        leverage=leverage,
        outside=outside,
        inside=jnp.sqrt(jnp.maximum(known.redundancy, UNTESTABLE)),
        w=jnp.where(use, known.w, rejected_w),
        use=use,
    )


def misfit(
    normalised: Normalised,
    limit: Float[Array, ""],
    doubt: ScalarLike = DOUBT,
    estimated: bool = False,
) -> tuple[Values, Use]:
    """|w| of the points (|tau| if sigma0 is `estimated`), and the points of which one
    is wrong: the explanations of the largest value if it exceeds the limit, else
    none."""
    unit = jnp.ones_like(normalised.squares)
    if estimated:
        unit = jnp.sqrt(normalised.squares / jnp.maximum(normalised.freedom, 1.0))
    w = ratio(jnp.abs(normalised.w), unit, unit > 0)
    found = jnp.max(w) > limit
    return w, explanations(normalised, jnp.argmax(w), doubt, estimated) & found
