"""COLMAP's cameras: from keypoints in pixels to photo coordinates free of distortion,
with the cofactors that the keypoints have there.

The camera models are those of pycolmap (`pycolmap.CameraModelId`). COLMAP's image has
its origin at the upper left corner, x to the right, y down; its camera looks along +z.
With the ray (u, v, 1) of a keypoint the photo coordinates are

    x = f u,    y = -f v,    f = (fx + fy) / 2,
    that is (x, y, -f) = f D (u, v, 1),    D = diag(1, -1, -1)

so that here the camera looks along -z, y up, and the unit of the photo is a pixel of
the mean focal length.

Only rays in front of the photo plane have photo coordinates: a fisheye may also see
beside and behind it.
"""

from typing import NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Bool, Float

TURN = 2 * np.pi

WIDEST = 100.0
"""Largest |(u, v)| that is used, 89.4° off the axis: nearer to a right angle an error
of a pixel is no small change of (u, v) any more."""

ACCURATE = 1e-3
"""Pixels within which the ray found for a keypoint must be seen at the keypoint."""

STEP = 1e-5
"""Step of the central differences, in units of sqrt(1 + u² + v²): their errors by
truncation and by rounding are both below 1e-9 of the derivative."""

Values = Float[np.ndarray, " point"]


class PhotoPoints(NamedTuple):
    """Keypoints in photo coordinates.

    `xx`, `xy`, `yy`: their cofactors J Jᵀ, J = d(x, y)/d(pixel), which times sigma² of
    a keypoint are the covariance matrix of x and y. `seen`: false where no ray in front
    of the photo plane is seen at the keypoint (the other fields are zero there).
    """

    x: Values
    y: Values
    xx: Values
    xy: Values
    yy: Values
    seen: Bool[np.ndarray, " point"]

    @property
    def scale(self) -> Values:
        """sqrt(|det J|): the growth of an error in the mean (geometric) of all
        directions."""
        squared = np.abs(self.xx * self.yy - self.xy**2)
        return np.sqrt(np.sqrt(squared))

    @property
    def variances(self) -> tuple[Values, Values]:
        """The smallest and the largest eigenvalue of J Jᵀ."""
        mean = (self.xx + self.yy) / 2
        difference = (self.xx - self.yy) / 2
        half = np.hypot(difference, self.xy)
        return mean - half, mean + half


NO_RAY = PhotoPoints(*(np.zeros(1) for _ in range(5)), np.zeros(1, bool))
"""One keypoint that is not seen."""


def camera_matrix(camera: pycolmap.Camera) -> Float[np.ndarray, "3 3"]:
    """K: pixels of the image free of distortion = K (u, v, 1). Of a panorama, whose
    parameters are width and height, the focal length is the pixels of a radian."""
    if camera.focal_length_idxs():
        return camera.calibration_matrix()
    width, height = camera.params
    matrix = np.diag([width / TURN, width / TURN, 1.0])
    matrix[:2, 2] = width / 2, height / 2
    return matrix


def focal_length(matrix: Float[np.ndarray, "3 3"]) -> float:
    """f of the photo coordinates, in pixels."""
    return float(matrix[0, 0] + matrix[1, 1]) / 2


def to_photo(
    pixels: Float[np.ndarray, "point 2"], camera: pycolmap.Camera
) -> PhotoPoints:
    """Photo coordinates and cofactors of the keypoints of one camera."""
    matrix = camera_matrix(camera)
    f = focal_length(matrix)
    with np.errstate(all="ignore"):  # keypoints without a ray are masked at the end
        u, v = np.asarray(camera.cam_from_img(pixels)).T
        seen = u * u + v * v < WIDEST**2
        if camera.model_name in ("SIMPLE_PINHOLE", "PINHOLE"):
            by_u, by_v = matrix[None, :2, :2].T
        else:
            u = np.where(seen, u, 0.0)
            v = np.where(seen, v, 0.0)
            # beside and behind the photo pycolmap gives (u, v) of some other ray
            again = _project(camera, u, v)
            seen &= np.all(np.abs(again - pixels) < ACCURATE, axis=1)
            by_u, by_v = _slopes(camera, u, v)
        det = by_u[0] * by_v[1] - by_u[1] * by_v[0]
        seen &= det > 0  # beyond a fold of the distortion the image is mirrored
        # J Jᵀ is the inverse of the products of the slopes
        factor = (f / det) ** 2
        xx = factor * (by_v[0] ** 2 + by_v[1] ** 2)
        xy = factor * (by_u[0] * by_v[0] + by_u[1] * by_v[1])
        yy = factor * (by_u[0] ** 2 + by_u[1] ** 2)
        fields = f * u, -f * v, xx, xy, yy
    fields = (np.where(seen, values, 0.0) for values in fields)
    return PhotoPoints(*fields, seen)


def _project(
    camera: pycolmap.Camera, u: Values, v: Values
) -> Float[np.ndarray, "point 2"]:
    """The pixels at which rays (u, v, 1) are seen."""
    rays = np.stack([u, v, np.ones_like(u)], axis=1)
    return np.asarray(camera.img_from_cam(rays))


def _slopes(
    camera: pycolmap.Camera, u: Values, v: Values
) -> tuple[Float[np.ndarray, "2 point"], Float[np.ndarray, "2 point"]]:
    """d(pixel)/du and d(pixel)/dv by central differences."""
    step = STEP * np.sqrt(1 + u * u + v * v)
    by_u = _project(camera, u + step, v) - _project(camera, u - step, v)
    by_v = _project(camera, u, v + step) - _project(camera, u, v - step)
    both = 2 * step
    return by_u.T / both, by_v.T / both
