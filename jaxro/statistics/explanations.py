"""Rows that explain a misfit as well as the one with the largest |w| does: one of them
is wrong, but nothing tells which.

Let i have the largest |w|. If the error is in j instead, the adjustment without j has
no error, and the w of i in it,

    w_i|j = (w_i - rho_ij w_j) / sqrt(1 - rho_ij²),

is normal with standard deviation 1 whatever the size of the error. So j is named
together with i unless |w_i|j| exceeds the two-sided normal value of `doubt`. A wrong
row j is then passed over in favour of one given other row with the probability `doubt`.
If sigma0 is estimated, from the residuals without j, the value is that of the tau
distribution with one degree of freedom less.

This is a likelihood ratio: Σ r² grows by w_i|j² when i is put back into the adjustment
without both. Rows with |rho_ij| = 1 are always named together. Only i is named where
the others are little correlated with it, or where its error is large.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..adjustment import critical_values
from ..adjustment.critical_values import UNTESTABLE
from ..adjustment.guarded import ratio
from .normalised import Normalised, PerRow

Rows = Bool[Array, " row"]

DOUBT = 0.01
"""Probability with which a wrong row is passed over for another one that is named
alone."""

ROUNDING = 1e-6
"""Part of |w| by which two residuals that are the same may differ."""


def explanations(
    normalised: Normalised,
    row: Int[Array, ""],
    doubt: ScalarLike = DOUBT,
    estimated: bool = False,
) -> Rows:
    """The rows whose omission explains the misfit as well as the omission of `row`
    does; `row` is one of them. `estimated`: sigma0 is not known."""
    rho, w = normalised.row(row), normalised.w
    own = jnp.arange(w.shape[0]) == row
    w_own = jnp.sum(jnp.where(own, w, 0.0))
    limit = jnp.asarray(critical_values.normal(doubt))
    if estimated:
        limit = _limit_of_tau(normalised, doubt)
    spread = jnp.sqrt(jnp.maximum(1 - rho**2, UNTESTABLE**2))
    room = ROUNDING * jnp.abs(w_own)
    near = jnp.abs(w_own - rho * w) <= limit * spread + room
    return normalised.tested & (near | own)


def _limit_of_tau(normalised: Normalised, doubt: ScalarLike) -> PerRow:
    """The limit of |w_i|j| for every j, by sigma0 of the residuals without j; infinite
    with one degree of freedom left, where there is no test and all rows are named."""
    w, freedom = normalised.w, normalised.freedom - 1
    fewest = normalised.parameters + 1
    value = lambda n: critical_values.tau(doubt, np.maximum(n - fewest, 1.0))
    tau = critical_values.by_count(value, w.shape[0], freedom + fewest)
    rest = jnp.maximum(normalised.squares - w**2, 0.0)
    sigma0 = jnp.sqrt(rest / jnp.maximum(freedom, 1.0))
    return jnp.where(freedom > 1, jnp.where(freedom > 1, tau, 1.0) * sigma0, jnp.inf)


def misfit(
    normalised: Normalised,
    limit: Float[Array, ""],
    doubt: ScalarLike = DOUBT,
    estimated: bool = False,
) -> tuple[PerRow, Rows]:
    """|w| of the rows (|tau| if sigma0 is `estimated`), and the rows of which one is
    wrong: the explanations of the largest value if it exceeds the limit, else
    none."""
    unit = jnp.ones_like(normalised.squares)
    if estimated:
        unit = jnp.sqrt(normalised.squares / jnp.maximum(normalised.freedom, 1.0))
    w = ratio(jnp.abs(normalised.w), unit, unit > 0)
    found = jnp.max(w) > limit
    return w, explanations(normalised, jnp.argmax(w), doubt, estimated) & found
