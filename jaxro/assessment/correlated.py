"""The accuracy of the elements where errors of neighbouring points are correlated.

Least squares as if the errors were independent stays unbiased, but its covariance is

    C = s² Q Aᵀ W^½ (1 + rho K) W^½ A Q,    Q = (Aᵀ W A)⁻¹,    s² = sigma0² f / (f + rho tr(R K)),

with K of `assessment.neighbours`: the errors of a coordinate at two points of a photo,
d apart, have the correlation rho exp(-(d/l)²). The divisor is what the adjustment
leaves of such errors in sigma0, f = n - 5.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..adjustment import normal_equations as normal
from ..geometry import coplanarity
from ..geometry.linear import linearised
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.result import Orientation
from .neighbours import agreement


class Correlated(eqx.Module):
    """`covariance` of the five elements, in the order and units of
    `orientation.covariance`; `growth`: their standard deviations over those of
    independent errors; `sigma0` corrected for the correlation."""

    covariance: Float[Array, "*pairs 5 5"]
    growth: Float[Array, "*pairs 5"]
    sigma0: Float[Array, "*pairs"]


@jax.jit
def correlated_covariance(
    pair: Pair, orientation: Orientation, rho: ArrayLike, length: ArrayLike
) -> Correlated:
    """The covariance of the elements of one oriented pair (rigorous residuals) under
    correlated errors.

    `rho` in 0 to 1; `length` l in the unit of the coordinates, as `pattern` estimates
    them. Works under jit and vmap; its memory grows with the square of the number of
    points.
    """
    pair = mask_unusable(pair)[0]
    residuals = coplanarity.residuals(pair, orientation.elements)
    _, columns, weights = residuals.columns((jnp.zeros_like(pair.focal_left),) * 5)
    root = jnp.sqrt(weights[0])  # pyright: ignore[reportOptionalSubscript]
    a = jnp.stack([jnp.where(pair.mask, column * root, 0.0) for (column,) in columns])
    equations = jnp.sum(a[:, None, :] * a[None, :, :], axis=2)
    q = normal.dense(
        normal.inverse([[equations[i, j] for j in range(i + 1)] for i in range(5)])[0]
    )
    rho, length = (jnp.asarray(x, a.dtype) for x in (rho, length))
    k = rho * agreement(linearised(pair, orientation.pose), pair.coordinates)(length)
    effect = q @ a
    extra = effect @ k @ effect.T
    # tr(R K) = -tr(H K), as the diagonal of K is zero
    freedom = orientation.degrees_of_freedom.astype(a.dtype)
    left = freedom - jnp.sum(effect * (a @ k))
    s2 = orientation.sigma0**2 * freedom / jnp.where(left > 0, left, freedom)
    covariance = s2 * (q + extra)
    growth = jnp.sqrt(
        jnp.diagonal(covariance) / (orientation.sigma0**2 * jnp.diagonal(q))
    )
    return Correlated(covariance, growth, jnp.sqrt(s2))
