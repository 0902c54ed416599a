"""Approximate stations and focal lengths, without any knowledge of the user.

Objects that are not plane: the direct linear transformation (Abdel-Aziz and Karara
1971). Plane objects: the homography between plane and image, the principal place in the
middle of the measured area, and the focal length from the two conditions that the
plane's axes are at right angles and of the same length (Zhang 2000); where these do not
tell it, a ladder of focal lengths. All candidates are tried, for both handednesses if
it is not known.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..adjustment import symmetric
from ..adjustment.guarded import root
from ..camera.condition import Station
from ..geometry import rotations as rot
from .images import Places, Points, about_centroid

Mask = Bool[Array, " point"]
Vector = Float[Array, "3"]
Matrix = Float[Array, "3 3"]

LADDER = (1.2, 2.0, 3.2, 5.0, 8.0)
"""Focal lengths in half widths of the measured area, for plane objects."""

NEARLY_FLAT = 0.02
"""Thickness over extent below which an object is nearly a plane."""

SQUARINGS = 6
"""How often the inverse of a matrix is squared until it is that of its smallest
eigenvalue alone."""


class Start(eqx.Module):
    """Approximate values in the units of the frame; `handedness` as in `images`."""

    station: Station
    focal: Float[Array, "*candidate"]
    principal: Float[Array, "*candidate 2"]
    handedness: Float[Array, "*candidate"]


def candidates(
    u: Places, points: Points, mask: Mask, handedness: Float[Array, ""]
) -> Start:
    """All starts worth trying, of places with the axes as they were measured."""

    def of_sign(sign: Float[Array, ""]) -> Start:
        turned = u * jnp.stack([jnp.ones_like(sign), sign])[None]
        both = (
            _of_any(turned, points, mask, sign),
            _of_plane(turned, points, mask, sign),
        )
        return jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), *both)

    signs = jnp.where(handedness == 0, jnp.array([1.0, -1.0]), handedness)
    found = jax.vmap(of_sign)(signs)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), found)


def _of_any(u: Places, points: Points, mask: Mask, sign) -> Start:
    """By the direct linear transformation."""
    m, last = _projection(u, points, mask)
    length = lambda a: jnp.sqrt(jnp.maximum(jnp.sum(a**2), 1e-100))
    unit = length(m[2])
    m, last = m / unit, last / unit
    centre = jnp.stack([m[0] @ m[2], m[1] @ m[2]])
    fx, fy = length(jnp.cross(m[0], m[2])), length(jnp.cross(m[1], m[2]))
    turn = _rotation((m[0] - centre[0] * m[2]) / fx, (m[1] - centre[1] * m[2]) / fy)
    cofactors = jnp.stack(
        [jnp.cross(m[1], m[2]), jnp.cross(m[2], m[0]), jnp.cross(m[0], m[1])]
    )
    volume = m[0] @ cofactors[0]
    stood = -(last @ cofactors) / jnp.where(volume == 0, 1.0, volume)
    return Start(Station(_quaternion(turn), stood), (fx + fy) / 2, centre, sign)


def _of_plane(u: Places, points: Points, mask: Mask, sign) -> Start:
    """By the homography, for several focal lengths."""
    plane = homography(u, points, mask)
    told, square = right_angled(plane.h)
    focal = focal_of(told, square)
    ladder = jnp.concatenate([focal[None], jnp.array(LADDER)])
    station = jax.vmap(plane.station)(ladder)
    zero = jnp.zeros((len(ladder), 2))
    return Start(station, ladder, zero, jnp.broadcast_to(sign, ladder.shape))


def thickness(points: Points, mask: Mask) -> Float[Array, ""]:
    """The root mean square distance of points from the plane nearest to them, over that
    from their centroid."""
    _, apart = about_centroid(points, mask)
    moments = apart.T @ apart
    across = jnp.sum((apart @ plane_axes(moments)[2]) ** 2)
    extent = jnp.trace(moments)
    return root(across / jnp.where(extent > 0, extent, 1.0))


class Homography(eqx.Module):
    """The images of points in the plane nearest to them: u ~ H (ξ, η, 1) with ξ, η along
    the first two `axes` from `middle`."""

    h: Matrix
    axes: Matrix
    middle: Vector

    def station(self, focal: Float[Array, ""]) -> Station:
        """The station with this focal length, the principal place at zero."""
        k = self.h / jnp.stack([focal, focal, jnp.ones_like(focal)])[:, None]
        lengths = jnp.sqrt(jnp.maximum(jnp.sum(k[:, :2] ** 2, axis=0), 1e-100))
        first, second = (k[:, :2] / lengths[None]).T
        of_object = _rotation(first, second).T @ self.axes
        shift = k[:, 2] / jnp.sqrt(lengths[0] * lengths[1])
        return Station(_quaternion(of_object), self.middle - of_object.T @ shift)


def homography(u: Places, points: Points, mask: Mask) -> Homography:
    """The `Homography` of the points in use."""
    middle, apart = about_centroid(points, mask)
    axes = plane_axes(apart.T @ apart)
    inside = apart @ axes.T
    m, last = _projection(u, inside[:, :2], mask)
    return Homography(jnp.concatenate([m, last[:, None]], axis=1), axes, middle)


def plane_axes(moments: Matrix) -> Matrix:
    """Two axes in the plane of points and its normal, from their second moments about
    their centroid."""
    normal = least_vector(moments)
    first, second = rot.tangents((normal[0], normal[1], normal[2]))
    return jnp.stack([jnp.stack(first), jnp.stack(second), normal])


def _projection(
    u: Places, points: Float[Array, "point d"], mask: Mask
) -> tuple[Float[Array, "3 d"], Float[Array, "3"]]:
    """M and m with u ~ M X + m, up to a factor that makes most depths positive."""
    d = points.shape[1]
    one = jnp.concatenate([points, jnp.ones_like(points[:, :1])], axis=1)
    one = jnp.where(mask[:, None], one, 0.0)
    zero = jnp.zeros_like(one)
    of_x = jnp.concatenate([one, zero, -u[:, :1] * one], axis=1)
    of_y = jnp.concatenate([zero, one, -u[:, 1:] * one], axis=1)
    normal = of_x.T @ of_x + of_y.T @ of_y
    m = least_vector(normal).reshape(3, d + 1)
    depth = jnp.sum(one @ m[2])
    m = jnp.where(depth < 0, -m, m)
    return m[:, :d], m[:, d]


def least_vector(matrix: Float[Array, "n n"]) -> Float[Array, " n"]:
    """The unit eigenvector of the smallest eigenvalue of a positive matrix."""
    size = jnp.maximum(jnp.trace(matrix), 1e-100)
    least = jnp.finfo(matrix.dtype).eps * jnp.eye(len(matrix), dtype=matrix.dtype)
    power = symmetric.inverse(matrix / size + least).matrix
    for _ in range(SQUARINGS):
        power = power / jnp.trace(power)
        power = power @ power
    column = power[:, jnp.argmax(jnp.diagonal(power))]
    return column / jnp.sqrt(jnp.sum(column**2))


def right_angled(h: Matrix) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Of 1/f², for which the images of two axes are those of a square grid: two
    conditions a/f² + b = 0, as -Σ a b and Σ a². Several images of a camera add theirs."""
    # in units in which the two columns count alike in every image
    h = h / jnp.sqrt(jnp.maximum(jnp.sum(h[:, :2] ** 2), 1e-100))
    a, b = h[:, 0], h[:, 1]
    across = a[0] * b[0] + a[1] * b[1]
    longer = a[0] ** 2 + a[1] ** 2 - b[0] ** 2 - b[1] ** 2
    depth_across, depth_longer = a[2] * b[2], a[2] ** 2 - b[2] ** 2
    product = across * depth_across + longer * depth_longer
    return -product, across**2 + longer**2


def focal_of(product: Float[Array, ""], square: Float[Array, ""]) -> Float[Array, ""]:
    """The focal length of `right_angled`; of a moderate tele lens where it is not
    told."""
    weight = product / jnp.where(square > 0, square, 1.0)
    told = (weight > 1e-4) & (weight < 25.0)
    return jnp.where(told, 1 / jnp.sqrt(jnp.where(told, weight, 1.0)), 2.8)


def _rotation(a: Vector, b: Vector) -> Matrix:
    """The rotation whose first two rows are nearest to two unit vectors."""
    middle, across = _unit(a + b), _unit(a - b)
    half = jnp.sqrt(0.5)
    first, second = half * (middle + across), half * (middle - across)
    return jnp.stack([first, second, jnp.cross(first, second)])


def _unit(a: Vector) -> Vector:
    return a / jnp.sqrt(jnp.maximum(jnp.sum(a**2), 1e-100))


def _quaternion(turn: Matrix) -> Float[Array, "4"]:
    return jnp.stack(rot.to_quaternion(rot.as_matrix(turn)))
