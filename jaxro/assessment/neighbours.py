"""Whether the residuals of neighbouring points agree: a test of the independence that
standard deviations assume.

The errors of a coordinate at two points of a photo, d apart, may have the correlation
rho exp(-(d/l)²); rho is that of close neighbours. Then the whitened residuals
r = B e / |B| (B = dg/dl of the coplanarity condition) have the covariance

    1 + rho K,
    K_ij = u_i(left) . u_j(left) exp(-(d_left/l)²) + u_i(right) . u_j(right) exp(-(d_right/l)²),

u = B / |B|, K_ii = 0. The locally best test of rho = 0 is the score (King and Hillier
1985; its form is Moran's of 1950)

    T = r' K r / r' r - tr(R K) / (n - 5),    R = 1 - H.

R is the projection by the adjustment, which makes residuals correlated even where the
errors are not. T does not depend on sigma. Its first three moments are exact: with A =
R (K - tr(R K) / (n - 5)) R and f = n - 5

    E T = 0,    E T² = 2 tr A² / (f (f + 2)),    E T³ = 8 tr A³ / (f (f + 2) (f + 4)),

and its distribution is approximated by Pearson's type III with these moments (Henshaw
1966). As l is not known, K is the sum over four lengths. For many pairs f T, its
variance and its third moment are added up.

With a K of one length alone, r' K r / r' r has for its expectation (tr(R K) + rho
tr(R K R K)) / (f + rho tr(R K)); solved for rho this is the estimate, and l is where
T is largest over its standard deviation, by a parabola through three of the lengths.
Numerator and denominator of rho, and this variance, are added up over many pairs, which
tell together what few of them tell alone.

Errors along the epipolar lines change no residual: the test does not see whether they
agree.
"""

from collections.abc import Callable
from math import erfc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from ..geometry.linear import Linear, linearise, namespace
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.orient import Orientation

LENGTHS = (0.025, 0.05, 0.1, 0.2)
"""Correlation lengths l that are tried, in units of the side of a square as large as
the area of the points."""

LEVEL = 0.05
"""Probability below which a pattern is reported."""

SURE = 0.001
"""Probability below which deviations allow for a pattern: of a thousand tables of
independent errors one."""

NEAR = 1e-6
"""tr A² below which no two points are near each other at the length of the kernel."""

Values = Float[Array | np.ndarray, "*pairs"]
OfLengths = Float[Array | np.ndarray, "*pairs tried"]


class Tried(eqx.Module):
    """What residuals tell of each of the LENGTHS, on a last axis: the `length` in the
    unit of the photo coordinates; the `signal` f T, its `slope` by rho, and its
    `variance` without correlation. Of many pairs the last three are sums."""

    length: OfLengths
    signal: OfLengths
    slope: OfLengths
    variance: OfLengths


class Pattern(eqx.Module):
    """The test of one pair, or of many together; for a batch every field has leading
    axes.

    `probability` that independent errors show as much agreement or more. `rho`: the
    estimated correlation of neighbouring errors, in 0 to 1, and `length` l, in the unit
    of the photo coordinates. `score` f T, its `variance` and its `third` moment without
    correlation, and what was `tried`: `pool` adds these up. With fewer than two degrees
    of freedom, and where no points are near each other, the probability is 1.
    """

    probability: Values
    rho: Values
    length: Values
    score: Values
    variance: Values
    third: Values
    tried: Tried

    @property
    def flagged(self) -> Any:
        """Whether independent errors would show such a pattern in less than 5 % of all
        cases."""
        return self.probability < LEVEL

    @property
    def sure(self) -> Any:
        """Whether it is so sure that deviations are to allow for it."""
        return self.probability < SURE


@jax.jit
def pattern(pair: Pair, orientation: Orientation) -> Pattern:
    """The test of the residuals of one oriented pair, at the rigorous conditions.

    Works under jit and vmap; the memory grows with the square of the number of points.
    """
    pair = mask_unusable(pair)[0]
    return of_linear(linearise(pair, orientation.pose), pair.coordinates)


def of_linear(linear: Linear, coordinates: tuple[Any, ...]) -> Pattern:
    """The test from linearised conditions and the coordinates of the points; computed
    with NumPy if these are NumPy arrays."""
    xp = namespace(linear.weight)
    residuals = _standardise(linear)
    unit = _extent(coordinates[:2], residuals.use, xp)
    lengths = [length * unit for length in LENGTHS]
    kernel_of = agreement(linear, coordinates)
    kernels = [kernel_of(length) for length in lengths]
    each = zip(*(_try(kernel, residuals) for kernel in kernels), strict=True)
    signal, slope, spread = (xp.stack(values) for values in each)
    known, score, variance, third = _score(sum(kernels), residuals)
    tried = Tried(xp.asarray(xp.stack(lengths)), signal, slope, spread)
    rho, length = _estimate(tried)
    return Pattern(
        probability=_tail(score, variance, third, xp),
        rho=xp.where(known, rho, 0.0),
        length=length,
        score=score,
        variance=variance,
        third=third,
        tried=tried,
    )


def agreement(linear: Linear, coordinates: tuple[Any, ...]) -> Callable:
    """A function that gives the matrix K for a correlation length; computed with NumPy
    if the arguments are NumPy arrays."""
    xp = namespace(linear.weight)
    apart = ~np.eye(linear.weight.shape[0], dtype=bool)
    photos = [
        (xp.where(apart, cosines, 0.0), distance)
        for cosines, distance in _compare(linear, coordinates, linear, coordinates)
    ]
    return lambda length: _sum_of_photos(photos, length)


def kernel_between(
    some: Linear,
    places: tuple[Any, ...],
    others: Linear,
    coordinates: tuple[Any, ...],
    length: Any,
) -> Any:
    """K between some points and others, with 1 for a point and itself."""
    return _sum_of_photos(_compare(some, places, others, coordinates), length)


def _compare(
    some: Linear, places: tuple[Any, ...], others: Linear, coordinates: tuple[Any, ...]
) -> list[tuple[Any, Any]]:
    """Of both photos u . u and the squared distance, of some points and others."""
    first, second = _directions(some), _directions(others)
    photos = []
    for part in (slice(0, 2), slice(2, 4)):
        both = zip(first[part], second[part], strict=True)
        apart = zip(places[part], coordinates[part], strict=True)
        cosines = sum(u[:, None] * v[None, :] for u, v in both)
        photos.append((cosines, sum((c[:, None] - d[None, :]) ** 2 for c, d in apart)))
    return photos


def _directions(linear: Linear) -> list[Any]:
    """u of every point, zero where it is not used."""
    xp = namespace(linear.weight)
    use = linear.weight > 0
    norm = xp.sqrt(xp.where(use, sum(b * b for b in linear.gradient), 1.0))
    return [xp.where(use, b / norm, 0.0) for b in linear.gradient]


def _sum_of_photos(photos: list[tuple[Any, Any]], length: Any) -> Any:
    xp = namespace(photos[0][0])
    return sum(cosines * xp.exp(-distance / length**2) for cosines, distance in photos)


def pool(patterns: Pattern) -> Pattern:
    """The test of many pairs together, (pair,): what is added up of each, and the rho
    and the length that all of them tell."""
    xp = namespace(patterns.score)
    together = lambda values: xp.asarray(xp.sum(values, axis=0))
    score, variance, third = (
        together(values)
        for values in (patterns.score, patterns.variance, patterns.third)
    )
    each = patterns.tried
    signal, slope, spread = map(together, (each.signal, each.slope, each.variance))
    # pairs that tell nothing of a length have none
    weight = each.variance + NEAR
    length = xp.asarray(xp.sum(weight * each.length, axis=0) / xp.sum(weight, axis=0))
    tried = Tried(length, signal, slope, spread)
    rho, length = _estimate(tried)
    return Pattern(
        probability=_tail(score, variance, third, xp),
        rho=rho,
        length=length,
        score=score,
        variance=variance,
        third=third,
        tried=tried,
    )


def _estimate(tried: Tried) -> tuple[Any, Any]:
    """rho, and the length l."""
    xp = namespace(tried.signal)
    known = tried.variance > NEAR
    strength = tried.signal / xp.sqrt(xp.where(known, tried.variance, 1.0))
    strength = xp.where(known, strength, 0.0)
    rising = known & (tried.slope > 0)
    rho = xp.where(rising, tried.signal / xp.where(rising, tried.slope, 1.0), 0.0)
    place = _highest(strength)
    at = lambda values: _between(values, place)
    length = xp.exp(at(xp.log(tried.length)))
    return xp.asarray(at(xp.clip(rho, 0.0, 1.0))), xp.asarray(length)


def _highest(heights: Any) -> Any:
    """The place of the largest of some heights, between them by a parabola where those
    beside it tell one."""
    xp = namespace(heights)
    last = heights.shape[-1] - 1
    best = xp.argmax(heights)
    inner = xp.clip(best, 1, last - 1)
    before, there, behind = (heights[inner + k] ** 2 for k in (-1, 0, 1))
    bend = 2 * there - before - behind
    bent = (best == inner) & (xp.min(heights) > 0) & (bend > 0)
    shift = 0.5 * (behind - before) / xp.where(bent, bend, 1.0)
    return best.astype(shift.dtype) + xp.where(bent, shift, 0.0)


def _between(values: Any, place: Any) -> Any:
    """The value at a place between those of a row."""
    xp = namespace(values)
    nearness = 1 - xp.abs(np.arange(float(values.shape[-1])) - place)
    return xp.sum(xp.maximum(nearness, 0.0) * values)


class _Residuals(NamedTuple):
    """The whitened residuals of a pair as the test needs them: their `direction` r /
    |r| and `squares` Σ r², an orthonormal `basis` (5, point) of the design, the points
    in `use`, and the degrees of `freedom` f, two where there are not `enough`."""

    direction: Any
    squares: Any
    basis: Any
    use: Any
    freedom: Any
    enough: Any

    def project(self, matrix):
        """R M R."""
        left = matrix - self.basis.T @ (self.basis @ matrix)
        return left - (left @ self.basis.T) @ self.basis


def _standardise(linear: Linear) -> _Residuals:
    xp = namespace(linear.weight)
    use = linear.weight > 0
    freedom = xp.sum(xp.where(use, 1.0, 0.0)) - 5
    enough = freedom >= 2
    root = xp.sqrt(linear.weight)
    basis = xp.stack(_orthonormal_basis([column * root for column in linear.columns]))
    r = linear.g * root
    for column in basis:  # second-order terms leave something in these directions
        r = r - column * xp.sum(column * r)
    squares = xp.sum(r * r)
    return _Residuals(
        direction=r / xp.sqrt(xp.where(squares > 0, squares, 1.0)),
        squares=squares,
        basis=basis,
        use=use,
        freedom=xp.where(enough, freedom, 2.0),
        enough=enough,
    )


def _moments(kernel, residuals: _Residuals) -> tuple[Any, Any, Any]:
    """tr(R K), the matrix A, and T."""
    xp = namespace(residuals.use)
    inner = residuals.project(kernel)
    trace = xp.trace(inner)
    mean = trace / residuals.freedom
    everything = xp.diag(xp.where(residuals.use, 1.0, 0.0))
    projection = everything - residuals.basis.T @ residuals.basis
    direction = residuals.direction
    t = xp.sum(direction * (kernel @ direction)) - mean
    return trace, inner - mean * projection, t


def _try(kernel: Any, residuals: _Residuals) -> tuple[Any, Any, Any]:
    """f T, its slope by rho, and its variance without correlation, from the kernel of
    one length; zero without a test."""
    xp, freedom = namespace(residuals.use), residuals.freedom
    trace, inner, t = _moments(kernel, residuals)
    information = xp.sum(inner * inner)
    known = residuals.enough & (information > NEAR) & (residuals.squares > 0)
    ratio = t + trace / freedom
    slope = information + trace**2 / freedom - ratio * trace
    variance = 2 * information * freedom / (freedom + 2)
    told = t * freedom, slope, variance
    return tuple(xp.where(known, number, 0.0) for number in told)  # pyright: ignore[reportReturnType]


def _score(kernel, residuals: _Residuals) -> tuple[Any, Any, Any, Any]:
    """Whether there is a test, f T, its variance and its third moment; zero without a
    test."""
    xp, f = namespace(residuals.use), residuals.freedom
    _, inner, t = _moments(kernel, residuals)
    square = inner @ inner
    second, third = xp.trace(square), xp.sum(square * inner)
    known = residuals.enough & (second > NEAR) & (residuals.squares > 0)
    return (
        known,
        xp.where(known, t * f, 0.0),
        xp.where(known, 2 * second * f / (f + 2), 0.0),
        xp.where(known, 8 * third * f**2 / ((f + 2) * (f + 4)), 0.0),
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
    root = xp.sign(base) * xp.abs(base) ** (1 / 3)
    normal = xp.where(skewed, 6 / g * (root - 1) + g / 6, z)
    return xp.where(known, _upper_tail(normal, xp), 1.0)


def _upper_tail(z, xp):
    """The probability of a larger normal number."""
    if xp is jnp:
        return ndtr(-z)
    return np.vectorize(lambda x: 0.5 * erfc(x / np.sqrt(2.0)))(z)


def _orthonormal_basis(columns: list) -> list:
    """An orthonormal basis of the columns, by Gram and Schmidt, twice.

    `correlations.orthonormal_columns` costs one pass over the points, but is no NumPy.
    """
    xp = namespace(columns[0])
    basis: list = []
    for column in columns:
        for _ in range(2):
            for other in basis:
                column = column - other * xp.sum(other * column)
            length = xp.sqrt(xp.sum(column * column))
            column = column / xp.where(length > 0, length, 1.0)
        basis.append(column)
    return basis


def _extent(place, use, xp):
    """The side of a square as large as the rectangle that holds the points; at least a
    tenth of its longer side."""
    sides = []
    for c in place:
        last = xp.max(xp.where(use, c, -xp.inf))
        sides.append(last - xp.min(xp.where(use, c, xp.inf)))
    area = xp.maximum(sides[0] * sides[1], 0.0)
    side = xp.maximum(xp.sqrt(area), 0.1 * xp.maximum(*sides))
    return xp.where(xp.isfinite(side) & (side > 0), side, 1.0)
