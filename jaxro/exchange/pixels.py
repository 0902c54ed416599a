"""Matches in pixels with camera matrices, as programs of computer vision have them.

A pixel (c, r), columns to the right and rows down, is seen along the ray

    (u, v, 1) = K⁻¹ (c, r, 1),    K = [[fx, s, cx], [0, fy, cy], [0, 0, 1]],

in the axes of OpenCV and COLMAP: x to the right, y down, z forward. The photo
coordinates are those of a photo with one focal length and y up,

    x = f u,    y = -f v,    f = (fx + fy) / 2,

so that their unit is a pixel of the mean focal length. An error of a pixel becomes
J = d(x, y) / d(c, r) times itself, and a covariance matrix C of pixels J C Jᵀ. With fx =
fy, without skew and distortion, J has the diagonal (1, -1), and a standard deviation
stays what it is. In all other cases x and y of a point have covariances of their own.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..geometry.pairs import Pair, Values, pair
from . import lens

Pixels = Float[np.ndarray, "point 2"]


class PhotoPoints(NamedTuple):
    """Photo coordinates of points, and J of each; `plain`: whether J has the diagonal
    (1, -1) everywhere. `focal` in pixels."""

    x: Float[np.ndarray, " point"]
    y: Float[np.ndarray, " point"]
    slopes: Float[np.ndarray, "point 2 2"]
    plain: bool
    focal: float

    def covariances(
        self, pixels: Float[np.ndarray, "point 2 2"]
    ) -> Float[np.ndarray, "point 2 2"]:
        """J C Jᵀ of covariance matrices C in pixels."""
        both = self.slopes @ pixels @ np.swapaxes(self.slopes, -1, -2)
        return (both + np.swapaxes(both, -1, -2)) / 2


def pair_from_pixels(
    points_left: Values,
    points_right: Values,
    K_left: Values,
    K_right: Values | None = None,
    *,
    sigma: Values | None = None,
    covariances: tuple[Values, Values] | None = None,
    mask: Values | None = None,
    score: Values | None = None,
    distortion_left: lens.Coefficients | None = None,
    distortion_right: lens.Coefficients | None = None,
) -> Pair:
    """A `Pair` of matched points in pixels, (point, 2) each, rows counted downwards.

    `K_left`, `K_right`: the camera matrices; without the right one both photos have the
    same camera. `sigma`: the standard deviation of a pixel coordinate, one for all
    points, one for each (point,), or of the left and of the right point (point, 2).
    `score` of each match: that of a `Pair`.
    `covariances` in its place: the covariance matrices of (column, row), left and
    right, (point, 2, 2) each. With neither all pixels have equal weight, and sigma0 is
    in pixels. `distortion_left`, `distortion_right`: OpenCV's (k1, k2, p1, p2[, k3]).

    The result is in pixels: x to the right, y up, from the principal point. Its
    coordinates have covariances (`Pair.roots`) wherever the two are not equally
    accurate there. Raises ValueError for shapes that do not agree, for a matrix that is
    no camera matrix, and for points that a lens cannot have seen.
    """
    same = K_right is None
    if same and distortion_right is not None:
        raise ValueError(
            "pair_from_pixels: distortion_right is given without K_right; name the "
            "right camera, too"
        )
    left = to_photo(points_left, K_left, distortion_left, "left")
    right = to_photo(
        points_right,
        K_left if K_right is None else K_right,
        distortion_left if same else distortion_right,
        "right",
    )
    if len(left.x) != len(right.x):
        raise ValueError(
            f"pair_from_pixels: {len(left.x)} left and {len(right.x)} right points; "
            "both are wanted in the order of the matches"
        )
    of_points = {"mask": mask, "score": score}
    return pair_of_points(
        left, right, sigma=sigma, covariances=covariances, **of_points
    )


def pair_of_points(
    left: PhotoPoints,
    right: PhotoPoints,
    *,
    sigma: Values | None,
    covariances: tuple[Values, Values] | None = None,
    mask: Values | None = None,
    score: Values | None = None,
) -> Pair:
    """The pair of these points, with what is said of the accuracy of their pixels."""
    coordinates, focal = (left.x, left.y, right.x, right.y), (left.focal, right.focal)
    if sigma is not None and covariances is not None:
        raise ValueError("pair_from_pixels: sigma and covariances are given; one is")
    one_sigma = covariances is None and np.ndim(0.0 if sigma is None else sigma) < 2
    if one_sigma and left.plain and right.plain:
        return pair(*coordinates, focal=focal, sigma=sigma, mask=mask, score=score)
    pixels = _covariances(sigma, covariances, len(left.x))
    of_photos = left.covariances(pixels[0]), right.covariances(pixels[1])
    accuracy = {"covariances": of_photos, "mask": mask}
    return pair(*coordinates, focal=focal, score=score, **accuracy)


def _covariances(
    sigma: Values | None,
    covariances: tuple[Values, Values] | None,
    points: int,
) -> list[Float[np.ndarray, "point 2 2"]]:
    """Covariance matrices of the left and of the right pixels. Raises ValueError for
    shapes that do not fit."""
    if covariances is not None:
        given = [np.asarray(c, float) for c in covariances]
        wanted = f"{(points, 2, 2)} or (2, 2)"
        shapes, whole = [c.shape for c in given], (points, 2, 2)
    else:
        deviations = np.asarray(1.0 if sigma is None else sigma, float)
        if deviations.ndim < 2:
            deviations = np.stack([deviations, deviations], axis=-1)
        wanted = f"one number, {(points,)} or {(points, 2)}"
        shapes, whole = [np.shape(np.asarray(sigma))] * 2, (points, 2, 2)
        given = [deviations[..., k, None, None] ** 2 * np.eye(2) for k in range(2)]
    try:
        return [np.broadcast_to(c, whole) for c in given]
    except ValueError:
        what = "sigma" if covariances is None else "covariances"
        raise ValueError(
            f"pair_from_pixels: {what} of shape {shapes[0]}; wanted {wanted}"
        ) from None


def to_photo(
    points: Values,
    matrix: Values,
    distortion: lens.Coefficients | None = None,
    side: str = "left",
) -> PhotoPoints:
    """Photo coordinates of the pixels of one camera; `side` is named in errors."""
    pixels = check_points(points, side)
    k = check_matrix(matrix, side)
    f = (k[0, 0] + k[1, 1]) / 2
    inverse = np.linalg.inv(k)
    rays = pixels @ inverse[:2, :2].T + inverse[:2, 2]
    slopes = np.broadcast_to(inverse[:2, :2], (len(pixels), 2, 2))
    if distortion is not None:
        found = lens.undistort(rays, lens.check_coefficients(distortion))
        finite = np.all(np.isfinite(pixels), axis=1)
        if np.any(finite & ~found.found):
            number = int(np.argmax(finite & ~found.found))
            raise ValueError(
                f"pair_from_pixels: no ray is seen at pixel {pixels[number].tolist()} "
                f"of the {side} photo (point {number}): the distortion does not invert "
                "so far from the centre; check the coefficients, or leave the point out"
            )
        rays = np.where(finite[:, None], found.rays, np.nan)
        slopes = found.slopes @ slopes
    with_axes = np.array([[f], [-f]])
    return PhotoPoints(
        x=f * rays[:, 0],
        y=-f * rays[:, 1],
        slopes=with_axes * slopes,
        plain=distortion is None and k[0, 0] == k[1, 1] and k[0, 1] == 0,
        focal=float(f),
    )


def check_points(points: Values, side: str) -> Pixels:
    """The pixels as an array. Raises ValueError for what are none."""
    pixels = np.asarray(points, float)
    if pixels.ndim == 3 and pixels.shape[1:] == (1, 2):  # as OpenCV returns them
        pixels = pixels[:, 0]
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ValueError(
            f"pair_from_pixels: the {side} points have shape {pixels.shape}; (point, 2) "
            "is wanted, column and row of each"
        )
    return pixels


def check_matrix(matrix: Values, side: str) -> Float[np.ndarray, "3 3"]:
    """K as an array. Raises ValueError for what is no camera matrix."""
    k = np.asarray(matrix, float)
    good = k.shape == (3, 3) and np.all(np.isfinite(k))
    good = good and np.array_equal(k[2], [0, 0, 1]) and k[1, 0] == 0
    if not (good and k[0, 0] > 0 and k[1, 1] > 0):
        raise ValueError(
            f"pair_from_pixels: K of the {side} photo must be [[fx, s, cx], [0, fy, cy], "
            f"[0, 0, 1]] with positive fx and fy, got {k.tolist()}"
        )
    return k
