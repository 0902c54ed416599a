"""Places of points in several images, some of the points with known object
coordinates."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from .images import Points
from .starts import NEARLY_FLAT, thickness

FEWEST = 4
"""Points that an image needs for its first station."""

TURNS = 4
"""Turns of resection and intersection."""


class MeasuredImages(eqx.Module):
    """Places of points in several images, one after the other.

    `image` and `point`: the numbers of each place. `camera`: the camera of each image.
    `points`: object coordinates and `point_sigma` their standard deviations, 0 for fixed
    ones and infinite for unknown ones. `handedness`: 1 where y points down, -1 where it
    points up. `rows`: the places of each image, filled with their number. `cameras`: how
    many there are; `solid`: whether the known points do not lie near a plane.
    """

    places: Float[Array, "place 2"]
    image: Int[Array, " place"]
    point: Int[Array, " place"]
    sigma: Float[Array, " place"]
    camera: Int[Array, " image"]
    points: Points
    point_sigma: Points
    handedness: Float[Array, ""]
    rows: Int[Array, "image most"]
    cameras: int = eqx.field(static=True)
    solid: bool = eqx.field(static=True)


def images(
    x: Float[ArrayLike, " place"],
    y: Float[ArrayLike, " place"],
    image: Int[ArrayLike, " place"],
    point: Int[ArrayLike, " place"],
    points: Float[ArrayLike, "point 3"],
    *,
    point_sigma: Float[ArrayLike, "..."] = 0.0,
    sigma: Float[ArrayLike, "*place"] = 1.0,
    camera: Int[ArrayLike, " image"] | None = None,
    y_down: bool = True,
) -> MeasuredImages:
    """`MeasuredImages`; object points that are not finite are unknown.

    `camera`: None if one camera took all images. Raises ValueError for places that are
    not finite or have no positive `sigma`, for numbers that do not exist, and for images
    and points that resection and intersection in turns do not reach.
    """
    places = np.stack([np.asarray(x, float), np.asarray(y, float)], axis=-1)
    image, point = np.asarray(image), np.asarray(point)
    points = np.array(points, float)
    _check_finite(places, np.asarray(sigma, float), image, point)
    if point.size and not (point.min() >= 0 and point.max() < len(points)):
        raise ValueError(
            f"calibration.images: points have the numbers 0 to {len(points) - 1}, got "
            f"{point.min()} to {point.max()}"
        )
    known = np.all(np.isfinite(points), axis=1)
    deviations = np.broadcast_to(np.asarray(point_sigma, float), points.shape)
    deviations = np.where(known[:, None], deviations, np.inf)
    known = np.all(np.isfinite(deviations), axis=1)
    met = np.bincount(point, minlength=len(points))
    if np.any(lonely := ~known & (met < 2)):
        raise ValueError(
            f"calibration.images: point {np.flatnonzero(lonely)[0]} is unknown and "
            "measured in fewer than two images; leave it out, or give its coordinates "
            f"(points like it: {np.sum(lonely)})"
        )
    number = int(image.max()) + 1
    few, seen = find_unreached(image, point, known, number)
    if few.size:
        raise ValueError(
            f"calibration.images: an image needs {FEWEST} points that are known or seen "
            f"in two images with as many; image {few[0]} has {seen[0]} (images like it: "
            f"{few.size})"
        )
    return MeasuredImages(
        places=jnp.asarray(places),
        image=jnp.asarray(image),
        point=jnp.asarray(point),
        sigma=jnp.broadcast_to(jnp.asarray(sigma, float), image.shape),
        camera=jnp.zeros(number, int) if camera is None else jnp.asarray(camera),
        points=jnp.asarray(np.where(np.isfinite(points), points, 0.0)),
        point_sigma=jnp.asarray(deviations),
        handedness=jnp.asarray(1.0 if y_down else -1.0),
        rows=jnp.asarray(_rows(image, number)),
        cameras=1 if camera is None else int(np.max(np.asarray(camera))) + 1,
        solid=bool(thickness(jnp.asarray(points), jnp.asarray(known)) > NEARLY_FLAT),
    )


def _check_finite(
    places: np.ndarray, sigma: np.ndarray, image: np.ndarray, point: np.ndarray
) -> None:
    """Raises ValueError, with the first place that cannot be used, and how many."""
    sigma = np.broadcast_to(sigma, image.shape)
    fair = np.isfinite(sigma) & (sigma > 0) & np.all(np.isfinite(places), axis=1)
    if not np.all(fair):
        k = int(np.argmin(fair))
        raise ValueError(
            f"calibration.images: place {k} (point {point[k]} in image {image[k]}) is "
            f"x = {places[k, 0]:g}, y = {places[k, 1]:g}, sigma = {sigma[k]:g}; leave it "
            f"out (places like it: {np.sum(~fair)})"
        )


def _rows(image: np.ndarray, number: int) -> np.ndarray:
    """The places of each image in random order, (image, most), filled with the number
    of places."""
    counts = np.bincount(image, minlength=number)
    rows = np.full((number, counts.max()), len(image))
    rng = np.random.default_rng(0)
    for k in range(number):
        rows[k, : counts[k]] = rng.permutation(np.flatnonzero(image == k))
    return rows


def find_unreached(
    image: np.ndarray, point: np.ndarray, known: np.ndarray, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """The images that resection and intersection in turns leave out, and how many
    points each of them has; `number`: of all images."""
    seen = np.bincount(image[known[point]], minlength=number)
    for _ in range(TURNS):
        rays = np.bincount(point[(seen >= FEWEST)[image]], minlength=len(known))
        known = known | (rays >= 2)
        seen = np.bincount(image[known[point]], minlength=number)
    few = np.flatnonzero(seen < FEWEST)
    return few, seen[few]
