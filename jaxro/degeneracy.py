"""How near a layout of points is to one that does not determine the orientation, in units of its measuring errors.

Measuring errors hide that elements are undetermined: points that lie on a line but for their errors give a regular
normal matrix. Whether it means anything is a question of scale, and the scale is sigma0.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from . import coplanarity, rotations as rot
from .elements import AbstractElements
from .inspection import Inspection
from .pairs import Pair
from .programs import stage
from .reductions import sums

ROUNDING = 1e-9
"""Angle (rad) between two rays that a computer cannot tell from zero."""

POWERS = 4
"""Of the cofactor matrix: enough to separate its largest eigenvalue where that matters."""


def in_radians(elements: AbstractElements, cofactor: Float[Array, "5 5"]) -> tuple[Float[Array, "5 5"], list]:
    """The cofactors with components of the base over its length, and what each element was divided by."""
    if all(elements.angles):
        return cofactor, [1.0] * len(elements.angles)
    _, base = elements.relative()
    length = jnp.sqrt(rot.dot(base, base))
    units = [jnp.ones_like(length) if angle else length for angle in elements.angles]
    scale = jnp.stack(units)
    return cofactor / (scale[:, None] * scale[None, :]), units


def margin(pair: Pair, elements: AbstractElements, cofactor: Float[Array, "5 5"]) -> Float[Array, ""]:
    """The least change of the coordinates (root mean square over the points, in units of sigma) that leaves one
    combination of the elements undetermined, to first order.

    Along the worst determined direction e of the elements g of a point changes by g'. With n points the normal matrix
    has eᵀ N e = Σ (g'/ (sigma |∇g|))², and each coordinate moves g' by ∇g', so that errors of size m alone produce
    m² Σ (|∇g'| / |∇g|)²: the two are equal at m = margin.
    """
    cofactor, units = in_radians(elements, cofactor)
    direction = stage(_worst)(cofactor)
    direction = [e * unit for e, unit in zip(direction, units, strict=True)]

    def fundamental(t):
        moved = elements.moved(tuple(t * e for e in direction))
        return coplanarity.fundamental_matrix(*moved.relative(), pair.focal_left, pair.focal_right)

    zero = jnp.zeros_like(pair.focal_left)
    f, slope = jax.jvp(fundamental, (zero,), (jnp.ones_like(zero),))

    def one(point, sigma, use):
        _, square, _ = coplanarity.linearised(f, point, use)
        g, moved, _ = coplanarity.linearised(slope, point, use)
        weight = jnp.where(use, 1 / (square * sigma**2), 0.0)
        return g**2 * weight, moved * sigma**2 * weight

    change, drift = sums(jax.vmap(one)(pair.coordinates, pair.sigma, pair.mask))
    ratio = change / jnp.where(drift > 0, drift, 1.0)
    return jnp.where(drift > 0, jnp.sqrt(jnp.where(ratio > 0, ratio, 0.0)), jnp.inf)


def _worst(cofactor: Float[Array, "p p"]) -> list:
    """The eigenvector of the largest eigenvalue of a cofactor matrix, of any length: powers on a column."""
    n = range(len(cofactor))
    q = [[cofactor[i, k] for k in n] for i in n]
    trace = sum(q[i][i] for i in n)
    q = [[entry / trace for entry in row] for row in q]
    column, most = q[0], q[0][0]
    for k in n[1:]:
        longer = q[k][k] > most
        column = [jnp.where(longer, a, b) for a, b in zip(q[k], column, strict=True)]
        most = jnp.where(longer, q[k][k], most)
    for _ in range(POWERS):
        column = [sum(q[i][k] * column[k] for k in n) for i in n]
    return column


def required(freedom: Float[Array, ""]) -> Float[Array, ""]:
    """Multiple of sigma0 below which a `margin` is not told from measuring errors: 4, and more where sigma0 itself is
    uncertain, having few degrees of freedom (64 with one)."""
    return 4 + 60 / jnp.maximum(freedom, 1.0)


def significant(freedom: Float[Array, ""]) -> Float[Array, ""]:
    """Multiple of sigma0 below which parallaxes are explained by a rotation alone: 4, and more where sigma0 itself is
    uncertain."""
    return 4 + 12 / jnp.maximum(freedom, 1.0)


def pure_rotation(inspected: Inspection, freedom: Float[Array, ""], noise: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether the directions p1 and R p2 agree to within the measuring error: no parallax, hence no base."""
    return (inspected.parallax < significant(freedom) * noise) | (inspected.angle < ROUNDING)
