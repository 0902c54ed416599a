"""The accuracy of the elements if the errors of neighbouring points are correlated.

The estimates of ordinary least squares stay unbiased, but their covariance becomes

    C = s² Q Aᵀ W^½ (1 + rho K) W^½ A Q,    Q = (Aᵀ W A)⁻¹,    s² = sigma0² f / (f + rho tr(R K)),

with K of `assessment.neighbours`: the errors of a coordinate at two points of a photo,
d apart, have the correlation rho exp(-(d/l)²). Correlated errors leave smaller
residuals; the divisor corrects sigma0 for that, f = n - 5.

Use it where `neighbours.pattern` finds agreement; that function estimates rho and l.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..adjustment import normal_equations as normal
from ..geometry.linear import linearise
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.orient import Orientation
from .neighbours import agreement


class Correlated(eqx.Module):
    """The `covariance` of the five elements, in the order and units of
    `orientation.covariance`; the `growth` of their standard deviations against
    independent errors; `sigma0` corrected for the correlation."""

    covariance: Float[Array, "*pairs 5 5"]
    growth: Float[Array, "*pairs 5"]
    sigma0: Float[Array, "*pairs"]


@jax.jit
def correlated_covariance(
    pair: Pair, orientation: Orientation, rho: ArrayLike, length: ArrayLike
) -> Correlated:
    """The covariance of the elements of one oriented pair under correlated errors.

    `rho` in 0 to 1; `length` l in the unit of the coordinates, as `pattern` estimates
    them. The pair must be oriented with rigorous residuals. Works under jit and vmap;
    the memory grows with the square of the number of points.
    """
    pair = mask_unusable(pair)[0]
    linear = linearise(pair, orientation.elements)
    root = jnp.sqrt(linear.weight)
    rows = jnp.stack([column * root for column in linear.columns])
    inverse, _ = normal.inverse(linear.normal_equations()[0])
    q = normal.dense(inverse)
    rho, length = (jnp.asarray(x, rows.dtype) for x in (rho, length))
    kernel = rho * agreement(linear, pair.coordinates)(length)
    effect = q @ rows

    # tr(R K) = -tr(H K), as the diagonal of K is zero
    freedom = orientation.degrees_of_freedom.astype(rows.dtype)
    left = freedom - jnp.sum(effect * (rows @ kernel))
    independent = orientation.sigma0**2
    variance = independent * freedom / jnp.where(left > 0, left, freedom)

    covariance = variance * (q + effect @ kernel @ effect.T)
    ratio = jnp.diagonal(covariance) / (independent * jnp.diagonal(q))
    return Correlated(
        covariance=covariance, growth=jnp.sqrt(ratio), sigma0=jnp.sqrt(variance)
    )
