"""Heights over a horizontal grid of squares from the parallaxes of an uncalibrated pair
of photos (Gutkin 1982).

    (2)  p_c = B l / L                           the parallax of the grid, from one of its squares
    (1)  h = H dp / (p_c + dp)                   height over the grid; negative below it
    (5)  h2 - h1 of points in two squares,       (19) in one

with dp the horizontal parallax read at a point less that read at the grid there, H the
height of the cameras over the grid, B their base, L a side of the square and l its
length on the photo. Lengths in one unit; every function is the formula for single
numbers and takes arrays that broadcast together.

(1) holds for tilted photos as well, where l and the parallax of the grid are those at
the point: on the photo whose mark moves, the right one here, a height displaces the
point by the picture of B h / (H - h), whatever its tilt.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

Number = Float[Array, "..."]


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
    """A point read in a square: readings of the grid beside the point, and of the point
    itself."""

    square: Square
    grid: ArrayLike
    point: ArrayLike


def grid_parallax(base: ArrayLike, photo_side: ArrayLike, side: ArrayLike) -> Number:
    """(2): p_c = B l / L."""
    return _over(jnp.asarray(photo_side, float) * base, side)


def height(camera_height: ArrayLike, p_c: ArrayLike, dp: ArrayLike) -> Number:
    """(1): h = H dp / (p_c + dp), the height of a point over the grid."""
    return _over(jnp.asarray(camera_height, float) * dp, jnp.asarray(p_c, float) + dp)


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
    shift = jnp.asarray(p_c2, float) - p_c1
    bent = _over(shift * dp1, p_c1)
    return _over(
        jnp.asarray(camera_height, float) * (jnp.asarray(dp2, float) - dp1 - bent),
        jnp.asarray(p_c1, float)
        + dp1
        + dp2
        + shift
        + bent
        + _over(jnp.asarray(dp1, float) * dp2, p_c1),
    )


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
    bent = _over((jnp.asarray(p_c2, float) - p_c1) * dp1, p_c1)
    return _over(
        jnp.asarray(camera_height, float) * (jnp.asarray(dp2, float) - dp1 - bent),
        jnp.asarray(p_c1, float)
        + dp1
        + dp2
        + _over(jnp.asarray(dp1, float) * dp2, p_c1),
    )


def difference_approximate(
    camera_height: ArrayLike, p_c: ArrayLike, dp1: ArrayLike, dp2: ArrayLike
) -> Number:
    """(6'): H (dp2 - dp1) / (p_c + dp1 + dp2), for expected errors only.

    In one square (p_c = 17.5, dp = -2) it is 1.7 % too large; in two squares whose p_c
    differ by 0.1 it is 3 mm off at H = 3500 however small the difference, because dp1
    dp_c / p_c is missing in the numerator.
    """
    return _over(
        jnp.asarray(camera_height, float) * (jnp.asarray(dp2, float) - dp1),
        jnp.asarray(p_c, float) + dp1 + dp2,
    )


def difference_in_square(
    camera_height: ArrayLike, p_c: ArrayLike, dp1: ArrayLike, dp2: ArrayLike
) -> Number:
    """(19): h2 - h1 of points in one square, exact: dp2 - dp1 is the difference of the
    readings of the points."""
    return difference(camera_height, p_c, dp1, p_c, dp2)


def sighted(station: Station, sight: Sight) -> Number:
    """The height of a point over the grid from everything measured for it, (1) with
    (2)."""
    square = sight.square
    p_c = grid_parallax(station.base, square.photo_side, square.side)
    return height(
        station.camera_height, p_c, jnp.asarray(sight.point, float) - sight.grid
    )


def sighted_difference(station: Station, first: Sight, second: Sight) -> Number:
    """The difference of height of two points from everything measured for them, (5)
    with (2)."""
    p_c = [
        grid_parallax(station.base, s.square.photo_side, s.square.side)
        for s in (first, second)
    ]
    dp = [jnp.asarray(s.point, float) - s.grid for s in (first, second)]
    return difference(station.camera_height, p_c[0], dp[0], p_c[1], dp[1])


def _over(a: ArrayLike, b: ArrayLike) -> Number:
    """a / b, but 0 / 0 = 0: padding, whose numbers are all 0, has height 0."""
    a, b = jnp.asarray(a, float), jnp.asarray(b, float)
    there = b != 0
    return jnp.where(
        there,
        a / jnp.where(there, b, 1.0),
        jnp.where(a == 0, 0.0, jnp.copysign(jnp.inf, a)),
    )
