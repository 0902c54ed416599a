"""Where to measure: positions of points that make a criterion of accuracy or
reliability best, by gradient.

Nothing is measured yet: normal matrix and redundancy numbers are those of the errorless
pair that the terrain gives at the positions. Each coordinate is x = middle + half
sin(u), so that it stays in the overlap and a best place at its edge is an ordinary
stationary point (with a sigmoid it would lie at infinity); BFGS improves u from several
random starts at once, and the best of them counts.

All criteria are standard deviations, or errors, for coordinates of standard deviation
`sigma`: half the value is twice as good. A largest value is not smooth: what is
minimised then is the p-norm for p = 16 and after that for p = 256, at most 2 % above
it; reported and compared are the largest values themselves.
"""

import abc
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from ..adjustment import normal_equations as normal
from ..adjustment.guarded import root
from ..adjustment.least_squares import Adjustment, read
from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import AbstractElements, DependentElements, vertical
from ..geometry.mock_pairs import Layout, mock_pair
from ..geometry.pairs import Pair
from ..xla.passes import total
from ..xla.programs import Program, is_traced
from ..xla.settings import COMPILE_FAST

Positions = tuple[Float[Array, "point"], Float[Array, "point"]]
"""x and y in the ideal vertical left photo, in its unit."""

NORMS = (16.0, 256.0)
"""p of the p-norms that stand for the largest value, one after the other."""

STEPS = 300
"""Steps of BFGS allowed for each of them."""

DELTA0 = 4.13
"""Non-centrality of Baarda's test: a level of 0.1 % and a power of 80 %."""


class Overlap(eqx.Module):
    """Where points can be measured: a box in the ideal vertical left photo, between
    x[0] and x[1], y[0] and y[1].

    `elements`: position of the photos, and the system whose accuracy counts (vertical
    photos as `RelativePose`, five angles, if not given). `base`: length of the base at
    photo scale. `terrain(x, y)`: height above the plane, at photo scale, where a ray of
    the vertical photo ends; or a height that every point, or each, keeps wherever it
    goes.
    """

    x: tuple[ArrayLike, ArrayLike]
    y: tuple[ArrayLike, ArrayLike]
    base: ArrayLike
    focal: ArrayLike
    terrain: Callable | ArrayLike = 0.0
    elements: AbstractElements | None = None


class Plan(NamedTuple):
    """A layout as a criterion sees it: the errorless pair and the adjustment of it."""

    pair: Pair
    adjustment: Adjustment
    overlap: Overlap


def planned(overlap: Overlap, positions: Positions, sigma: ArrayLike = 1.0) -> Plan:
    """The layout of these positions, coordinates with this standard deviation."""
    pair = photographed(overlap, positions, sigma)
    centre = vertical(pair.focal_left) if overlap.elements is None else overlap.elements
    residuals = coplanarity.residuals(pair, centre)
    return Plan(pair, read(residuals, None, jnp.asarray(0), jnp.asarray(True)), overlap)


def photographed(overlap: Overlap, positions: Positions, sigma: ArrayLike) -> Pair:
    """The errorless pair of these positions."""
    x, y = positions
    heights = (
        jax.vmap(overlap.terrain)(x, y)
        if callable(overlap.terrain)
        else overlap.terrain
    )
    layout = Layout(x / overlap.base, y, ())  # pyright: ignore[reportArgumentType]  (arrays, to be differentiated)
    pair = mock_pair(
        layout,
        overlap.elements,
        focal=overlap.focal,
        base=overlap.base,
        y_range=1.0,
        heights=jnp.asarray(heights),
    )
    return eqx.tree_at(
        lambda p: p.sigma, pair, jnp.broadcast_to(jnp.asarray(sigma, x.dtype), x.shape)
    )


class AbstractCriterion(eqx.Module):
    """What a layout should make small: the largest of some positive numbers, or else
    their root mean square."""

    largest: eqx.AbstractClassVar[bool]
    fewest: eqx.AbstractClassVar[int]

    @abc.abstractmethod
    def values(self, plan: Plan) -> Float[Array, "value"]:
        """The numbers."""

    def __call__(self, plan: Plan) -> Float[Array, ""]:
        values = self.values(plan)
        return (
            jnp.max(values)
            if self.largest
            else jnp.sqrt(total(values**2) / values.size)
        )

    def logarithm(self, plan: Plan, p: ArrayLike) -> Float[Array, ""]:
        """Logarithm of the criterion, or of the p-norm in place of the largest
        number."""
        return (
            logsumexp(p * jnp.log(self.values(plan))) / p
            if self.largest
            else jnp.log(self(plan))
        )


class Determinant(AbstractCriterion):
    """(det C)^(1/10), C = sigma² Q of the five elements: geometric mean of the standard
    deviations along the axes of their ellipsoid (D-optimal). Its best layout is the
    same in every system of elements."""

    largest: ClassVar[bool] = False
    fewest: ClassVar[int] = 5

    def values(self, plan):
        n = plan.adjustment.normal_matrix
        inverses, _ = normal.cholesky(
            [[n[i, j] for j in range(i + 1)] for i in range(5)]
        )
        return jnp.exp(sum(jnp.log(inverses[i][i]) for i in range(5)) / 5)[None]  # pyright: ignore


class Trace(AbstractCriterion):
    """sqrt(tr C / 5): root mean square of the standard deviations of the five elements
    (A-optimal). It mixes units where not all elements are angles."""

    largest: ClassVar[bool] = False
    fewest: ClassVar[int] = 5

    def values(self, plan):
        return jnp.sqrt(jnp.diagonal(plan.adjustment.cofactor))


class DetectableError(AbstractCriterion):
    """The largest minimal detectable error of the y coordinates; or of others, by their
    numbers among x_left, y_left, x_right, y_right."""

    largest: ClassVar[bool] = True
    fewest: ClassVar[int] = 6
    coordinates: tuple[int, ...] = (1, 3)
    delta0: ArrayLike = DELTA0

    def values(self, plan):
        errors = detectable_errors(plan.pair, plan.adjustment, self.delta0)
        return jnp.concatenate([errors[k] for k in self.coordinates])


class HeightDeviation(AbstractCriterion):
    """The largest standard deviation of a model height, of new points on a grid over
    the overlap, measured as well as the others; in the unit of the base. They lie on
    the terrain, or in the plane where the points keep heights.

    Z counts in the frame of the elements, which hangs on the left photo: mirrored from
    left to right a layout has other heights."""

    largest: ClassVar[bool] = True
    fewest: ClassVar[int] = 5
    grid: int = 5

    def values(self, plan):
        box = plan.overlap
        places = [
            jnp.linspace(*side, self.grid, dtype=plan.pair.x_left.dtype)
            for side in (box.x, box.y)
        ]
        x, y = (a.ravel() for a in jnp.meshgrid(*places, indexing="ij"))
        surface = box.terrain if callable(box.terrain) else 0.0
        box = Overlap(box.x, box.y, box.base, box.focal, surface, box.elements)
        return height_deviations(
            plan.adjustment, photographed(box, (x, y), plan.pair.sigma[0]), box.base
        )


def detectable_errors(
    pair: Pair, adjustment: Adjustment, delta0: ArrayLike = DELTA0
) -> list[Array]:
    """The minimal detectable error of each coordinate l of every point, x_left, y_left,
    x_right, y_right (Baarda 1968):

        delta0 sqrt(B Q Bᵀ) / (|dg/dl| sqrt(r)),

    r the redundancy number of its condition. Where nothing checks a coordinate it is no
    infinity but 1e8 delta0 sigma.
    """
    f = coplanarity.fundamental_matrix(
        *adjustment.parameters.relative(), pair.focal_left, pair.focal_right
    )

    def one(point, sigma, r):
        b = jax.grad(coplanarity.condition, argnums=1)(f, point)
        d = sum(e**2 for e in b)
        own = [r * e**2 / d for e in b]
        checked = lambda e: (
            (e > 1e-16) & (r < 1 + 1e-6)
        )  # beyond that nothing is determined at all
        return [delta0 * sigma / jnp.sqrt(jnp.where(checked(e), e, 1e-16)) for e in own]

    return jax.vmap(one)(pair.coordinates, pair.sigma, adjustment.redundancy)  # pyright: ignore[reportReturnType]


def height_deviations(
    adjustment: Adjustment, points: Pair, base: ArrayLike
) -> Float[Array, "point"]:
    """Standard deviations of Z of points, in the model frame of the elements, with this
    length of the base (that of `DependentElements` is their own).

    Z is that of the corrected coordinates l + v: s² = z_x Q z_xᵀ + sigma² |z_l|², z_x =
    dZ/dx, z_l = dZ/dl. There is no mixed term, for new points nor for those adjusted,
    because l + v is independent of the misclosure g.
    """
    found, q = adjustment.parameters, adjustment.cofactor
    focals = points.focal_left, points.focal_right
    length = (
        jnp.ones_like(q[0, 0])
        if isinstance(found, DependentElements)
        else jnp.asarray(base, q.dtype)
    )

    def height(step, point):
        moved = found.move(step)
        (rotation, along), frame = moved.relative(), moved.model_frame()
        f = coplanarity.fundamental_matrix(*moved.relative(), *focals)
        v = coplanarity.corrections(f, point, jnp.asarray(True))
        corrected = tuple(c + d for c, d in zip(point, v, strict=True))
        first, second = coplanarity.directions(
            frame, rot.product(frame, rotation), corrected, *focals
        )
        along = rot.scale(rot.apply(frame, along), length)
        lam, mu, near = coplanarity.depths(first, second, along)
        return coplanarity.halfway(first, second, along, lam * near, mu * near)[2]

    def one(point, sigma):
        by_step, by_point = jax.grad(height, argnums=(0, 1))(
            (jnp.zeros_like(q[0, 0]),) * 5, point
        )
        variance = sum(
            a * q[i, j] * b
            for i, a in enumerate(by_step)
            for j, b in enumerate(by_step)
        )
        return root(variance + sigma**2 * sum(e**2 for e in by_point))

    return jax.vmap(one)(points.coordinates, points.sigma)


class Design(NamedTuple):
    """The best layout found: positions and criterion; and of every start the criterion
    before and after, and whether its iteration converged. No start ends worse than it
    began."""

    x: Float[Array, "point"]
    y: Float[Array, "point"]
    value: Float[Array, ""]
    before: Float[Array, "start"]
    after: Float[Array, "start"]
    converged: Bool[Array, "start"]


def design(
    criterion: AbstractCriterion,
    overlap: Overlap,
    points: int,
    key: PRNGKeyArray,
    *,
    sigma: ArrayLike = 1.0,
    starts: int = 8,
    start: tuple[ArrayLike, ArrayLike] | None = None,
    kept: tuple[ArrayLike, ArrayLike] | None = None,
) -> Design:
    """The positions of some points that make the criterion smallest, with coordinates
    of standard deviation `sigma`.

    `starts`: number of random layouts to begin with; the least of a criterion has
    neighbours that are not quite as good. `start`: positions (x, y) to begin with
    before those. `kept`: positions of further points that stay where they are and come
    last in the result.
    """
    whole = points + (0 if kept is None else np.size(kept[0]))
    if whole < criterion.fewest:
        raise ValueError(
            f"design: {whole} points, where {criterion.fewest} are the fewest, with "
            "those kept"
        )
    for axis, side in (("x", overlap.x), ("y", overlap.y)):
        if not is_traced(side) and not 0 < np.ptp(np.asarray(side, float)) < np.inf:
            raise ValueError(
                f"design: the overlap has {axis} = {side}; it must be an interval"
            )
    number = lambda a: jnp.asarray(a, float) if isinstance(a, float | np.ndarray) else a
    arguments = {
        "criterion": criterion,
        "overlap": overlap,
        "sigma": sigma,
        "start": start,
        "kept": kept,
    }
    arguments = {name: jax.tree.map(number, a) for name, a in arguments.items()}
    options = arguments | {"points": points, "starts": starts}
    return (
        _design(key, **options)
        if is_traced((key, arguments))
        else Program(_design, options, COMPILE_FAST)(key)
    )


def _design(key, *, criterion, overlap, points, starts, sigma, start, kept) -> Design:
    sides = [
        (jnp.asarray(low, float), jnp.asarray(high, float))
        for low, high in (overlap.x, overlap.y)
    ]
    kept = () if kept is None else tuple(jnp.asarray(a, float) for a in kept)

    def plan(free: Positions) -> Plan:
        x, y = (
            (jnp.concatenate(both) for both in zip(free, kept, strict=True))
            if kept
            else free
        )
        return planned(overlap, (x, y), sigma)

    def places(u: tuple[Array, ...]) -> Positions:
        x, y = (
            (low + high) / 2 + (high - low) / 2 * jnp.sin(a)
            for (low, high), a in zip(sides, u, strict=True)
        )
        return x, y

    def improved(first: tuple[Array, ...]):
        def stage(u, p):
            found = optx.minimise(
                lambda u, p: criterion.logarithm(plan(places(u)), p),
                optx.BFGS(rtol=1e-8, atol=1e-8),
                u,
                args=p,
                max_steps=STEPS,
                throw=False,
            )
            return found.value, found.result == optx.RESULTS.successful

        inside = lambda a, side: jnp.clip(
            (2 * a - side[0] - side[1]) / (side[1] - side[0]), -0.99, 0.99
        )
        u = tuple(
            jnp.arcsin(inside(a, side)) for a, side in zip(first, sides, strict=True)
        )
        u, converged = lax.scan(
            stage, u, jnp.asarray(NORMS[: 2 if criterion.largest else 1])
        )
        before, after = (
            criterion(plan((first[0], first[1]))),
            criterion(plan(places(u))),
        )
        better = after < before
        end = jax.tree.map(lambda a, b: jnp.where(better, a, b), places(u), first)
        return end, before, jnp.where(better, after, before), converged[-1]

    draw = lambda key, side: jax.random.uniform(key, (starts, points), float, *side)
    first = tuple(
        draw(k, side) for k, side in zip(jax.random.split(key), sides, strict=True)
    )
    if start is not None:
        first = tuple(
            jnp.concatenate([jnp.asarray(a, float)[None], b])
            for a, b in zip(start, first, strict=True)
        )
    ends, before, after, converged = jax.vmap(improved)(first)
    best = jnp.argmin(after)
    x, y = (jnp.concatenate([a[best], *kept[i : i + 1]]) for i, a in enumerate(ends))
    return Design(x, y, after[best], before, after, converged)
