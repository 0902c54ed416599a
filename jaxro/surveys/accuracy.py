"""Expected standard deviations of heights over a grid: closed forms of Gutkin (1982),
and exact budgets by autodiff.

The closed forms are kept as printed; each docstring says how much it differs from the
exact propagation through the formulas of `heights`, which `propagation.propagate_each`
and `budget` compute: use these for new work. All lengths have one unit; arrays
broadcast.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, PyTree

from ..adjustment.guarded import ratio, root
from ..xla.passes import total
from .heights import Number, as_number


class Terms(NamedTuple):
    """The parts of the standard deviation of a height, or of a difference, that come
    from the parallaxes, the camera height and the parallax of the grid, and all
    together: the rows of the paper's table."""

    readings: Number
    camera_height: Number
    grid_parallax: Number
    total: Number


def height_terms(
    camera_height: ArrayLike,
    p_c: ArrayLike,
    dp: ArrayLike,
    h: ArrayLike,
    m_dp: ArrayLike,
    m_camera_height: ArrayLike,
    m_p_c: ArrayLike,
) -> Terms:
    """The left half of the table: H m_dp / (p_c + dp), (3') h m_H / H and (4) h m_pc /
    (p_c + dp).

    The last two are exact. The exact first is this one times p_c / (p_c + dp): 6 % more
    for H = 3500, 12 % for H = 1500 and the shortest base. (3) and (4) in the text have
    p_c in place of p_c + dp, which makes them too small by the same factor.
    """
    whole = as_number(p_c) + dp
    return _terms(
        by_readings(camera_height, whole, m_dp),
        by_camera_height(h, camera_height, m_camera_height),
        by_grid_parallax(h, whole, m_p_c),
    )


def difference_terms(
    camera_height: ArrayLike,
    p_c: ArrayLike,
    dp: ArrayLike,
    difference: ArrayLike,
    m_dp: ArrayLike,
    m_camera_height: ArrayLike,
    m_p_c: ArrayLike,
) -> Terms:
    """The right half of the table: the terms of (7) with p_c + 2 dp in place of p_c, dp
    the same for both points."""
    whole = as_number(p_c) + 2 * as_number(dp)
    return _terms(
        by_readings(camera_height, whole, m_dp),
        by_camera_height(difference, camera_height, m_camera_height),
        by_grid_parallax(difference, whole, m_p_c),
    )


def _terms(*terms: Number) -> Terms:
    return Terms(*terms, _together(terms))


def _together(terms: Iterable[Number]) -> Number:
    """The root of the sum of the squares."""
    return root(sum((t**2 for t in terms), jnp.zeros(())))


def by_camera_height(
    h: ArrayLike, camera_height: ArrayLike, m_camera_height: ArrayLike
) -> Number:
    """(3'): |h| m_H / H, of a height or, as in (7), of a difference. Exact."""
    return jnp.abs(as_number(h)) / camera_height * m_camera_height


def by_grid_parallax(h: ArrayLike, p_c: ArrayLike, m_p_c: ArrayLike) -> Number:
    """(4): |h| m_pc / p_c; exact with p_c + dp for p_c."""
    return jnp.abs(as_number(h)) / p_c * m_p_c


def difference_deviation(
    camera_height: ArrayLike,
    p_c: ArrayLike,
    difference: ArrayLike,
    m_dp: ArrayLike,
    m_camera_height: ArrayLike,
    m_p_c: ArrayLike,
) -> Number:
    """(7): sqrt((H m_dp / p_c)² + (dh m_H / H)² + (dh m_pc / p_c)²).

    Compared with the exact propagation through (5) it neglects dp beside p_c: for dp =
    -1, p_c = 17.5 it is 11 % too small. With p_c + dp1 + dp2 in place of p_c, as in the
    paper's table, it is exact.
    """
    terms = (
        by_readings(camera_height, p_c, m_dp),
        by_camera_height(difference, camera_height, m_camera_height),
        by_grid_parallax(difference, p_c, m_p_c),
    )
    return _together(terms)


def allowed_camera_height(
    m_difference: ArrayLike, camera_height: ArrayLike, difference: ArrayLike
) -> Number:
    """The error of H that alone gives a difference the standard deviation m: m H / dh.
    (In print it is rounded down.)"""
    return as_number(m_difference) * camera_height / difference


def grid_parallax_deviation(
    p_c: ArrayLike,
    base: ArrayLike,
    photo_side: ArrayLike,
    side: ArrayLike,
    m_base: ArrayLike,
    m_photo_side: ArrayLike,
    m_side: ArrayLike,
) -> Number:
    """(8): p_c sqrt((m_B / B)² + (m_l / l)² + (m_L / L)²). Exact to first order."""
    parts = ((m_base, base), (m_photo_side, photo_side), (m_side, side))
    return as_number(p_c) * _together(as_number(m) / length for m, length in parts)


def by_readings(camera_height: ArrayLike, p_c: ArrayLike, m_dp: ArrayLike) -> Number:
    """(9): H m_dp / p_c."""
    return as_number(camera_height) / p_c * m_dp


def parallax_over_plane(
    focal: ArrayLike, camera_height: ArrayLike, base: ArrayLike
) -> Number:
    """(10): p_c = f B / H. The paper's largest base is H / 4."""
    return as_number(focal) * base / camera_height


def by_base(
    camera_height: ArrayLike, focal: ArrayLike, base: ArrayLike, m_dp: ArrayLike
) -> Number:
    """(11): H² m_dp / (f B). For f = 75 mm, m_dp = 8.5 µm it is H² / 8824 B, printed
    (11') with 9000; with B = H / 4 H / 2206, printed (11'') with 2200."""
    p_c = parallax_over_plane(focal, camera_height, base)
    return by_readings(camera_height, p_c, m_dp)


def middle_deviation(m: ArrayLike, legs: ArrayLike) -> Number:
    """(13): m sqrt(n) / 2, of the middle of an adjusted traverse of n legs between
    known heights, its weakest point. Exact.

    (Its first form is printed with sqrt(n/2) / 2 for sqrt(n/2) / sqrt(2).)
    """
    return as_number(m) * jnp.sqrt(as_number(legs)) / 2


def weighted_mean(heights: ArrayLike, legs: ArrayLike) -> Number:
    """(14): the height of a node from traverses with weights 1/n, along the last
    axis."""
    weight = 1 / as_number(legs)
    return total(weight * heights) / total(weight)


def unit_weight_deviation(heights: ArrayLike, legs: ArrayLike) -> Number:
    """(15): sqrt([p d²] / (k - 1)), d the deviations of k traverses from the weighted
    mean, p = 1/n (C = 1)."""
    legs = jnp.broadcast_to(as_number(legs), jnp.shape(heights))
    d = as_number(heights) - jnp.expand_dims(weighted_mean(heights, legs), -1)
    return root(total(d**2 / legs) / (legs.shape[-1] - 1))


def node_deviation(m: ArrayLike, legs: ArrayLike) -> Number:
    """(16) by propagation: m / sqrt([1/n]), of a node of traverses of n legs from known
    heights. Exact."""
    return as_number(m) / jnp.sqrt(total(1 / as_number(legs)))


def node_deviation_printed(m: ArrayLike, legs: ArrayLike) -> Number:
    """(16'): m sqrt(k / (k - 1)) / sqrt([1/n]); (17) rounds it to 1.1 m, (18) to H /
    2000.

    It takes deviations from the mean of k traverses for deviations from the true
    height. They are smaller, [p d²] = (k - 1) m² on average, and the exact value is
    `node_deviation`: (16') is 22 % too large for k = 3, 15 % for k = 4.
    """
    k = jnp.shape(legs)[-1]
    return node_deviation(m, legs) * jnp.sqrt(k / (k - 1.0))


def detail_deviation(m: ArrayLike, legs: ArrayLike, m_in_square: ArrayLike) -> Number:
    """(20): sqrt((m sqrt(n) / 2)² + m'²), of a point read from the middle of a traverse
    of n legs, m' by (11).

    For f = 75 mm, m_dp = 8.5 µm on the traverse and 5.6 µm in the square, n = 9, it is
    H² / 5385 B and with B = H / 4 H / 1346; printed with 5500 and 1400.
    """
    return _together((middle_deviation(m, legs), as_number(m_in_square)))


class Budget(NamedTuple):
    """The standard `deviation` of the value of a formula, and its `parts` from each
    number in the formula: shaped like these numbers, the sum of their squares is the
    square of `deviation`."""

    deviation: Number
    parts: PyTree

    @property
    def shares(self) -> PyTree:
        """The shares of the numbers in the variance; they add up to 1."""
        whole = self.deviation
        share = lambda part: ratio(part, whole, whole > 0) ** 2
        return jax.tree.map(share, self.parts)


def budget(function: Callable, values: PyTree, deviations: PyTree) -> Budget:
    """The exact propagation through a formula for single numbers, term by term.

    `values` and `deviations` as in `propagation.propagate_each`, which gives the
    `deviation` of the result alone.
    """
    leaves, structure = jax.tree.flatten((values, deviations))
    arrays = jnp.broadcast_arrays(*(as_number(a) for a in leaves))
    values, deviations = jax.tree.unflatten(structure, arrays)
    # the elements of the arrays do not depend on one another, so that the gradient of
    # their sum holds the derivatives of all
    slopes = jax.grad(lambda numbers: jnp.sum(function(numbers)))(values)
    parts = jax.tree.map(lambda slope, s: jnp.abs(slope) * s, slopes, deviations)
    return Budget(_together(jax.tree.leaves(parts)), parts)
