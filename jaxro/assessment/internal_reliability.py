"""Internal reliability: how well the points of a pair check one another.

The redundancy number r = 1 - h of a point is the part of its error that shows in its
residual, h = a N⁻¹ aᵀ / D the leverage (Baarda 1968). From it follow the normalised
residual w = g / (sigma0 sqrt(D r)) and the size of the error that a test of w finds,
delta0 sigma0 sqrt(D / r) in g. `reliability` has all formulas together.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..adjustment import critical_values as critical
from ..adjustment.critical_values import UNTESTABLE
from ..adjustment.guarded import ratio, root
from ..adjustment.normal_equations import inverse
from ..geometry.linear import Linear, Values
from ..geometry.pairs import Pair
from ..orientation.orient import Orientation
from ..xla.kernels import computed_once
from ..xla.passes import count


class Checks(NamedTuple):
    """How the points of a pair check one another: those in `use`, their number
    `points`, the `redundancy` numbers r, the columns of N⁻¹ aᵀ (`shifts`), which points
    are `testable`, the root sqrt(r D) (`spread`, 1 where not testable), the `freedom`,
    and the sigma0 that is `estimated` and the one that is used (`unit`)."""

    use: Bool[Array, "point"]
    points: Float[Array, ""]
    redundancy: Values
    shifts: list[Values]
    testable: Bool[Array, "point"]
    spread: Values
    freedom: Float[Array, ""]
    estimated: Float[Array, ""]
    unit: Float[Array, ""]

    @property
    def divisor(self) -> Values:
        """r, 1 where a point is not testable."""
        return jnp.where(self.testable, self.redundancy, 1.0)


def check(
    pair: Pair, orientation: Orientation, linear: Linear, sigma0: Array | None
) -> Checks:
    use = pair.mask & orientation.usable
    shifts, leverage, squares = computed_once(_solve)(linear)
    r = jnp.where(use, 1 - leverage, 0.0)
    points = count(use)
    freedom = jnp.where(points > 5, points - 5, 0.0)
    estimated = root(ratio(squares, freedom, freedom > 0))
    unit = estimated if sigma0 is None else sigma0
    enough = freedom > (1 if sigma0 is None else 0)
    testable = use & (r > UNTESTABLE) & enough & (unit > 0)
    divisor = jnp.where(testable, r, 1.0)
    spread = jnp.sqrt(divisor / jnp.where(testable, linear.weight, 1.0))
    return Checks(
        use=use,
        points=points,
        redundancy=r,
        shifts=shifts,
        testable=testable,
        spread=jnp.where(testable, spread, 1.0),
        freedom=freedom,
        estimated=estimated,
        unit=unit,
    )


def _solve(linear: Linear) -> tuple[list[Values], Values, Array]:
    """N⁻¹ aᵀ and leverage of every point, and Σ g² / d."""
    n, _, squares = linear.normal_equations()
    # five products a point by the inverse, where every entry of a substitution would
    # repeat those before it
    q, _ = computed_once(inverse)(n)
    row = lambda i: [q[max(i, j)][min(i, j)] for j in range(5)]
    shifts = [linear.times(row(i)) for i in range(5)]
    return shifts, linear.weight * linear.times(shifts), squares


def normalised_residuals(linear: Linear, checks: Checks) -> Values:
    """g / (sigma0 sqrt(D r)), 0 where a point is not testable."""
    w = linear.g * linear.weight * checks.spread / checks.divisor
    unit = jnp.where(checks.unit > 0, checks.unit, 1.0)
    return jnp.where(checks.testable, w, 0.0) / unit


@lru_cache(maxsize=64)
def tests(
    most: int, known: bool, level: float, power: float, familywise: bool
) -> tuple[Any, ...]:
    """Tables of delta0, the limit of |w| and the level of the test of a point, for
    pairs of 0 to `most` points. Raises ValueError if level or power are no
    probabilities."""
    for name, probability in (("level", level), ("power", power)):
        if not 0 < probability < 1:
            raise ValueError(
                f"{name} is a probability, between 0 and 1, got {probability}"
            )
    n = critical.counts(most)
    alone = critical.sidak(level, n) if familywise else np.full_like(n, level)
    if known:
        delta, limit = critical.delta_normal(alone, power), critical.normal(alone)
    else:
        freedom = np.maximum(n - 5, 2.0)
        delta = critical.delta_student(alone, power, freedom - 1)
        limit = critical.tau(alone, freedom)
    return delta, limit, alone
