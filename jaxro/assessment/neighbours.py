"""Whether the residuals of neighbouring points agree: a test of the independence that
standard deviations assume.

The errors of a coordinate at two points of a photo, d apart, may have the correlation
rho exp(-(d/l)²), rho at neighbours. Then the whitened residuals r = B e / |B| (B =
dg/dl of the coplanarity condition) have the covariance

    1 + rho K,
    K_ij = u_i(left) . u_j(left) exp(-(d_left/l)²) + u_i(right) . u_j(right) exp(-(d_right/l)²),

u = B / |B|, K_ii = 0. The locally best test of rho = 0 is the score (King and Hillier
1985; of Moran's 1950 form)

    T = r' K r / r' r - tr(R K) / (n - 5),    R = 1 - H,

with R the projection by the adjustment, which makes residuals correlated even where the
errors are not. T does not depend on sigma. Its first three moments are exact: with A =
R (K - tr(R K) / (n - 5)) R and f = n - 5

    E T = 0,    E T² = 2 tr A² / (f (f + 2)),    E T³ = 8 tr A³ / (f (f + 2) (f + 4)),

and its distribution is taken as Pearson's type III with these (Henshaw 1966). As l is
not known, K is the sum over four lengths. Of many pairs f T, its variance and its third
moment are added up. Agreement along the epipolar lines shows in no residual, nor in
this test.
"""

from collections.abc import Callable
from math import erfc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from ..geometry.linear import Linear, linearised
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.result import Orientation

LENGTHS = (0.025, 0.05, 0.1, 0.2)
"""Correlation lengths l that are tried, in units of the side of a square as large as
the area of the points."""

LEVEL = 0.05
"""Probability below which a pattern is reported."""

Values = Float[Array | np.ndarray, "*pairs"]


class Pattern(eqx.Module):
    """The test of one pair, or of many together; for a batch every field has leading
    axes.

    `probability` that independent errors show as much agreement or more. `rho`: the
    estimated correlation of neighbouring errors, in 0 to 1, at the likeliest of the
    tried lengths; `length`: that length l, in the unit of the photo coordinates.
    `score`, its `variance` and its `third` moment without correlation: what `pooled`
    adds up. With fewer than two degrees of freedom, and where no points are near each
    other, the probability is 1.
    """

    probability: Values
    rho: Values
    length: Values
    score: Values
    variance: Values
    third: Values
    information: Values

    @property
    def flagged(self) -> Any:
        """Whether independent errors would show such a pattern in less than 5 % of all
        cases."""
        return self.probability < LEVEL


@jax.jit
def pattern(pair: Pair, orientation: Orientation) -> Pattern:
    """The test of the residuals of one oriented pair, at the rigorous conditions.

    Works under jit and vmap; its memory grows with the square of the number of points.
    """
    pair = mask_unusable(pair)[0]
    return of_linear(linearised(pair, orientation.pose), pair.coordinates)


def of_linear(linear: Linear, coordinates: tuple[Any, ...]) -> Pattern:
    """The same from linearised conditions; of NumPy arrays by NumPy."""
    xp: Any = np if isinstance(linear.weight, np.ndarray) else jnp
    use = linear.weight > 0
    n = xp.sum(xp.where(use, 1.0, 0.0))
    f = n - 5
    there = f >= 2
    free = xp.where(there, f, 2.0)
    root = xp.sqrt(linear.weight)
    q = xp.stack(_orthonormal([column * root for column in linear.columns], xp))
    r = linear.g * root
    for column in q:  # what second-order terms left in the direction of the elements
        r = r - column * xp.sum(column * r)
    squares = xp.sum(r * r)
    share = r / xp.sqrt(xp.where(squares > 0, squares, 1.0))

    def projected(matrix):
        left = matrix - q.T @ (q @ matrix)
        return left - (left @ q.T) @ q

    def moments(kernel):
        """tr(R K), R K R less its mean on the diagonal of R, and T."""
        inner = projected(kernel)
        trace = xp.trace(inner)
        projection = xp.diag(xp.where(use, 1.0, 0.0)) - q.T @ q
        return (
            trace,
            inner - trace / free * projection,
            xp.sum(share * (kernel @ share)) - trace / free,
        )

    unit = _extent(coordinates[:2], use, xp)
    kernel_of = agreement(linear, coordinates)

    total, candidates = 0.0, []
    for length in LENGTHS:
        kernel = kernel_of(length * unit)
        trace, inner, t = moments(kernel)
        size = xp.sum(inner * inner)
        known = size > 1e-6  # else no two points are near each other at this scale
        standardised = xp.where(known, t / xp.sqrt(xp.where(known, size, 1.0)), 0.0)
        total = total + kernel
        # E(r' K r) = sigma² (tr + rho tr(R K R K)) and E(r' r) = sigma² (f + rho tr)
        full = size + trace**2 / free
        mean = t + trace / free
        slope = full - mean * trace
        rho = xp.where(
            known & (slope > 0),
            (mean * free - trace) / xp.where(slope > 0, slope, 1.0),
            0.0,
        )
        candidates.append((standardised, xp.clip(rho, 0.0, 1.0), length * unit, size))
    _, inner, t = moments(total)
    square = inner @ inner
    second, third = xp.trace(square), xp.sum(square * inner)
    known = there & (second > 1e-6) & (squares > 0)
    score = xp.where(known, t * free, 0.0)
    variance = xp.where(known, 2 * second * free / (free + 2), 0.0)
    skew = xp.where(known, 8 * third * free**2 / ((free + 2) * (free + 4)), 0.0)
    best, rhos, lengths, sizes = (
        xp.stack(values) for values in zip(*candidates, strict=True)
    )
    chosen = xp.argmax(best)
    return Pattern(
        probability=_tail(score, variance, skew, xp),
        rho=xp.where(known, rhos[chosen], 0.0),
        length=xp.asarray(lengths[chosen]),
        score=score,
        variance=variance,
        third=skew,
        information=xp.where(known, sizes[chosen], 0.0),
    )


def agreement(linear: Linear, coordinates: tuple[Any, ...]) -> Callable:
    """The matrix K of a correlation length; of NumPy arrays by NumPy."""
    xp: Any = np if isinstance(linear.weight, np.ndarray) else jnp
    use = linear.weight > 0
    square = sum(b * b for b in linear.gradient)
    norm = xp.sqrt(xp.where(use, square, 1.0))
    both = use[:, None] & use[None, :] & ~np.eye(use.shape[0], dtype=bool)
    photos = []
    for part in (slice(0, 2), slice(2, 4)):
        along = [b / norm for b in linear.gradient[part]]
        cosines = sum(u[:, None] * u[None, :] for u in along)
        distance = sum((c[:, None] - c[None, :]) ** 2 for c in coordinates[part])
        photos.append((xp.where(both, cosines, 0.0), distance))

    return lambda length: sum(
        cosines * xp.exp(-distance / length**2) for cosines, distance in photos
    )


def pooled(patterns: Pattern) -> Pattern:
    """The test of many pairs together, (pair,): their scores, variances and third
    moments added up.

    `rho` and `length` are the means of the pairs, weighted by what each tells of rho.
    """
    xp: Any = np if isinstance(patterns.score, np.ndarray) else jnp
    score, variance, third = (
        xp.asarray(xp.sum(x))
        for x in (patterns.score, patterns.variance, patterns.third)
    )
    weight = patterns.information
    whole = xp.asarray(xp.sum(weight))
    share = weight / xp.where(whole > 0, whole, 1.0)
    return Pattern(
        probability=_tail(score, variance, third, xp),
        rho=xp.asarray(xp.sum(share * patterns.rho)),
        length=xp.asarray(xp.sum(share * patterns.length)),
        score=score,
        variance=variance,
        third=third,
        information=whole,
    )


def _tail(score, variance, third, xp):
    """The probability of a larger score by Pearson's type III (in the normal form of
    Wilson and Hilferty 1931)."""
    known = variance > 0
    deviation = xp.sqrt(xp.where(known, variance, 1.0))
    z, skew = score / deviation, third / deviation**3
    skewed = xp.abs(skew) > 1e-4
    g = xp.where(skewed, skew, 1.0)
    base = 1 + g * z / 2
    cubed = xp.sign(base) * xp.abs(base) ** (1 / 3)
    normal = xp.where(skewed, 6 / g * (cubed - 1) + g / 6, z)
    return xp.where(known, _upper(normal, xp), 1.0)


def _upper(z, xp):
    if xp is jnp:
        return ndtr(-z)
    return np.vectorize(lambda x: 0.5 * erfc(x / np.sqrt(2.0)))(z)


def _orthonormal(columns: list, xp) -> list:
    """An orthonormal basis of the columns, by Gram and Schmidt, twice."""
    basis: list = []
    for column in columns:
        for _ in range(2):
            for known in basis:
                column = column - known * xp.sum(known * column)
            length = xp.sqrt(xp.sum(column * column))
            column = column / xp.where(length > 0, length, 1.0)
        basis.append(column)
    return basis


def _extent(place, use, xp):
    """The side of a square as large as the rectangle that holds the points; at least a
    tenth of its longer side."""
    sides = [
        xp.max(xp.where(use, c, -xp.inf)) - xp.min(xp.where(use, c, xp.inf))
        for c in place
    ]
    longer = xp.maximum(*sides)
    side = xp.maximum(xp.sqrt(xp.maximum(sides[0] * sides[1], 0.0)), 0.1 * longer)
    return xp.where(xp.isfinite(side) & (side > 0), side, 1.0)
