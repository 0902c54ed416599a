"""Photos that only turn: the rotation by itself, with its deviations.

Where the base is zero, or every point far away, p1 and R p2 are parallel. With d = Rᵀ p1
these are two conditions for each point, free of quotients:

    x2 dz + f2 dx = 0,    y2 dz + f2 dy = 0

All four coordinates are measured with errors.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..adjustment import adjust
from ..adjustment.guarded import root, times
from ..adjustment.terms import Term
from ..geometry import rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair, double, mask_unusable, pad, quickly, room_for
from ..xla.programs import compiled
from .starts.general import rotation_only, vectors

ANGLES = ("omega", "phi", "kappa")
"""Names of the angles of a rotation."""


class PureRotation(eqx.Module):
    """R of the right photo in the frame of the left one, without a base.

    `cofactor`: of small turns about the x, y and z axis of the left photo, in rad².
    `sigma0`: NaN without redundancy.
    """

    rotation: Float[Array, "3 3"]
    cofactor: Float[Array, "3 3"]
    sigma0: Float[Array, ""]
    degrees_of_freedom: Int[Array, ""]

    @property
    def angles(self) -> Float[Array, "3"]:
        """omega, phi, kappa of the right photo (rad), as of `DependentElements`."""
        to_photo = rot.transpose(rot.as_matrix(self.rotation))
        return jnp.stack(rot.omega_phi_kappa(to_photo))

    @property
    def deviations(self) -> Float[Array, "3"]:
        """Standard deviations of the turns about the three axes (rad)."""
        return times(root(jnp.diagonal(self.cofactor)), self.sigma0)


def orient_rotation(pair: Pair) -> PureRotation:
    """The rotation that explains a pair whose base is zero, by least squares.

    Two points are needed. Whether there is a base is not asked: see the result
    `zero_base` of `orient` and of procedures that reject points.
    """
    pair = double(pair)
    return _orient(pad(pair, room_for(pair.x_left.size)))


@compiled(settings=quickly, unit="points")
def _orient(pair: Pair) -> PureRotation:
    """The rotation of one pair, as a program."""
    pair, _ = mask_unusable(pair)
    start, _ = rotation_only(*vectors(pair), pair.mask)
    matrix = rot.as_array(start.relative()[0])
    focals = pair.focal_left, pair.focal_right

    def turned(step: tuple, first: Float[Array, "3 3"]) -> rot.Matrix:
        none = jnp.zeros_like(step[0])
        small = RelativePose(none + 1, none, none, none, none + 1, none, none)
        moved = small.move((*step, none, none)).normalise().relative()[0]
        return rot.product(moved, rot.as_matrix(first))

    def condition(step, given):
        (x1, y1, x2, y2), first, (f1, f2) = given
        dx, dy, dz = rot.apply(rot.transpose(turned(step, first)), (x1, y1, -f1))
        return jnp.stack([x2 * dz + f2 * dx, y2 * dz + f2 * dy])

    each = lambda a: jnp.broadcast_to(a, (pair.x_left.size, *jnp.shape(a)))
    given = pair.coordinates, each(matrix), tuple(map(each, focals))
    term = Term(condition, given, (pair.sigma**2, None, None), mask=pair.mask)
    zero = jnp.zeros_like(pair.focal_left)
    found = adjust(term, (zero, zero, zero))
    freedom = found.degrees_of_freedom
    return PureRotation(
        rotation=rot.as_array(turned(found.parameters, matrix)),
        cofactor=found.cofactor,
        sigma0=jnp.where(freedom > 0, found.sigma0, jnp.nan),
        degrees_of_freedom=freedom,
    )
