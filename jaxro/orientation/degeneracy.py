"""How near a layout of points is to one that does not determine the orientation, in
units of its measuring errors.

Measuring errors hide that elements are undetermined: points that lie on a line but for
their errors give a regular normal matrix. Whether it means anything is a question of
scale, and the scale is sigma0.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..adjustment.normal_equations import inner, quadratic
from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import AbstractElements
from ..geometry.pairs import Pair
from ..xla.passes import sums
from .inspection import Inspection

ROUNDING = 1e-9
"""Angle (rad) between two rays that a computer cannot tell from zero."""

POWERS = 4
"""Of the cofactor matrix: enough to separate its largest eigenvalue where that
matters."""

NEAR_STATION = 2.0
"""Standard deviations of the image of the other station within which a point says
little of what its own errors do to the normal equations."""

FREE = 5.0
"""Multiple of sigma0 from which a `margin` leaves the cofactors as they are."""

MOST_LOST = 0.9
"""Part of the information that errors may feign, at most: beyond, nothing is
determined."""


def in_radians(
    elements: AbstractElements, cofactor: Float[Array, "5 5"]
) -> tuple[Float[Array, "5 5"], list]:
    """The cofactors with components of the base over its length, and what each element
    was divided by."""
    if all(elements.angles):
        return cofactor, [1.0] * len(elements.angles)
    _, base = elements.relative()
    length = jnp.sqrt(rot.dot(base, base))
    units = [jnp.ones_like(length) if angle else length for angle in elements.angles]
    scale = jnp.stack(units)
    return cofactor / (scale[:, None] * scale[None, :]), units


class WorstDirection(NamedTuple):
    """What happens along the worst determined direction of the elements.

    `margin`: the least change of the coordinates (root mean square over the points, in
    units of sigma) that leaves one combination of the elements undetermined, to first
    order. And to second order, of another minimum: `away`, its distance in standard
    deviations of the direction for sigma0 = 1; `turn`, the same in rad; `rise` of Σ r²
    there. `cofactor`: those of the elements, with what the errors of the points add to
    the normal equations along the direction taken off.
    """

    margin: Float[Array, ""]
    cofactor: Float[Array, "5 5"]
    away: Float[Array, ""]
    turn: Float[Array, ""]
    rise: Float[Array, ""]


def worst_direction(
    pair: Pair,
    elements: AbstractElements,
    cofactor: Float[Array, "5 5"],
    sigma0: Float[Array, ""],
) -> WorstDirection:
    """`WorstDirection` of an adjustment with these cofactors of its parameters.

    Along the worst determined direction e of the elements g of a point changes by g'.
    With n points the normal matrix has eᵀ N e = Σ (g'/ (sigma |∇g|))², and each
    coordinate moves g' by ∇g', so that errors of size m alone produce m² Σ (|∇g'| /
    |∇g|)²: the two are equal at m = margin. So of eᵀ N e only the part 1 - m² / margin²
    is information; the gradient of Σ r² varies by the whole. Along e the variance is
    that of the inverse over the square of this part. A point so near to the other
    station's image that the uncertain direction may move that image past it tells
    nothing of the others' errors, and counts less the nearer it is.

    To second order the residuals are r + a t + c t²/2 with a = A e at right angles to
    all other columns of A and c = (g'' - 2 g' ∇g.∇g' / |∇g|²) / (sigma |∇g|), but for
    terms of g itself. The part of c along a, c.a/a.a, brings them back at t = -2 a.a /
    c.a; what of c no column takes up, c.c - cᵀA Q Aᵀc, is left as Σ r² + t⁴/4 of it.
    Layouts near a critical surface, such as a valley along the base on the cylinder
    through both stations, have there another minimum that the linearised statistics of
    the first know nothing of.
    """
    direction, variance = direction_of_worst(elements, cofactor)
    matrices = bend(pair, elements, direction)
    bent = _sum_along(pair, *matrices, variance * sigma0**2)

    columns = _along_columns(pair, elements, bent.by_entry)  # Aᵀc
    taken = quadratic([list(row) for row in cofactor], columns)
    back = jnp.abs(sum(e * h for e, h in zip(direction, columns, strict=True)))
    straight = back <= 0
    turn = 2 * bent.change / jnp.where(straight, 1.0, back)
    turn = jnp.where(straight, jnp.inf, turn)
    margin = _margin(bent.told, bent.drift)
    e = jnp.stack(direction)
    more = _lost_information(margin, sigma0) * variance
    return WorstDirection(
        margin=margin,
        cofactor=cofactor + more * e[:, None] * e[None, :],
        away=turn * jnp.sqrt(jnp.maximum(bent.change, 0.0)),
        turn=turn,
        rise=jnp.maximum(bent.bends - taken, 0.0) * turn**4 / 4,
    )


def margin_along(
    pair: Pair,
    elements: AbstractElements,
    direction: list,
    variance: Float[Array, ""],
) -> Float[Array, ""]:
    """The `margin` of `WorstDirection`, along any direction of the elements with this
    variance."""
    f, slope, _ = bend(pair, elements, direction)

    def of_point(point, sigma, use, roots):
        _, square, _ = coplanarity.linearise(f, point, use, roots)
        g, drift, _ = coplanarity.linearise(slope, point, use, roots)
        heard = _heard(square, drift, variance)
        weight = jnp.where(use, heard / (square * sigma**2), 0.0)
        return g**2 * weight, drift * sigma**2 * weight

    measured = pair.coordinates, pair.sigma, pair.mask, pair.roots
    return _margin(*sums(jax.vmap(of_point)(*measured)))


def _heard(
    square: Float[Array, ""], drift: Float[Array, ""], variance: Float[Array, ""]
) -> Float[Array, ""]:
    """How much a point tells of the errors along a direction with this variance: the
    less, the more of its gradient, of which these are the squares, may change."""
    square = jnp.where(square > 0, square, 1.0)
    return 1 / (1 + (NEAR_STATION**2 * variance * drift / square) ** 2)


def _margin(told: Float[Array, ""], drift: Float[Array, ""]) -> Float[Array, ""]:
    """The errors of the coordinates at which the drift that they cause is as large as
    what is told."""
    ratio = told / jnp.where(drift > 0, drift, 1.0)
    reach = jnp.sqrt(jnp.where(ratio > 0, ratio, 0.0))
    return jnp.where(drift > 0, reach, jnp.inf)


def _lost_information(
    margin: Float[Array, ""], sigma0: Float[Array, ""]
) -> Float[Array, ""]:
    """By how much the variance along a direction exceeds the one of the inverse, over
    this: nothing from a margin of `FREE`, where the layout is far from undetermined,
    and without limit where the errors are all there is."""
    part = (sigma0 / jnp.where(margin > 0, margin, 1.0)) ** 2
    part = jnp.where(margin > 0, part, 1.0)
    lost = jnp.clip(part - 1 / FREE**2, 0.0, MOST_LOST)
    return 1 / (1 - lost) ** 2 - 1


def direction_of_worst(
    elements: AbstractElements, cofactor: Float[Array, "5 5"]
) -> tuple[list, Float[Array, ""]]:
    """The worst determined direction, of length 1 in rad, in the units of the elements;
    and its variance (rad²) for sigma0 = 1."""
    in_rad, units = in_radians(elements, cofactor)
    direction = _worst(in_rad)
    length = jnp.sqrt(sum((e * e for e in direction), jnp.zeros(())))
    direction = [e / length for e in direction]
    variance = quadratic([list(row) for row in in_rad], direction)
    return [e * unit for e, unit in zip(direction, units, strict=True)], variance


def bend(pair: Pair, elements: AbstractElements, direction: list) -> tuple:
    """F and its first and second derivative along a direction of the elements.

    F is linear in R and in b; of a steady turn R'' = R' Rᵀ R', of a steady shift
    b'' = 0.
    """
    zero = jnp.zeros_like(pair.focal_left)
    focals = pair.focal_left, pair.focal_right
    fundamental = lambda r, b: coplanarity.fundamental_matrix(r, b, *focals)
    along = lambda t: elements.move(tuple(t * e for e in direction)).relative()
    one = jnp.ones_like(zero)
    (rotation, base), (turning, moving) = jax.jvp(along, (zero,), (one,))
    bending = rot.product(turning, rot.product(rot.transpose(rotation), turning))
    f = fundamental(rotation, base)
    slope = _plus(fundamental(turning, base), fundamental(rotation, moving))
    twice = fundamental(turning, rot.scale(moving, 2.0))
    return f, slope, _plus(fundamental(bending, base), twice)


class _Bent(NamedTuple):
    """Sums over the points, with the weights w = 1 / (sigma |∇g|)² and the part h of
    `_heard`: `change` Σ w g'², `told` Σ h w g'², `drift` Σ h w sigma² |∇g'|², `bends`
    Σ (h c)² and, by the entries of F, Σ h c ∂g/∂F times the root of w."""

    change: Float[Array, ""]
    told: Float[Array, ""]
    drift: Float[Array, ""]
    bends: Float[Array, ""]
    by_entry: rot.Matrix


def _sum_along(
    pair: Pair,
    f: rot.Matrix,
    slope: rot.Matrix,
    curve: rot.Matrix,
    variance: Float[Array, ""],
) -> _Bent:
    """The sums for F and its derivatives along a direction with this variance."""

    def of_point(point, sigma, use, roots):
        _, square, b = coplanarity.linearise(f, point, use, roots)
        g, drift, turned = coplanarity.linearise(slope, point, use, roots)
        weight = jnp.where(use, 1 / (square * sigma**2), 0.0)
        steepens = sum(x * y for x, y in zip(b, turned, strict=True)) / square
        heard = _heard(square, drift, variance)
        bent = heard * (coplanarity.condition(curve, point) - 2 * g * steepens)
        by_f = sum(jax.grad(coplanarity.condition)(f, point), ())
        told = g**2 * heard * weight, drift * sigma**2 * heard * weight
        own = g**2 * weight, *told, bent**2 * weight
        return *own, *(bent * weight * entry for entry in by_f)

    measured = pair.coordinates, pair.sigma, pair.mask, pair.roots
    of_points = jax.vmap(of_point)(*measured)
    change, told, drift, bends, *products = sums(of_points)
    p11, p12, p13, p21, p22, p23, p31, p32, p33 = products
    by_entry = (p11, p12, p13), (p21, p22, p23), (p31, p32, p33)
    return _Bent(change, told, drift, bends, by_entry)


def _along_columns(
    pair: Pair, elements: AbstractElements, by_entry: rot.Matrix
) -> list:
    """Products with the five columns of the design of what has these with the entries
    of F."""
    focals = pair.focal_left, pair.focal_right
    fundamental = lambda r, b: coplanarity.fundamental_matrix(r, b, *focals)
    _, slopes = elements.slopes(fundamental, bilinear=True)
    return [inner(by_entry, slope) for slope in slopes]


def _plus(a: rot.Matrix, b: rot.Matrix) -> rot.Matrix:
    rows = zip(a, b, strict=True)
    return tuple(tuple(x + y for x, y in zip(*both, strict=True)) for both in rows)  # pyright: ignore


def _worst(cofactor: Float[Array, "p p"]) -> list:
    """The eigenvector of the largest eigenvalue of a cofactor matrix, of any length:
    powers on a column."""
    q = [list(row) for row in cofactor / jnp.trace(cofactor)]
    column, most = q[0], q[0][0]
    for k, row in enumerate(q[1:], 1):
        longer = row[k] > most
        column = [jnp.where(longer, a, b) for a, b in zip(row, column, strict=True)]
        most = jnp.where(longer, row[k], most)
    for _ in range(POWERS):
        column = [sum(a * b for a, b in zip(row, column, strict=True)) for row in q]
    return column


NOMINAL = 3e-4
"""Standard deviation of a coordinate over the focal length that no measurement worth
the name exceeds: 0.05 mm in a photo of 150 mm, a third of a pixel at 1,000 pixels."""

FEW = 2.0
"""Degrees of freedom up to which sigma0 is too uncertain to judge a layout by."""

CREDIBLE = 3.0
"""Multiple of the expected sigma0 up to which the estimated one does not refute it:
with one degree of freedom it is exceeded once in 370 times."""

CERTAIN = 2.576
"""Normal quantile, of one in 200, from which the better of two orientations is taken
for the right one."""


SURE = 3.29
"""The same, of one in 2,000, where both are judged by their own residuals."""


class Noise(NamedTuple):
    """The measuring errors a layout is judged by: `size`, the standard deviation of
    unit weight, its `freedom`, and whether it is `expected`, not estimated.

    With one or two degrees of freedom the estimated sigma0 is often small by chance.
    Were layouts judged by it, those called good would be those with a sigma0 too small,
    and the intervals of their elements with it. Such pairs are judged by what is
    expected before the measurement, unless sigma0 refutes it: the given sigma, or
    `NOMINAL` times the focal length where the given one is larger, as it is where it
    only tells the unit.
    """

    size: Float[Array, ""]
    freedom: Float[Array, ""]
    expected: Bool[Array, ""]

    def tolerance(self, squares: Float[Array, ""]) -> Float[Array, ""]:
        """Σ r² up to which another orientation fits as well as the one with Σ r² =
        squares."""
        more = CERTAIN**2 * self.freedom * self.size**2
        return jnp.where(self.expected, squares + more, squares * excess(self.freedom))

    @property
    def least_margin(self) -> Float[Array, ""]:
        """The `margin` below which a layout is not told from one that determines
        nothing."""
        return jnp.where(self.expected, 4.0, required_margin(self.freedom)) * self.size


def noise(
    sigma0: Float[Array, ""],
    freedom: Float[Array, ""],
    sigma: Float[Array, ""],
    focal: Float[Array, ""],
) -> Noise:
    """`Noise` of a pair whose sigmas have the root mean square `sigma`."""
    unit = jnp.minimum(1.0, NOMINAL * focal / jnp.where(sigma > 0, sigma, 1.0))
    expected = (freedom > 0) & (freedom <= FEW) & (sigma0 <= CREDIBLE * unit)
    return Noise(jnp.where(expected, unit, sigma0), freedom, expected)


def required_margin(freedom: Float[Array, ""]) -> Float[Array, ""]:
    """Multiple of sigma0 below which a `margin` is not told from measuring errors: 1.25,
    and more where sigma0 itself is uncertain, having few degrees of freedom (63 with
    one).

    The errors alone give points that determine nothing a margin of 1, and to one in
    fifty of those on a line one of more than 1.25 with a hundred points, of more than 2
    with twenty. What is above is usable with the deviation that it has.
    """
    return 1.25 + 62 / jnp.maximum(freedom, 1.0) ** 1.3


def significant(freedom: Float[Array, ""]) -> Float[Array, ""]:
    """Multiple of sigma0 below which parallaxes are explained by a rotation alone: 4,
    and more where sigma0 itself is uncertain."""
    return 4 + 12 / jnp.maximum(freedom, 1.0)


NEAR = 0.5
"""rad: further away the second order tells nothing."""

SEPARATE = 12.0
"""Standard deviations between two minima from which Σ r² between them, (12/4)² sigma0²
higher, parts them."""


def excess(freedom: Float[Array, ""]) -> Float[Array, ""]:
    """The ratio of Σ r² of two orientations up to which they are not told apart.

    Where both are right, as they are of points in a plane, it has Fisher's distribution
    with f = n - 5 degrees of freedom each. Its quantile by his z: ln F is nearly normal
    with the variance 4 / (f - 1); for f = 1 as it is.
    """
    return jnp.where(
        freedom > 0, jnp.exp(2 * SURE / jnp.sqrt(jnp.maximum(freedom - 1, 0.28))), 1.0
    )


def find_second(
    worst: WorstDirection, noise: Noise
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether there is a second minimum that fits as well, and whether nothing parts it
    from the first."""
    squares = jnp.where(noise.expected, 0.0, noise.freedom * noise.size**2)
    fits = worst.rise < noise.tolerance(squares) - squares
    second = fits & (worst.turn < NEAR) & (noise.freedom > 0)
    return second, second & (worst.away < SEPARATE * noise.size)


def pure_rotation(
    inspected: Inspection, freedom: Float[Array, ""], noise: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether the directions p1 and R p2 agree to within the measuring error: no
    parallax, hence no base."""
    return (inspected.parallax < significant(freedom) * noise) | (
        inspected.angle < ROUNDING
    )
