"""What was measured in one image: places of points whose object coordinates are
known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..camera.area import Pair, Places
from ..xla.passes import count
from ..xla.programs import compiled

Points = Float[Array, "point 3"]


class MeasuredImage(eqx.Module):
    """One image. In a batch of images every array has one more axis in front.

    `places`: x and y in any plane rectangular system, of any unit. `points`: X, Y, Z of
    the object. `sigma`: standard deviation of x and of y. `point_sigma`: those of X, Y,
    Z, zero for points without error. Masked points are zeros. `handedness`: 1 where y
    points down when x points to the right (pixels), -1 where it points up (photo
    coordinates), 0 where the points shall tell. `bad_input`: whether a point was masked
    because it is not finite.
    """

    places: Places
    points: Points
    sigma: Float[Array, " point"]
    point_sigma: Points
    mask: Bool[Array, " point"]
    handedness: Float[Array, ""]
    bad_input: Bool[Array, ""]


def image(
    x: Float[ArrayLike, " point"],
    y: Float[ArrayLike, " point"],
    points: Float[ArrayLike, "point 3"],
    *,
    sigma: Float[ArrayLike, "*point"] = 1.0,
    point_sigma: Float[ArrayLike, "..."] = 0.0,
    mask: Bool[ArrayLike, " point"] | None = None,
    y_down: bool | None = None,
) -> MeasuredImage:
    """A `MeasuredImage`. Points that are not finite are masked; where the `mask` given
    holds them, the calibration ends in `non_finite_input`.

    `y_down`: whether y points down when x points to the right, as pixels do; None:
    points that do not lie in a plane tell it, and for a plane object it is taken to be
    so. Raises ValueError for lengths that differ.
    """
    number = np.size(x)
    as_array = lambda a: a if isinstance(a, jax.Array) else np.asarray(a)
    if np.shape(y) != np.shape(x):
        raise ValueError(
            f"calibration.image: x has shape {np.shape(x)} and y {np.shape(y)}; every "
            "place needs both"
        )
    if np.shape(points) != (number, 3):
        raise ValueError(
            f"calibration.image: {number} measured places need as many object "
            f"points (X, Y, Z), got an array of shape {np.shape(points)}"
        )
    handedness = 0.0 if y_down is None else 1.0 if y_down else -1.0
    given = np.ones(number, bool) if mask is None else mask
    numbers = x, y, points, sigma, point_sigma, handedness
    return _measure(*map(as_array, (given, *numbers)))


@compiled
def _measure(given: Bool[Array, " point"], *numbers: Array) -> MeasuredImage:
    """The image, without the points that are not finite."""
    as_real = (jnp.asarray(a, float) for a in numbers)
    x, y, points, sigma, point_sigma, handedness = as_real
    places = jnp.stack([x, y], axis=-1)
    sigma = jnp.broadcast_to(sigma, places.shape[:1])
    deviations = jnp.broadcast_to(point_sigma, points.shape)
    finite = jnp.all(jnp.isfinite(places), axis=1) & jnp.all(
        jnp.isfinite(points) & jnp.isfinite(deviations), axis=1
    )
    fair = finite & jnp.isfinite(sigma) & (sigma > 0)
    use = given & fair
    used = lambda a: jnp.where(use[:, None], a, 0.0)
    return MeasuredImage(
        places=used(places),
        points=used(points),
        sigma=jnp.where(use, sigma, 1.0),
        point_sigma=used(deviations),
        mask=use,
        handedness=handedness,
        bad_input=jnp.any(given & ~fair),
    )


class Frame(eqx.Module):
    """The units in which an image is adjusted: all its numbers are near 1.

        u = (x - cx, h (y - cy)) / size,    P = (X - C) / length

    with the centre c and half the longer side of the measured area, the centroid C of
    the object points and their root mean square distance from it, and the handedness h
    (1: y points down).
    """

    centre: Pair
    size: Float[Array, ""]
    half_sides: Pair
    middle: Float[Array, "3"]
    length: Float[Array, ""]
    handedness: Float[Array, ""]

    def normal_places(self, places: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """u of measured places."""
        centre, axes = _like(places, self.centre, self.axes)
        return (places - centre) * axes / self.size

    def measured_places(self, u: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """The inverse of `normal_places`."""
        centre, axes = _like(u, self.centre, self.axes)
        return u * axes * self.size + centre

    def normal_points(self, points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """P of object points."""
        (middle,) = _like(points, self.middle)
        return (points - middle) / self.length

    def object_points(self, normal: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """The inverse of `normal_points`."""
        (middle,) = _like(normal, self.middle)
        return normal * self.length + middle

    @property
    def axes(self) -> Pair:
        """(1, h)."""
        return jnp.stack([jnp.ones_like(self.handedness), self.handedness])


def frame(measured: MeasuredImage, handedness: Float[Array, ""]) -> Frame:
    """The frame of an image of this handedness."""
    mask = measured.mask
    return frame_of(measured.places, mask, measured.points, mask, handedness)


def frame_of(
    places: Float[Array, "place 2"],
    measured: Bool[Array, " place"],
    points: Points,
    known: Bool[Array, " point"],
    handedness: Float[Array, ""],
) -> Frame:
    """The frame of the places that are measured and the points that are known. The
    measured area is the smallest rectangle along x and y around the places."""
    least = jnp.min(jnp.where(measured[:, None], places, jnp.inf), axis=0)
    most = jnp.max(jnp.where(measured[:, None], places, -jnp.inf), axis=0)
    sides = jnp.where(most > least, most - least, 1.0)
    middle, apart = about_centroid(points, known)
    length = jnp.sqrt(jnp.sum(apart**2) / jnp.maximum(count(known), 1.0))
    return Frame(
        centre=jnp.where(most > least, (least + most) / 2, 0.0),
        size=jnp.max(sides) / 2,
        half_sides=sides / jnp.max(sides),
        middle=middle,
        length=jnp.where(length > 0, length, 1.0),
        handedness=handedness,
    )


def about_centroid(
    points: Points, use: Bool[Array, " point"]
) -> tuple[Float[Array, "3"], Points]:
    """The centroid of the points in use, and these minus it; zero for the others."""
    number = jnp.maximum(count(use), 1.0)
    middle = jnp.sum(jnp.where(use[:, None], points, 0.0), axis=0) / number
    return middle, jnp.where(use[:, None], points - middle[None], 0.0)


def _like(array: Array, *vectors: Array) -> tuple[Array, ...]:
    """Vectors with as many axes as an array has, to go with its last one."""
    return tuple(jnp.expand_dims(v, tuple(range(array.ndim - 1))) for v in vectors)
