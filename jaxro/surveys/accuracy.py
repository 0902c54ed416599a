"""Expected standard deviations of heights over a grid: closed forms of Gutkin (1982),
and exact budgets by autodiff.

The closed forms are kept as printed; each docstring says how far it is from the exact
propagation through the formulas of `heights`, which `propagation.propagate_each` and
`budget` give. Lengths in one unit; arrays broadcast.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, PyTree

from ..adjustment.guarded import root
from ..xla.passes import total
from .heights import Number


class Terms(NamedTuple):
    """What the parallaxes, the camera height and the parallax of the grid add to the
    standard deviation of a height or a difference, and all together: the rows of the
    paper's table."""

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

    The last two are exact. The first is exact times p_c / (p_c + dp): 6 % more for H =
    3500, 12 % for H = 1500 and the shortest base. (3) and (4) in the text have p_c for
    p_c + dp, with which they are as much too small.
    """
    from_readings = (
        jnp.asarray(camera_height, float) * m_dp / (jnp.asarray(p_c, float) + dp)
    )
    from_grid = jnp.abs(jnp.asarray(h, float)) / (jnp.asarray(p_c, float) + dp) * m_p_c
    return _terms(
        from_readings, by_camera_height(h, camera_height, m_camera_height), from_grid
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
    """The right half of the table: (7) with p_c + 2 dp for p_c, dp that of both
    points."""
    reduced = jnp.asarray(p_c, float) + 2 * jnp.asarray(dp, float)
    from_grid = jnp.abs(jnp.asarray(difference, float)) / reduced * m_p_c
    from_readings = jnp.asarray(camera_height, float) * m_dp / reduced
    return _terms(
        from_readings,
        by_camera_height(difference, camera_height, m_camera_height),
        from_grid,
    )


def _terms(*terms: Number) -> Terms:
    return Terms(*terms, root(sum((t**2 for t in terms), jnp.zeros(()))))


def by_camera_height(
    h: ArrayLike, camera_height: ArrayLike, m_camera_height: ArrayLike
) -> Number:
    """(3'): |h| m_H / H, of a height or, as in (7), of a difference. Exact."""
    return jnp.abs(jnp.asarray(h, float)) / camera_height * m_camera_height


def by_grid_parallax(h: ArrayLike, p_c: ArrayLike, m_p_c: ArrayLike) -> Number:
    """(4): |h| m_pc / p_c; exact with p_c + dp for p_c."""
    return jnp.abs(jnp.asarray(h, float)) / p_c * m_p_c


def difference_deviation(
    camera_height: ArrayLike,
    p_c: ArrayLike,
    difference: ArrayLike,
    m_dp: ArrayLike,
    m_camera_height: ArrayLike,
    m_p_c: ArrayLike,
) -> Number:
    """(7): sqrt((H m_dp / p_c)² + (dh m_H / H)² + (dh m_pc / p_c)²).

    Of the exact propagation through (5) it neglects dp beside p_c: for dp = -1, p_c =
    17.5 it is 11 % too small. Use p_c + dp1 + dp2 as the paper does in its table, and
    nothing is left of that.
    """
    terms = (
        by_readings(camera_height, p_c, m_dp),
        by_camera_height(difference, camera_height, m_camera_height),
        by_grid_parallax(difference, p_c, m_p_c),
    )
    return root(sum((t**2 for t in terms), jnp.zeros(())))


def allowed_camera_height(
    m_difference: ArrayLike, camera_height: ArrayLike, difference: ArrayLike
) -> Number:
    """The error of H that alone gives a difference the standard deviation m: m H / dh.
    (The print rounds it down.)"""
    return jnp.asarray(m_difference, float) * camera_height / difference


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
    return jnp.asarray(p_c, float) * root(
        sum(((jnp.asarray(m, float) / of) ** 2 for m, of in parts), jnp.zeros(()))
    )


def by_readings(camera_height: ArrayLike, p_c: ArrayLike, m_dp: ArrayLike) -> Number:
    """(9): H m_dp / p_c."""
    return jnp.asarray(camera_height, float) / p_c * m_dp


def parallax_over_plane(
    focal: ArrayLike, camera_height: ArrayLike, base: ArrayLike
) -> Number:
    """(10): p_c = f B / H. The paper's largest base is H / 4."""
    return jnp.asarray(focal, float) * base / camera_height


def by_base(
    camera_height: ArrayLike, focal: ArrayLike, base: ArrayLike, m_dp: ArrayLike
) -> Number:
    """(11): H² m_dp / (f B). For f = 75 mm, m_dp = 8.5 µm it is H² / 8824 B, printed
    (11') with 9000; with B = H / 4 H / 2206, printed (11'') with 2200."""
    return by_readings(
        camera_height, parallax_over_plane(focal, camera_height, base), m_dp
    )


def middle_deviation(m: ArrayLike, legs: ArrayLike) -> Number:
    """(13): m sqrt(n) / 2, the weakest point of a traverse of n legs between known
    heights, adjusted. Exact.

    (Its first form is printed with sqrt(n/2) / 2 for sqrt(n/2) / sqrt(2).)
    """
    return jnp.asarray(m, float) * jnp.sqrt(jnp.asarray(legs, float)) / 2


def weighted_mean(heights: ArrayLike, legs: ArrayLike) -> Number:
    """(14): the height of a node from traverses with weights 1/n, along the last
    axis."""
    weight = 1 / jnp.asarray(legs, float)
    return total(weight * heights) / total(weight)


def unit_weight_deviation(heights: ArrayLike, legs: ArrayLike) -> Number:
    """(15): sqrt([p d²] / (k - 1)), d the deviations of k traverses from the weighted
    mean, p = 1/n (C = 1)."""
    legs = jnp.broadcast_to(jnp.asarray(legs, float), jnp.shape(heights))
    d = jnp.asarray(heights, float) - jnp.expand_dims(weighted_mean(heights, legs), -1)
    return root(total(d**2 / legs) / (legs.shape[-1] - 1))


def node_deviation(m: ArrayLike, legs: ArrayLike) -> Number:
    """(16) by propagation: m / sqrt([1/n]), a node of traverses of n legs from known
    heights. Exact."""
    return jnp.asarray(m, float) / jnp.sqrt(total(1 / jnp.asarray(legs, float)))


def node_deviation_printed(m: ArrayLike, legs: ArrayLike) -> Number:
    """(16'): m sqrt(k / (k - 1)) / sqrt([1/n]); (17) rounds it to 1.1 m, (18) to H /
    2000.

    Deviations from the mean of k traverses are put in as if they were those from the
    true height. They are smaller, [p d²] = (k - 1) m² on average, and the exact value
    is `node_deviation`: (16') is 22 % too large for k = 3, 15 % for k = 4.
    """
    k = jnp.shape(legs)[-1]
    return node_deviation(m, legs) * jnp.sqrt(k / (k - 1.0))


def detail_deviation(m: ArrayLike, legs: ArrayLike, m_in_square: ArrayLike) -> Number:
    """(20): sqrt((m sqrt(n) / 2)² + m'²), a point read from the middle of a traverse of
    n legs, m' by (11).

    For f = 75 mm, m_dp = 8.5 µm on the traverse and 5.6 µm in the square, n = 9, it is
    H² / 5385 B and with B = H / 4 H / 1346; printed with 5500 and 1400.
    """
    return root(middle_deviation(m, legs) ** 2 + jnp.asarray(m_in_square, float) ** 2)


class Budget(NamedTuple):
    """The standard deviation of a formula's value, and what each number it is
    calculated from adds to it: `parts` is shaped as these numbers, and the sum of their
    squares is the square of `deviation`."""

    deviation: Number
    parts: PyTree

    @property
    def shares(self) -> PyTree:
        """The parts of the variance, of 1."""
        return jax.tree.map(lambda part: _share(part, self.deviation), self.parts)


def budget(function: Callable, values: PyTree, deviations: PyTree) -> Budget:
    """Which number costs how much: the exact propagation through a formula for single
    numbers, term by term.

    `values` and `deviations` as in `propagation.propagate_each`, whose result
    `deviation` is.
    """
    arrays = jnp.broadcast_arrays(
        *(jnp.asarray(a, float) for a in jax.tree.leaves((values, deviations)))
    )
    values, deviations = jax.tree.unflatten(
        jax.tree.structure((values, deviations)), arrays
    )
    slopes = jax.grad(lambda numbers: jnp.sum(function(numbers)))(
        values
    )  # element by element: no one feels another
    parts = jax.tree.map(lambda slope, s: jnp.abs(slope) * s, slopes, deviations)
    return Budget(
        root(sum((p**2 for p in jax.tree.leaves(parts)), jnp.zeros(()))), parts
    )


def _share(part: Number, whole: Number) -> Number:
    there = whole > 0
    return jnp.where(there, part / jnp.where(there, whole, 1.0), 0.0) ** 2
