"""Points that a procedure has rejected, and that could change places with one in use:
some of them are wrong, but nothing tells which (`statistics.explanations`)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

from ..adjustment import critical_values
from ..adjustment.critical_values import UNTESTABLE
from ..geometry.elements import RelativePose
from ..geometry.linear import Linear, Values, linearise
from ..geometry.pairs import Pair
from ..statistics.explanations import DOUBT
from ..xla.kernels import while_loop
from ..xla.passes import count
from .correlations import normalise, orthonormal_columns

Use = Bool[Array, "point"]


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
