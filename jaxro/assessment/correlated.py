"""The accuracy of the elements if the errors of neighbouring points are correlated.

The estimates of ordinary least squares stay unbiased, but their covariance becomes

    C = s² Q Aᵀ W^½ (1 + rho K) W^½ A Q,    Q = (Aᵀ W A)⁻¹,    s² = sigma0² f / (f + rho tr(R K)),

with K of `assessment.neighbours`: the errors of a coordinate at two points of a photo,
d apart, have the correlation rho exp(-(d/l)²). Correlated errors leave smaller
residuals; the divisor corrects sigma0 for that, f = n - 5.

Use it where `neighbours.pattern` finds agreement; that function estimates rho and l.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from ..adjustment import normal_equations as normal
from ..geometry.elements import AbstractElements
from ..geometry.linear import Linear, linearise
from ..geometry.pairs import Coordinates, Pair, mask_unusable
from ..orientation.orient import Orientation
from .neighbours import kernel_between


class Correlated(eqx.Module):
    """The `covariance` of the five elements, in the order and units of
    `orientation.covariance`; the `growth` of their standard deviations against
    independent errors; `sigma0` corrected for the correlation."""

    covariance: Float[Array, "*pairs 5 5"]
    growth: Float[Array, "*pairs 5"]
    sigma0: Float[Array, "*pairs"]


BLOCK = 128
"""Points whose correlations with all others are in memory at once."""


@jax.jit
def correlated_covariance(
    pair: Pair, orientation: Orientation, rho: ArrayLike, length: ArrayLike
) -> Correlated:
    """The covariance of the elements of one oriented pair under correlated errors.

    `rho` in 0 to 1; `length` l in the unit of the coordinates, as `pattern` estimates
    them. The pair must be oriented with rigorous residuals. Works under jit and vmap.
    """
    q, grown, divided = _correlate(
        pair, orientation.elements, orientation.degrees_of_freedom, rho, length
    )
    independent = orientation.sigma0**2
    ratio = jnp.diagonal(grown) / jnp.diagonal(q)
    return Correlated(
        covariance=independent * grown,
        growth=jnp.sqrt(ratio),
        sigma0=jnp.sqrt(independent * divided),
    )


def _correlate(
    pair: Pair,
    elements: AbstractElements,
    freedom: Int[Array, ""],
    rho: ArrayLike,
    length: ArrayLike,
) -> tuple[Float[Array, "5 5"], Float[Array, "5 5"], Float[Array, ""]]:
    """Q; C / sigma0², its growth; and s² / sigma0²."""
    pair = mask_unusable(pair)[0]
    linear = linearise(pair, elements)
    q = normal.dense(normal.inverse(linear.normal_equations()[0])[0])
    rho, length = (jnp.asarray(x, q.dtype) for x in (rho, length))
    middle = rho * _agreeing(linear, pair.coordinates, length)

    # tr(R K) = -tr(H K), as the diagonal of K is zero
    f = freedom.astype(q.dtype)
    left = f - jnp.sum(q * middle)
    divided = f / jnp.where(left > 0, left, f)
    return q, divided * (q + q @ middle @ q), divided


def _agreeing(
    linear: Linear, coordinates: Coordinates, length: Float[Array, ""]
) -> Float[Array, "5 5"]:
    """Aᵀ W^½ K W^½ A, some rows of K after the others."""
    root = jnp.sqrt(linear.weight)
    rows = jnp.stack([column * root for column in linear.columns], axis=-1)
    points = rows.shape[0]
    of_points = rows, linear.weight, linear.gradient, coordinates
    size = min(BLOCK, points)
    more = -points % size
    some = jax.tree.map(
        lambda a: jnp.pad(a, [(0, more)] + [(0, 0)] * (a.ndim - 1)).reshape(
            -1, size, *a.shape[1:]
        ),
        of_points,
    )

    def block(some: tuple) -> Float[Array, "5 5"]:
        own, weight, gradient, places = some
        few = linear._replace(weight=weight, gradient=gradient)
        return own.T @ (kernel_between(few, places, linear, coordinates, length) @ rows)

    # of a point with itself the kernel is 1, and K has 0
    return jnp.sum(jax.lax.map(block, some), axis=0) - rows.T @ rows


@jax.jit
def grown_cofactor(
    pair: Pair,
    elements: AbstractElements,
    cofactor: Float[Array, "5 5"],
    freedom: Int[Array, ""],
    rho: ArrayLike,
    length: ArrayLike,
) -> Float[Array, "5 5"]:
    """The cofactors of the elements of one oriented pair under correlated errors, from
    those that it has; `freedom`: its degrees of freedom. Those that are not of least
    squares grow as these do. Works under jit and vmap."""
    q, grown, _ = _correlate(pair, elements, freedom, rho, length)
    change = change_between(q, cofactor)
    return change @ grown @ change.T


@jax.jit
def unit_growth(
    pair: Pair,
    elements: AbstractElements,
    freedom: Int[Array, ""],
    rho: ArrayLike,
    length: ArrayLike,
) -> Float[Array, ""]:
    """s / sigma0: by how much errors that agree are larger than the residuals that they
    leave in one oriented pair."""
    return jnp.sqrt(_correlate(pair, elements, freedom, rho, length)[2])


def change_between(
    some: Float[Array, "5 5"], others: Float[Array, "5 5"]
) -> Float[Array, "5 5"]:
    """The lower triangle M with M Q Mᵀ = Q' of two matrices of cofactors."""
    own = [[*row[:-1], 1 / row[-1]] for row in _factor(others)]
    return _dense(own) @ _dense(normal.inverse_of_lower(_factor(some)))


def allow_for_neighbours(
    pair: Pair, orientation: Orientation, rho: ArrayLike, length: ArrayLike
) -> Orientation:
    """The orientation of one pair with the cofactors that it has under correlated
    errors; everything that follows from them holds then: deviations, intervals,
    regions. sigma0 is left as it is, the size of the residuals.

    `rho` and `length`: of the pair, or of a table, by `pattern` and `pool`. Works under
    jit and vmap.
    """
    asked = orientation.elements, orientation.cofactor, orientation.degrees_of_freedom
    grown = grown_cofactor(pair, *asked, rho, length)
    return dataclasses.replace(orientation, cofactor=grown)


def _factor(q: Float[Array, "5 5"]) -> normal.Lower:
    """L with Q = L Lᵀ, the inverses of its diagonal in place of the diagonal."""
    return normal.cholesky([[q[i, j] for j in range(i + 1)] for i in range(len(q))])[0]


def _dense(rows: normal.Lower) -> Float[Array, "5 5"]:
    """A lower triangle as a matrix."""
    zero = jnp.zeros_like(rows[0][0])
    full = [[*row, *[zero] * (len(rows) - len(row))] for row in rows]
    return jnp.stack([jnp.stack(row) for row in full])
