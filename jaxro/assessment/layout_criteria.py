"""How good a layout of points is: criteria of accuracy and reliability.

Nothing is measured yet: normal matrix and redundancy numbers are those of the errorless
pair that the terrain gives at the planned positions. All criteria are standard
deviations, or errors, for coordinates of standard deviation `sigma`: half the value is
twice as good.

A criterion of your own subclasses `AbstractCriterion` and defines `values`;
`layout_design.design` minimises it.
"""

import abc
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, ArrayLike, Float

from ..adjustment import normal_equations as normal
from ..adjustment.guarded import root
from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import AbstractElements, DependentElements, vertical
from ..geometry.linear import Linear, linearise
from ..geometry.mock_pairs import Layout, mock_pair
from ..geometry.pairs import Coordinates, Pair
from ..xla.passes import total

Positions = tuple[Float[Array, "point"], Float[Array, "point"]]
"""x and y in the ideal vertical left photo, in its unit."""

DELTA0 = 4.13
"""Non-centrality of Baarda's test: a level of 0.1 % and a power of 80 %."""

UNCHECKED = 1e-16
"""Redundancy number of a coordinate below which it counts as this: an error in it is
found at 1e8 delta0 sigma, in place of infinity, which has no gradient."""

DETERMINED = 1e-6
"""Redundancy numbers are at most 1; above 1 + DETERMINED they are those of a pair whose
elements the points do not determine."""


class Overlap(eqx.Module):
    """Where points can be measured: a box in the ideal vertical left photo, between
    x[0] and x[1], y[0] and y[1].

    `elements`: position of the photos, and the system of elements whose accuracy counts
    (vertical photos as `RelativePose`, five angles, if not given). `base`: length of
    the base at photo scale. `terrain`: a function of x and y that gives the height
    above the plane, at photo scale, where a ray of the vertical photo ends; or a
    height, one or one per point, that stays the same wherever the points lie.
    """

    x: tuple[ArrayLike, ArrayLike]
    y: tuple[ArrayLike, ArrayLike]
    base: ArrayLike
    focal: ArrayLike
    terrain: Callable | ArrayLike = 0.0
    elements: AbstractElements | None = None


class Plan(NamedTuple):
    """A layout as a criterion sees it: the errorless pair, the elements, the conditions
    linearised there, normal matrix (lower triangle) and cofactors of the elements, and
    the redundancy numbers of the points."""

    overlap: Overlap
    pair: Pair
    elements: AbstractElements
    linear: Linear
    normal_matrix: normal.Lower
    cofactor: Float[Array, "5 5"]
    redundancy: Float[Array, "point"]


def plan_layout(overlap: Overlap, positions: Positions, sigma: ArrayLike = 1.0) -> Plan:
    """The layout of points at these positions, coordinates with this standard
    deviation."""
    pair = photograph(overlap, positions, sigma)
    elements = overlap.elements
    if elements is None:
        elements = vertical(pair.focal_left)
    linear = linearise(pair, elements)
    n, _, _ = linear.normal_equations()
    q, _ = normal.inverse(n)
    return Plan(
        overlap=overlap,
        pair=pair,
        elements=elements,
        linear=linear,
        normal_matrix=n,
        cofactor=normal.dense(q),
        redundancy=1 - linear.weight * normal.quadratic(q, linear.columns),
    )


def photograph(overlap: Overlap, positions: Positions, sigma: ArrayLike) -> Pair:
    """The errorless pair of points at these positions."""
    x, y = positions
    heights = overlap.terrain
    if callable(heights):
        heights = jax.vmap(heights)(x, y)
    layout = Layout(x / overlap.base, y, ())  # pyright: ignore[reportArgumentType]  (arrays, to be differentiated)
    pair = mock_pair(
        layout,
        overlap.elements,
        focal=overlap.focal,
        base=overlap.base,
        y_range=1.0,
        heights=jnp.asarray(heights),
    )
    sigmas = jnp.broadcast_to(jnp.asarray(sigma, x.dtype), x.shape)
    return eqx.tree_at(lambda p: p.sigma, pair, sigmas)


class AbstractCriterion(eqx.Module):
    """A number that a layout should make small: the largest of some positive `values`,
    or (not `largest`) their root mean square. `fewest`: points that a layout needs."""

    largest: eqx.AbstractClassVar[bool]
    fewest: eqx.AbstractClassVar[int]

    @abc.abstractmethod
    def values(self, plan: Plan) -> Float[Array, "value"]:
        """The positive numbers, of a planned layout."""

    def __call__(self, plan: Plan) -> Float[Array, ""]:
        values = self.values(plan)
        if self.largest:
            return jnp.max(values)
        return jnp.sqrt(total(values**2) / values.size)

    def logarithm(self, plan: Plan, p: ArrayLike) -> Float[Array, ""]:
        """Logarithm of the criterion, with the p-norm in place of the largest value: it
        is smooth."""
        if self.largest:
            return logsumexp(p * jnp.log(self.values(plan))) / p
        return jnp.log(self(plan))


class Determinant(AbstractCriterion):
    """(det C)^(1/10), C = sigma² Q of the five elements: geometric mean of the standard
    deviations along the axes of their ellipsoid (D-optimal). Its best layout is the
    same in every system of elements."""

    largest: ClassVar[bool] = False
    fewest: ClassVar[int] = 5

    def values(self, plan):
        factor, _ = normal.cholesky(plan.normal_matrix)
        inverses = jnp.stack([row[-1] for row in factor])  # of the diagonal
        return jnp.exp(jnp.sum(jnp.log(inverses)) / 5)[None]


class Trace(AbstractCriterion):
    """sqrt(tr C / 5): root mean square of the standard deviations of the five elements
    (A-optimal). It mixes units where not all elements are angles."""

    largest: ClassVar[bool] = False
    fewest: ClassVar[int] = 5

    def values(self, plan):
        return jnp.sqrt(jnp.diagonal(plan.cofactor))


class DetectableError(AbstractCriterion):
    """The largest minimal detectable error of the y coordinates, or of the
    `coordinates` with other numbers in x_left, y_left, x_right, y_right."""

    largest: ClassVar[bool] = True
    fewest: ClassVar[int] = 6
    coordinates: tuple[int, ...] = (1, 3)
    delta0: ArrayLike = DELTA0

    def values(self, plan):
        errors = detectable_errors(plan, self.delta0)
        return jnp.concatenate([errors[k] for k in self.coordinates])


class HeightDeviation(AbstractCriterion):
    """The largest standard deviation of a model height, of new points on a grid over
    the overlap, measured as well as the others; in the unit of the base. They lie on
    the terrain, or in the plane where the points keep their heights.

    Z is the height in the frame of the elements, which depends on the left photo:
    mirrored from left to right a layout has other heights."""

    largest: ClassVar[bool] = True
    fewest: ClassVar[int] = 5
    grid: int = 5

    def values(self, plan):
        box, dtype = plan.overlap, plan.pair.x_left.dtype
        sides = [jnp.linspace(*side, self.grid, dtype=dtype) for side in (box.x, box.y)]
        x, y = (a.ravel() for a in jnp.meshgrid(*sides, indexing="ij"))
        surface = box.terrain if callable(box.terrain) else 0.0
        box = Overlap(box.x, box.y, box.base, box.focal, surface, box.elements)
        points = photograph(box, (x, y), plan.pair.sigma[0])
        return height_deviations(plan, points, box.base)


def detectable_errors(plan: Plan, delta0: ArrayLike = DELTA0) -> Coordinates:
    """The minimal detectable error of each coordinate l of every point, x_left, y_left,
    x_right, y_right (Baarda 1968):

        delta0 sqrt(B Q Bᵀ) / (|dg/dl| sqrt(r)),

    r the redundancy number of its condition; 1e8 delta0 sigma where nothing checks a
    coordinate.
    """
    sigma, r = plan.pair.sigma, plan.redundancy
    determined = r < 1 + DETERMINED

    def error(b: Array) -> Array:
        own = r * b**2 * sigma**2 * plan.linear.weight
        checked = (own > UNCHECKED) & determined
        return (
            jnp.asarray(delta0) * sigma / jnp.sqrt(jnp.where(checked, own, UNCHECKED))
        )

    return tuple(error(b) for b in plan.linear.gradient)


def height_deviations(
    plan: Plan, points: Pair, base: ArrayLike
) -> Float[Array, "point"]:
    """Standard deviations of Z of points, in the model frame of the elements, with this
    length of the base (`DependentElements` have their own).

    Z is computed from the corrected coordinates l + v: s² = z_x Q z_xᵀ + sigma² |z_l|²,
    z_x = dZ/dx, z_l = dZ/dl. There is no mixed term, for new points nor for those
    adjusted, because l + v is independent of the misclosure g.
    """
    q = plan.cofactor
    origin = (jnp.zeros_like(q[0, 0]),) * 5
    if isinstance(plan.elements, DependentElements):
        base = 1.0
    length = jnp.asarray(base, q.dtype)
    focals = points.focal_left, points.focal_right
    slopes = jax.grad(
        lambda step, point: _height(plan.elements.move(step), length, point, focals),
        argnums=(0, 1),
    )

    def deviation(point, sigma):
        by_step, by_point = slopes(origin, point)
        by_step = jnp.stack(by_step)
        variance = jnp.sum(by_step[:, None] * q * by_step[None, :])
        by_points = sigma**2 * sum(e**2 for e in by_point)
        return root(variance + by_points)

    return jax.vmap(deviation)(points.coordinates, points.sigma)


def _height(elements: AbstractElements, length: Array, point, focals) -> Array:
    """Z of one point from its corrected coordinates, with a base of this length."""
    (rotation, base), frame = elements.relative(), elements.model_frame()
    f = coplanarity.fundamental_matrix(rotation, base, *focals)
    v = coplanarity.corrections(f, point, jnp.asarray(True))
    corrected = tuple(c + d for c, d in zip(point, v, strict=True))
    right = rot.product(frame, rotation)
    first, second = coplanarity.directions(frame, right, corrected, *focals)
    along = rot.scale(rot.apply(frame, base), length)
    lam, mu, near = coplanarity.depths(first, second, along)
    return coplanarity.halfway(first, second, along, lam * near, mu * near)[2]
