"""Heights over a horizontal grid of squares from the parallaxes of an uncalibrated pair
of photos (Gutkin 1982).

    (2)  p_c = B l / L                           the parallax of the grid, from one of its squares
    (1)  h = H dp / (p_c + dp)                   height over the grid; negative below it
    (5)  h2 - h1 of points in two squares,       (19) in one

with dp the horizontal parallax of a point less the parallax of the grid beside it, H
the height of the cameras over the grid, B their base, L a side of the square and l its
length on the photo. All lengths have one unit. Every function is the formula for single
numbers and takes arrays that broadcast together.

(1) holds for tilted photos as well, if l and the parallax of the grid are measured at
the point: on the photo whose mark moves, the right one here, a height displaces the
point by the image of B h / (H - h), whatever the tilt.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

Number = Float[Array, "..."]


def as_number(value: ArrayLike) -> Number:
    """An array of the default precision."""
    return jnp.asarray(value, float)


class Station(NamedTuple):
    """The two cameras: their height over the grid and the horizontal distance between
    them."""

    camera_height: ArrayLike
    base: ArrayLike


class Square(NamedTuple):
    """One square of the grid: its side in nature, and that side on the right photo."""

    side: ArrayLike
    photo_side: ArrayLike


class Sight(NamedTuple):
    """A point in its square: readings of the grid beside the point, and of the point
    itself."""

    square: Square
    grid: ArrayLike
    point: ArrayLike


def grid_parallax(base: ArrayLike, photo_side: ArrayLike, side: ArrayLike) -> Number:
    """(2): p_c = B l / L."""
    return _over(as_number(photo_side) * base, side)


def height(camera_height: ArrayLike, p_c: ArrayLike, dp: ArrayLike) -> Number:
    """(1): h = H dp / (p_c + dp), the height of a point over the grid."""
    return _over(as_number(camera_height) * dp, as_number(p_c) + dp)


def difference(
    camera_height: ArrayLike,
    p_c1: ArrayLike,
    dp1: ArrayLike,
    p_c2: ArrayLike,
    dp2: ArrayLike,
) -> Number:
    """(5): h2 - h1 of points in two squares, exact.

    The print of (5), and (6) after it, lack the term p_c2 - p_c1 of the denominator;
    see `difference_short`.
    """
    shift = as_number(p_c2) - p_c1
    bent = _over(shift * dp1, p_c1)
    product = _over(as_number(dp1) * dp2, p_c1)
    rise = as_number(camera_height) * (as_number(dp2) - dp1 - bent)
    return _over(rise, as_number(p_c1) + dp1 + dp2 + shift + bent + product)


def difference_short(
    camera_height: ArrayLike,
    p_c1: ArrayLike,
    dp1: ArrayLike,
    p_c2: ArrayLike,
    dp2: ArrayLike,
) -> Number:
    """(6): `difference` without p_c2 - p_c1 and its fraction in the denominator.

    For p_c1 = 17.5, p_c2 - p_c1 = 0.1, dp = -2: 0.65 % of the difference too large
    (0.13 mm of 20 mm), of which the missing term has 0.73 % and the fraction, which the
    paper neglects knowingly, -0.08 %.
    """
    bent = _over((as_number(p_c2) - p_c1) * dp1, p_c1)
    product = _over(as_number(dp1) * dp2, p_c1)
    rise = as_number(camera_height) * (as_number(dp2) - dp1 - bent)
    return _over(rise, as_number(p_c1) + dp1 + dp2 + product)


def difference_approximate(
    camera_height: ArrayLike, p_c: ArrayLike, dp1: ArrayLike, dp2: ArrayLike
) -> Number:
    """(6'): H (dp2 - dp1) / (p_c + dp1 + dp2), for expected errors only.

    In one square (p_c = 17.5, dp = -2) it is 1.7 % too large; in two squares whose p_c
    differ by 0.1 it is wrong by 3 mm at H = 3500 however small the difference, because
    dp1 (p_c2 - p_c1) / p_c is missing in the numerator.
    """
    rise = as_number(camera_height) * (as_number(dp2) - dp1)
    return _over(rise, as_number(p_c) + dp1 + dp2)


def difference_in_square(
    camera_height: ArrayLike, p_c: ArrayLike, dp1: ArrayLike, dp2: ArrayLike
) -> Number:
    """(19): h2 - h1 of points in one square, exact: dp2 - dp1 is the difference of the
    readings of the points."""
    return difference(camera_height, p_c, dp1, p_c, dp2)


def sighted_height(station: Station, sight: Sight) -> Number:
    """The height of a point over the grid from all its measurements, (1) with (2)."""
    return height(station.camera_height, *_parallaxes(station, sight))


def sighted_difference(station: Station, first: Sight, second: Sight) -> Number:
    """The difference of height of two points from all their measurements, (5) with
    (2)."""
    parallaxes = *_parallaxes(station, first), *_parallaxes(station, second)
    return difference(station.camera_height, *parallaxes)


def _parallaxes(station: Station, sight: Sight) -> tuple[Number, Number]:
    """p_c and dp."""
    square = sight.square
    p_c = grid_parallax(station.base, square.photo_side, square.side)
    return p_c, as_number(sight.point) - sight.grid


def _over(a: ArrayLike, b: ArrayLike) -> Number:
    """a / b, but 0 / 0 = 0: padding, whose numbers are all 0, has height 0."""
    a, b = as_number(a), as_number(b)
    there = b != 0
    infinite = jnp.where(a == 0, 0.0, jnp.copysign(jnp.inf, a))
    return jnp.where(there, a / jnp.where(there, b, 1.0), infinite)
