"""How the results of an orientation depend on its measurements: exact derivatives, and
the influence of each point on the elements.

A result is any function of the `Orientation` that returns a pytree of numbers:
`elements`, `heights`, `lambda o: o.sigma0`. Its derivatives are those of the finished
non-linear adjustment (implicit function theorem), with the second-order term of the
residuals. They are exact for residuals of any size; those of the normal equations
alone, -(AᵀPA)⁻¹AᵀP, are not. If an orientation is not usable they are zero, and
`usable` says so.

A length of the base that is not given is a choice, not a measurement, and has no
derivative. For heights in mm give `base`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from ..adjustment.propagation import jacobian
from ..geometry import rotations as rot
from ..geometry.elements import AbstractElements, DependentElements, RelativePose
from ..geometry.pairs import Pair
from ..orientation.orient import orient
from ..orientation.result import Orientation
from ..orientation.results import is_usable
from ..xla.passes import total
from ..xla.programs import compiled, is_traced

Quantity = Callable[[Orientation], PyTree]

NEEDED = 1e-3
"""Redundancy number below which the system without the point is (nearly) singular."""


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
        both = zip(centre.values(), other.values(), strict=True)
        return jnp.stack([b - a for a, b in both])
    return jnp.stack([*_turn(centre, other), *_shift(centre, other)])


def _turn(centre: RelativePose, other: RelativePose) -> list[Array]:
    """The rotation vector w of `RelativePose.moved`: conj(centre) other is proportional
    to (1, w / 2)."""
    w, x, y, z = centre.qw, -centre.qx, -centre.qy, -centre.qz
    a, b, c, d = other.qw, other.qx, other.qy, other.qz
    real = w * a - x * b - y * c - z * d
    imaginary = (
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    return [2 * i / real for i in imaginary]


def _shift(centre: RelativePose, other: RelativePose) -> list[Array]:
    """The two numbers by which `RelativePose.moved` shifts the base, through the
    inverse of its stereographic projection."""
    base, new = (centre.bx, centre.by, centre.bz), (other.bx, other.by, other.bz)
    along = 2 / (1 + rot.dot(base, new))
    return [along * rot.dot(tangent, new) for tangent in rot.tangents(base)]


class Derivatives(NamedTuple):
    """A quantity, its `value`, and its derivatives by everything that was measured.

    Each is shaped like the quantity; derivatives by coordinates have the points on a
    further last axis (zero where masked). `principal_left`, `principal_right`: by x0
    and y0 of the principal point in the axes and unit of the photo. The coordinates are
    measured from it, so that each of these is minus the sum of the derivatives by the
    coordinates.
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

    Their unit is the unit of the quantity over the unit of the coordinates. A focal
    length that both photos share has the sum of both derivatives. `options` are those
    of `orient`. Works under jit and vmap.
    """
    return run(_derivatives, pair, options, {"quantity": quantity})


def _derivatives(pair: Pair, *, quantity: Quantity, **options) -> Derivatives:
    def result(inputs):
        *coordinates, left, right = inputs
        measured = Pair(*coordinates, pair.sigma, pair.mask, left, right, pair.roots)
        found = orient(measured, **options)
        value = quantity(found)
        return value, (value, found.usable)

    inputs = (*pair.coordinates, pair.focal_left, pair.focal_right)
    by, (value, usable) = jacobian(result, inputs, has_aux=True)
    by = jax.tree.map(lambda d: jnp.where(usable, d, 0.0), by)
    by = jax.tree.transpose(jax.tree.structure(value), jax.tree.structure(inputs), by)
    x_left, y_left, x_right, y_right, focal_left, focal_right = by
    shift = lambda by: jax.tree.map(lambda d: -total(d), by)
    return Derivatives(
        value=value,
        usable=usable,
        x_left=x_left,
        y_left=y_left,
        x_right=x_right,
        y_right=y_right,
        focal_left=focal_left,
        focal_right=focal_right,
        principal_left=(shift(x_left), shift(y_left)),
        principal_right=(shift(x_right), shift(y_right)),
    )


def run(
    function: Callable, pair: Pair, options: dict[str, Any], more: dict[str, Any]
) -> Any:
    """function(pair, **options, **more), compiled where nothing is traced.

    `options` are those of `orient`. Without a `start` the solution itself becomes the
    start: programs with derivatives then do not contain the search for one.
    """
    if options.get("base") is not None:
        options = options | {"base": jnp.asarray(options["base"], float)}
    if is_traced((pair, options, more)):
        return function(pair, **options, **more)
    if "start" not in options:
        found = orient(pair, **options)
        options = options | {"start": found.pose}
        if "max_steps" in options and not bool(found.usable):
            # further steps from there might make a failed solution a good one
            options["max_steps"] = 0
    return compiled(function)(pair, **options, **more)


class PointInfluence(NamedTuple):
    """How much the five (local) elements move when a point is left out.

    `influence`: to first order in its weight p, -dx/dp. `predicted`: influence / r, r
    its redundancy number: the closed form, exact for a linear adjustment.
    `leave_one_out`: by a new adjustment without the point. They differ where a point
    has much leverage, or its residual is so large that the adjustment is not linear. If
    a point is not `testable` (masked, r below `NEEDED`, or no usable orientation
    without it) all are zero.
    """

    influence: Float[Array, "point 5"]
    predicted: Float[Array, "point 5"]
    leave_one_out: Float[Array, "point 5"]
    testable: Bool[Array, "point"]


def point_influence(pair: Pair, **options) -> PointInfluence:
    """The influence of each point on the elements of orient(pair, **options). Works
    under jit and vmap."""
    return run(_point_influence, pair, options, {})


def _point_influence(pair: Pair, **options) -> PointInfluence:
    def of_sigma(sigma):
        found = orient(eqx.tree_at(lambda p: p.sigma, pair, sigma), **options)
        return elements(found), found

    # sigma / sqrt(p) at p = 1: dx/dp = -sigma/2 dx/dsigma
    by_sigma, found = jacobian(of_sigma, pair.sigma, has_aux=True)
    own = jnp.where(pair.mask, pair.sigma, 0.0)
    influence = 0.5 * own[:, None] * by_sigma.T

    refit = options | {"start": found.pose}
    if isinstance(found.elements, DependentElements):
        # without the point the mean x-parallax would be another one
        refit["base"] = found.elements.bx

    def without(omitted):
        again = orient(pair.with_mask(pair.mask & ~omitted), **refit)
        return displacement(found.elements, again.elements), is_usable(again.result)

    shift, usable = jax.vmap(without)(jnp.eye(pair.mask.shape[0], dtype=bool))
    testable = pair.mask & (found.redundancy > NEEDED) & usable & found.usable
    predicted = influence / jnp.where(testable, found.redundancy, 1.0)[:, None]
    keep = lambda moved: jnp.where(testable[:, None], moved, 0.0)
    return PointInfluence(
        influence=keep(influence),
        predicted=keep(predicted),
        leave_one_out=keep(shift),
        testable=testable,
    )
