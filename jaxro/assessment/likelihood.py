"""Regions and intervals by likelihood, for pairs whose normal equations change within
their own accuracy.

The covariance describes the misfit S(x) = Σ r² near its minimum x0 by a parabola. With
a short base, or hardly more than five points, S bends away from it before the elements
have moved by their standard deviations, and "value ± deviation" holds less often than
it says. The measurements themselves tell the region that no choice of elements changes:
all x with

    S(x) - S(x0) <= s² χ²(5),    or    s² 5 F(5, n - 5)    where s is estimated,

the likelihood ratio of x against x0 (Wilks 1938). The interval of one number h(x)
reaches from its least to its largest value where S is above its minimum by at most s²
times the square of the normal quantile, or of Student's t (Venzon and Moolgavkar 1988).

For orientations with rigorous residuals and without a loss. Of weights that were chosen
by the residuals S is no likelihood: of such a pair `ends` is asked with a limit for each
number at which the parabola of S ends where the deviation of the M-estimate does.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, ScalarLike

from ..adjustment import critical_values, normal_equations as normal
from ..geometry import coplanarity
from ..geometry.elements import AbstractElements
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.degeneracy import bend, direction_of_worst
from ..orientation.result import Orientation
from ..xla.passes import sums, total
from ..xla.programs import compiled
from .sensitivity import displacement

Number = Float[Array, ""]
Numbers = Float[Array, "number"]
Quantity = Callable[[AbstractElements, AbstractElements], Numbers]
"""Numbers h(centre, elements) of any elements, beside those of the orientation."""

CURVED = 0.3
"""The `curvature` from which deviations are told to be too simple: of six and seven
points with bases of 3 and 5° joint 95 % regions by the covariance hold 92 to 94 % below
.1, 84 to 90 % from here on, and 77 to 83 % above 1."""

MOST_STEPS = 200
"""Towards an end of an interval; from 4 to 20 where S sets it."""

CLOSE = 1e-9
"""Gain of a step, over the width of the interval, below which its end is reached."""

LONGEST, SHORTER = 2.0, 0.25
"""Of a step, in widths of the region by the covariance; and by what the next one is
shorter where one gains nothing."""


def misfit(pair: Pair, elements: AbstractElements) -> Number:
    """S, the sum of the squared whitened residuals of one pair at any elements."""
    return total(coplanarity.residuals(mask_unusable(pair)[0], elements)() ** 2)


@compiled
def curvature(
    pair: Pair, orientation: Orientation, *, sigma0: ArrayLike | None = None
) -> Number:
    """How far S departs from its parabola two standard deviations along the worst
    determined direction: |rise of S / rise of the parabola - 1|, on the side where that
    is more.

    Zero for a linear adjustment; from `CURVED` on `interval` tells what deviations do
    not. `sigma0`: the standard deviation of unit weight where it is known (1 where the
    sigmas of the pair are standard deviations), or else that of the orientation. Of one
    pair; works under jit and vmap.
    """
    pair, centre = mask_unusable(pair)[0], orientation.elements
    direction, variance = direction_of_worst(centre, orientation.cofactor)
    away = 2 * _unit(orientation, sigma0) * jnp.sqrt(variance)
    at, slope, _ = bend(pair, centre, direction)
    ahead, behind = (
        coplanarity.fundamental_matrix(
            *centre.move(tuple(t * e for e in direction)).relative(),
            pair.focal_left,
            pair.focal_right,
        )
        for t in (away, -away)
    )

    def of_point(point, sigma, use, roots):
        line = lambda f: coplanarity.linearise(f, point, use, roots)
        g, square, b = line(at)
        h, _, turned = line(slope)
        # r' of r = g / |B|
        h = h - g * sum(x * y for x, y in zip(b, turned, strict=True)) / square
        rises = [g**2 / square for g, square, _ in map(line, (ahead, behind))]
        squares = g**2 / square, g * h / square, h**2 / square, *rises
        return tuple(jnp.where(use, entry / sigma**2, 0.0) for entry in squares)

    measured = pair.coordinates, pair.sigma, pair.mask, pair.roots
    here, falls, bends, *there = sums(jax.vmap(of_point)(*measured))
    # but for its slope, which is zero in the minimum of S: weights that fade have another
    parabola = bends * away**2
    rises = [
        s - here - 2 * t * falls for s, t in zip(there, (away, -away), strict=True)
    ]
    return jnp.maximum(*(jnp.abs(rise / parabola - 1) for rise in rises))


def region_holds(
    pair: Pair,
    orientation: Orientation,
    elements: AbstractElements,
    confidence: ScalarLike = 0.95,
    *,
    sigma0: ArrayLike | None = None,
) -> Bool[Array, ""]:
    """Whether the joint region of an oriented pair holds these elements, of any system;
    without redundancy and a known sigma0 it holds all."""
    rise = misfit(pair, elements) - misfit(pair, orientation.elements)
    limit = orientation.radius(confidence, sigma0=sigma0) ** 2
    return ~(rise > limit * _unit(orientation, sigma0) ** 2)


class Interval(NamedTuple):
    """From `least` to `most`, for each number; infinite where the measurements set no
    end, or none is found."""

    least: Numbers
    most: Numbers


def interval(
    pair: Pair,
    orientation: Orientation,
    confidence: ScalarLike = 0.95,
    *,
    quantity: Quantity = displacement,
    sigma0: ArrayLike | None = None,
) -> Interval:
    """The intervals by likelihood of numbers of the elements of one oriented pair.

    `quantity`: h(centre, elements), with `centre` those of the orientation; if not
    given how far the five (local) elements are from it. `sigma0` as in `curvature`.
    """
    if sigma0 is None:
        freedom = jnp.asarray(orientation.degrees_of_freedom, float)
        width = critical_values.half_width(confidence, freedom)
    else:
        width = critical_values.normal(1 - confidence)
    limit = (width * _unit(orientation, sigma0)) ** 2
    return ends(pair, orientation.elements, limit, quantity=quantity)


def _unit(orientation: Orientation, sigma0: ArrayLike | None) -> Number:
    """The standard deviation of unit weight, as given or of the orientation."""
    own = orientation.sigma0
    return own if sigma0 is None else jnp.asarray(sigma0, own.dtype)


@compiled
def ends(
    pair: Pair, centre: AbstractElements, limit: ArrayLike, *, quantity: Quantity
) -> Interval:
    """The least and the largest values of numbers of the elements where S is above its
    minimum, in `centre`, by the limit, one for all numbers or of each."""
    residuals = coplanarity.residuals(mask_unusable(pair)[0], centre)
    white = lambda x: residuals(tuple(x))
    number = lambda x: quantity(centre, centre.move(x).normalise())
    origin = jnp.zeros(centre.count)

    def end(which: Int[Array, ""], limit: Number, sign: Number) -> Number:
        return _End(white, lambda x: number(x)[which], origin, limit, sign).find()

    numbers = jnp.arange(jax.eval_shape(number, origin).size)
    limits = jnp.broadcast_to(jnp.asarray(limit, float), numbers.shape)
    find = jax.vmap(end, in_axes=(0, 0, None))
    return Interval(*(find(numbers, limits, jnp.asarray(sign)) for sign in (-1.0, 1.0)))


class _Way(NamedTuple):
    """A place on the way to an end, and its merit; `longest`: the step that may follow,
    in widths of the region by the covariance; `arrived`; `left`: steps that may
    follow."""

    x: Float[Array, "5"]
    merit: Number
    longest: Number
    arrived: Bool[Array, ""]
    left: Int[Array, ""]


class _Step(NamedTuple):
    """A step, its length for sigma0 = 1, and the variance of h where it begins."""

    x: Float[Array, "5"]
    length: Number
    variance: Number


class _End(NamedTuple):
    """The end of h = `value(x)` in the direction of `sign` where S, the squares of
    `white(x)`, is above its minimum at the `origin` by the limit.

    At x, with the residuals r, their columns A, N = AᵀA and the slope a of h, S changes
    by 2 gᵀd + dᵀNd with g = Aᵀr. The end of h among the d that leave S below its
    minimum plus the limit is d = -N⁻¹g ± λ N⁻¹a with λ² aᵀN⁻¹a = what is left of the
    limit in the lowest point of this parabola. The step to it is repeated there; one
    that makes nothing better is taken back, and the next is shorter: h may have its end
    within the region, as the longest component of a base does.
    """

    white: Callable
    value: Callable
    origin: Float[Array, "5"]
    limit: Number
    sign: Number

    def find(self) -> Number:
        """The value there; infinite where it is not reached."""
        width = jnp.sqrt(self.limit * self.step(self.origin).variance)
        first = _Way(
            x=self.origin,
            merit=self.merit(self.origin, width),
            longest=jnp.asarray(LONGEST),
            arrived=jnp.asarray(False),
            left=jnp.asarray(MOST_STEPS),
        )
        goes_on = lambda way: ~way.arrived & (way.left > 0)
        further = lambda way: self.further(way, width)
        last = jax.lax.while_loop(goes_on, further, first)
        return jnp.where(last.arrived, self.value(last.x), self.sign * jnp.inf)

    def further(self, way: _Way, width: Number) -> _Way:
        """The next place, or the same one with a shorter step to follow."""
        unit = jnp.sqrt(self.limit)
        step = self.step(way.x)
        x = way.x + step.x * jnp.minimum(1.0, way.longest * unit / step.length)
        merit = self.merit(x, width)
        gain = merit - way.merit
        small = jnp.abs(gain) < CLOSE
        longer = jnp.minimum(way.longest / SHORTER, LONGEST)
        shorter = jnp.minimum(way.longest, step.length / unit) * SHORTER
        moved = _Way(x, merit, longer, small, way.left - 1)
        stayed = _Way(way.x, way.merit, shorter, small, way.left - 1)
        return jax.tree.map(lambda a, b: jnp.where(gain > 0, a, b), moved, stayed)

    def step(self, x: Float[Array, "5"]) -> _Step:
        """The step from x to the end as the parabola at x has it."""
        columns = jax.jacfwd(self.white)(x)
        n, g, squares = normal.accumulate([self.white(x)], [[c] for c in columns.T])
        q, g = normal.dense(normal.inverse(n)[0]), jnp.stack(list(g))
        slope = jax.grad(self.value)(x)
        along, down = q @ slope, q @ g
        variance = slope @ along
        left = self.limit - (squares - self.squares(self.origin)) + g @ down
        reach = jnp.sqrt(jnp.maximum(left, 0.0) / variance)
        step = self.sign * reach * along - down
        length = jnp.sqrt(step @ normal.dense(n) @ step)
        return _Step(step, length, variance)

    def merit(self, x: Float[Array, "5"], width: Number) -> Number:
        """The value beyond that of the origin, over the width of the interval, less what
        S is above the limit."""
        gained = self.sign * (self.value(x) - self.value(self.origin)) / width
        rise = self.squares(x) - self.squares(self.origin)
        return gained - jnp.maximum(rise / self.limit - 1, 0.0)

    def squares(self, x: Float[Array, "5"]) -> Number:
        """S."""
        return total(self.white(x) ** 2)
