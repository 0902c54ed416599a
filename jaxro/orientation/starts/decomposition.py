"""From an essential matrix to the orientation it stands for (Horn 1990, Recovering
baseline and orientation from E).

Here p1ᵀ E p2 = b . (p1 x R p2), that is E = -[b]x R, so that (Horn's equations with the
sign of this convention)

    b bᵀ = tr(E Eᵀ)/2 I - E Eᵀ,    (b . b) R = cof(E) + [b]x E    and, for -b,    cof(E) - [b]x E.

Two rotations and two signs of the base satisfy the same condition; the right one has
the points in front of both photos. A measured E has not quite two equal singular values
and a zero: the base is then its left singular vector and the rotations are the nearest
orthogonal matrices, the same as from a singular value decomposition.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ...geometry import rotations as rot
from ...geometry.elements import RelativePose
from .problems_last import cross, problems_last

TINY = 1e-300
SQUARINGS = 4
POLAR_STEPS = 8

Square = Float[Array, "3 3 problem"]
Three = Float[Array, "3 problem"]
Images = Float[Array, "point 3"]


def decompose(
    essential: Float[Array, "3 3"],
) -> tuple[Float[Array, "2 3 3"], Float[Array, "3"]]:
    """The two rotations (right-photo vectors into the left frame) and the unit base, of
    unknown sign."""
    return _decompose_one(essential)


def best_pose(
    essential: Float[Array, "3 3"],
    left: Images,
    right: Images,
    mask: Bool[Array, "point"],
) -> tuple[RelativePose, Int[Array, ""]]:
    """Of the four orientations of E the one with most points in front of both photos,
    and their number."""
    rotation, base, most = _best_pose_one(essential, left, right, mask)
    return RelativePose(
        *rot.to_quaternion(rot.as_matrix(rotation)), base[0], base[1], base[2]
    ), most


def _decompose(essential: Square) -> tuple[Float[Array, "2 3 3 problem"], Three]:
    e = _scaled(essential, 2.0)
    # cof(E) is b times a row, plus little where E is measured; squaring leaves the
    # singular vector of the base alone
    c = cofactors(e)
    m = jnp.sum(c[:, None] * c[None], axis=2)
    m = lax.fori_loop(
        0,
        SQUARINGS,
        lambda _, m: _scaled(jnp.sum(m[:, None] * m[None], axis=2), 1.0),
        m,
    )
    length = jnp.sum(m * m, axis=1)
    first = (length[:1] >= length[1:2]) & (length[:1] >= length[2:])
    base = jnp.where(first, m[0], jnp.where(length[1:2] >= length[2:], m[1], m[2]))
    base = base / jnp.sqrt(
        jnp.maximum(jnp.sum(base * base, axis=0, keepdims=True), TINY)
    )
    # of cof(E) only the part along the base belongs to a matrix of rank two
    along = base[:, None] * jnp.sum(base[:, None] * c, axis=0)[None]
    turned = cross(base[:, None], e)
    both = jnp.stack([along + turned, along - turned], axis=2)
    return jnp.moveaxis(lax.fori_loop(0, POLAR_STEPS, _polar_step, both), 2, 0), base


def _best_pose(
    essential: Square, left, right, mask
) -> tuple[Square, Three, Int[Array, "problem"]]:
    rotations, base = _decompose(essential)
    (positive, negative), (others, opposite) = (
        _in_front(r, base, left, right, mask) for r in (rotations[0], rotations[1])
    )
    second = jnp.maximum(others, opposite) > jnp.maximum(positive, negative)
    rotation = jnp.where(second[None, None], rotations[1], rotations[0])
    base = (
        base
        * jnp.where(
            jnp.where(second, opposite > others, negative > positive), -1.0, 1.0
        )[None]
    )
    most = jnp.maximum(jnp.maximum(positive, negative), jnp.maximum(others, opposite))
    return rotation, base, most


def _in_front(rotation: Square, base: Three, left, right, mask):
    """Number of points in front of both photos with base b, and with base -b (which
    turns both signs)."""
    p1, b = jnp.moveaxis(left, 1, 0), base[:, None]
    p2 = jnp.sum(rotation[:, :, None] * jnp.moveaxis(right, 1, 0)[None], axis=1)
    # λ and μ times |p1 x R p2|²
    normal = cross(p1, p2)
    first, second = (
        jnp.sum(cross(b, p2) * normal, axis=0),
        jnp.sum(cross(b, p1) * normal, axis=0),
    )
    ahead, behind = (first > 0) & (second > 0), (first < 0) & (second < 0)
    return jnp.sum(mask & ahead, axis=0), jnp.sum(mask & behind, axis=0)


def _polar_step(_, m: Float[Array, "3 3 2 problem"]) -> Float[Array, "3 3 2 problem"]:
    """Newton's iteration for the orthogonal polar factor: M <- (M + M⁻ᵀ)/2, M⁻ᵀ =
    cof(M)/det(M)."""
    c = cofactors(m)
    determinant = jnp.sum(m[0] * c[0], axis=0)
    return (m + c / jnp.maximum(determinant, 1e-30)[None, None]) / 2


def cofactors(m: Float[Array, "3 3 ..."]) -> Float[Array, "3 3 ..."]:
    """cof(M): its rows are the cross products of the rows of M."""
    columns = jnp.swapaxes(m, 0, 1)
    after, before = (
        jnp.concatenate([columns[:, 1:], columns[:, :1]], 1),
        jnp.concatenate([columns[:, 2:], columns[:, :2]], 1),
    )
    return jnp.swapaxes(cross(after, before), 0, 1)


def _scaled(m: Square, squares: ScalarLike) -> Square:
    """M times the factor that makes the sum of its squares the given one."""
    return m * jnp.sqrt(
        squares / jnp.maximum(jnp.sum(m * m, axis=(0, 1), keepdims=True), TINY)
    )


_decompose_one, _best_pose_one = (problems_last(f) for f in (_decompose, _best_pose))
