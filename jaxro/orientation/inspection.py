"""What one pass over the points tells of a pose.

On which side of the photos the points lie, how far they are from the condition, and how
far apart their rays are. Computing the first two separately took a quarter of the time
of a pose of many points. The compiler leaves out sums that nobody asks for.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..xla.passes import sums

ONE_SIDE = 0.5
"""Mean sign of points of which a quarter lies on the other side."""


class Inspection(NamedTuple):
    """`in_front`: Σ of the signs of both depths, negative where the base points to
    the wrong side. `behind`: the share of the points that lie behind a photo.
    `distance`: root mean square distance of the points from the condition, to first
    order, over the left focal length. `spread`: that of the left points from the
    principal point, over the same. `angle`: root mean square sine of the angle
    between p1 and R p2, that is without a base; `parallax`: the same in units of
    the standard deviation of a coordinate seen from the photos, sigma / f. `sigma`:
    root mean square of the sigmas. `twin`: whether enough of the points lie on one
    side of what would be the left photo of the second orientation, were they in a
    plane (`planes`): the sign of w · p1 = 1/(2λ) - b · p1 says it of one point."""

    in_front: Float[Array, ""]
    behind: Float[Array, ""]
    distance: Float[Array, ""]
    spread: Float[Array, ""]
    angle: Float[Array, ""]
    parallax: Float[Array, ""]
    sigma: Float[Array, ""]
    twin: Bool[Array, ""]


def inspect(pair: Pair, pose: RelativePose) -> Inspection:
    """`Inspection` of a pair (finite coordinates, masked points zero) at a pose."""
    rotation, base = pose.relative()
    focals = pair.focal_left, pair.focal_right
    f = coplanarity.fundamental_matrix(rotation, base, *focals)
    seen = coplanarity.common_focal(*focals)

    def of_point(point, sigma, use):
        first, second, w2, *depths = coplanarity.rays(
            None, rotation, base, point, *focals
        )
        left, right = (jnp.where(depth > 0, 1.0, -1.0) for depth in depths)
        g, square, _ = coplanarity.linearise(f, point, use)
        length = rot.dot(first, first)
        # XLA gives a quotient that is used twice a loop of its own, but not a selection
        # of it
        ratio = jnp.where(use, w2 / (length * rot.dot(second, second) * sigma**2), 0.0)
        # λ = depths[0] / w2; all over f1, which has no sign
        twin_side = w2 - 2 * depths[0] * rot.dot(base, first)
        terms = (
            jnp.ones_like(g),
            left + right,
            jnp.where(left + right > 1, 0.0, 1.0),
            jnp.where(twin_side > 0, left, -left),
            g * g / square,
            length - pair.focal_left**2,
            ratio * sigma**2,
            ratio * seen**2,
            sigma**2,
        )
        return tuple(jnp.where(use, term, 0.0) for term in terms)

    of_points = jax.vmap(of_point)(pair.coordinates, pair.sigma, pair.mask)
    number, in_front, behind, twin, *squares = sums(of_points)
    some = jnp.maximum(number, 1.0)
    mean = lambda square: jnp.sqrt(jnp.maximum(square, 0.0) / some)
    distance, spread, angle, parallax, sigma = map(mean, squares)
    return Inspection(
        in_front=in_front,
        behind=behind / some,
        distance=distance / pair.focal_left,
        spread=spread / pair.focal_left,
        angle=angle,
        parallax=parallax,
        sigma=sigma,
        twin=jnp.abs(twin) >= ONE_SIDE * number,
    )
