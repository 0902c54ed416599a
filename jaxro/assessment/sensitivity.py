"""What the results of an orientation owe to its measurements: exact derivatives, and
what each point does to the elements.

A result is a quantity(Orientation), any pytree of numbers: `elements`, `heights`,
`lambda o: o.sigma0`. Its derivatives are those of the finished non-linear adjustment
(implicit function theorem), the second-order term of the residuals included: they are
exact at any size of the residuals, where those of the normal equations alone,
-(AᵀPA)⁻¹AᵀP, are not. Where an orientation is not usable they are zero, and `usable`
says so.

A length of the base that is not given is a choice, not a measurement: it has no
derivative. For heights in mm give `base`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from ..geometry import rotations as rot
from ..geometry.elements import AbstractElements, DependentElements, RelativePose
from ..geometry.pairs import Pair
from ..orientation.orient import orient
from ..orientation.result import Orientation
from ..orientation.results import is_usable
from ..xla.passes import total
from ..xla.programs import Program, is_traced
from ..xla.settings import COMPILE_FAST
from .propagation import jacobian

Quantity = Callable[[Orientation], PyTree]

UNTESTABLE = 1e-3
"""Redundancy number below which the omission of a point leaves a (nearly) singular
system."""


def heights(orientation: Orientation) -> Float[Array, "point"]:
    """Z of the model points, in the frame and scale of the elements."""
    return orientation.model[2]


def elements(orientation: Orientation) -> Float[Array, "5"]:
    """The five elements in the order of their names. Those of `RelativePose` are
    displacements from itself: zero, with the derivatives of its local parameters."""
    found = orientation.elements
    if isinstance(found, RelativePose):
        return displacement(lax.stop_gradient(found), found)
    return jnp.stack(found.values())


def displacement(
    centre: AbstractElements, other: AbstractElements
) -> Float[Array, "5"]:
    """The five local parameters that move `centre` to `other`, elements of the same
    system."""
    if not (isinstance(centre, RelativePose) and isinstance(other, RelativePose)):
        return jnp.stack(
            [b - a for a, b in zip(centre.values(), other.values(), strict=True)]
        )
    # the inverse of RelativePose.moved: conj(centre) other is proportional to (1, w/2),
    # the base goes back through the stereographic projection
    w, x, y, z = centre.qw, -centre.qx, -centre.qy, -centre.qz
    a, b, c, d = other.qw, other.qx, other.qy, other.qz
    real = w * a - x * b - y * c - z * d
    imaginary = (
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    base, new = (centre.bx, centre.by, centre.bz), (other.bx, other.by, other.bz)
    along = 2 / (1 + rot.dot(base, new))
    return jnp.stack(
        [
            *(2 * i / real for i in imaginary),
            *(along * rot.dot(t, new) for t in rot.tangents(base)),
        ]
    )


class Derivatives(NamedTuple):
    """A quantity and its derivatives by everything that was measured; each is shaped
    like the quantity, those by coordinates with the points on a further last axis (zero
    where masked).

    `principal_left`, `principal_right`: by x0 and y0 of the principal point in the axes
    and unit of the photo; the coordinates are measured from it, so that each is minus
    the sum of those by the coordinates.
    """

    value: PyTree
    usable: Bool[Array, ""]
    x_left: PyTree
    y_left: PyTree
    x_right: PyTree
    y_right: PyTree
    focal_left: PyTree
    focal_right: PyTree
    principal_left: tuple[PyTree, PyTree]
    principal_right: tuple[PyTree, PyTree]


def derivatives(pair: Pair, quantity: Quantity, **options) -> Derivatives:
    """Exact derivatives of quantity(orient(pair, **options)) by coordinates, focal
    lengths and principal points.

    One value is its own unit over that of the coordinates. A focal length that both
    photos share has the sum of both derivatives. Works under jit and vmap.
    """
    return run(_derivatives, pair, options, {"quantity": quantity})


def _derivatives(pair: Pair, *, quantity: Quantity, **options) -> Derivatives:
    def of(inputs):
        *coordinates, left, right = inputs
        found = orient(
            Pair(*coordinates, pair.sigma, pair.mask, left, right), **options
        )
        value = quantity(found)
        return value, (value, found.usable)

    inputs = (*pair.coordinates, pair.focal_left, pair.focal_right)
    by, (value, usable) = jacobian(of, inputs, has_aux=True)
    by = jax.tree.map(lambda d: jnp.where(usable, d, 0.0), by)
    by = jax.tree.transpose(jax.tree.structure(value), jax.tree.structure(inputs), by)
    shifts = [jax.tree.map(lambda d: -total(d), d) for d in by[:4]]
    return Derivatives(
        value, usable, *by, (shifts[0], shifts[1]), (shifts[2], shifts[3])
    )


def run(
    function: Callable, pair: Pair, options: dict[str, Any], more: dict[str, Any]
) -> Any:
    """function(pair, **options, **more), compiled where nothing is traced, and begun at
    the solution if no start is given, so that the general start is in no program with
    derivatives."""
    if options.get("base") is not None:
        options = options | {"base": jnp.asarray(options["base"], float)}
    if is_traced((pair, options, more)):
        return function(pair, **options, **more)
    if "start" not in options:
        found = orient(pair, **options)
        options = options | {"start": found.pose}
        if "max_steps" in options and not bool(found.usable):
            options["max_steps"] = 0  # as many again might find what so many did not
    return Program(function, options | more, COMPILE_FAST)(pair)


class PointInfluence(NamedTuple):
    """How each point displaces the five (local) elements: by how much they move when it
    is left out.

    `influence`: to first order in its weight, -dx/dp. `predicted`: influence / r, r its
    redundancy number: the closed form, exact for a linear adjustment. `leave_one_out`:
    the refit. They differ where a point has much leverage, or its residual is so large
    that the adjustment is not linear. Where not `testable` (masked, r below
    `UNTESTABLE`, or no usable orientation without it) all are zero.
    """

    influence: Float[Array, "point 5"]
    predicted: Float[Array, "point 5"]
    leave_one_out: Float[Array, "point 5"]
    testable: Bool[Array, "point"]


def point_influence(pair: Pair, **options) -> PointInfluence:
    """What each point does to the elements of orient(pair, **options). Works under jit
    and vmap."""
    return run(_point_influence, pair, options, {})


def _point_influence(pair: Pair, **options) -> PointInfluence:
    def weighted(sigma):
        found = orient(eqx.tree_at(lambda p: p.sigma, pair, sigma), **options)
        return elements(found), found

    # sigma / sqrt(p) at p = 1: dx/dp = -sigma/2 dx/dsigma
    by_sigma, found = jacobian(weighted, pair.sigma, has_aux=True)
    own = jnp.where(pair.mask, pair.sigma, 0.0)
    influence = 0.5 * own[:, None] * by_sigma.T

    refit = options | {"start": found.pose}
    if isinstance(found.elements, DependentElements):
        refit["base"] = (
            found.elements.bx
        )  # the mean x-parallax would be another one without the point

    def without(omitted):
        again = orient(pair.with_mask(pair.mask & ~omitted), **refit)
        return displacement(found.elements, again.elements), is_usable(again.result)

    shift, usable = jax.vmap(without)(jnp.eye(pair.mask.shape[0], dtype=bool))
    testable = pair.mask & (found.redundancy > UNTESTABLE) & usable & found.usable
    predicted = influence / jnp.where(testable, found.redundancy, 1.0)[:, None]
    return PointInfluence(
        *(jnp.where(testable[:, None], d, 0.0) for d in (influence, predicted, shift)),
        testable=testable,
    )
