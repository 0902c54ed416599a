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

import math
from typing import NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Bool, Float

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
        return np.sqrt(np.sqrt(np.abs(self.xx * self.yy - self.xy**2)))

    @property
    def variances(self) -> tuple[Values, Values]:
        """The smallest and the largest eigenvalue of J Jᵀ."""
        mean = (self.xx + self.yy) / 2
        half = np.hypot((self.xx - self.yy) / 2, self.xy)
        return mean - half, mean + half


NO_POINTS = PhotoPoints(*(np.zeros(0) for _ in range(5)), np.zeros(0, bool))


def _is_panorama(camera: pycolmap.Camera) -> bool:
    """Whether the parameters are width and height of a panorama (EQUIRECTANGULAR)."""
    return not camera.focal_length_idxs()


def focal_length(camera: pycolmap.Camera) -> float:
    """f of the photo coordinates, in pixels; of a panorama the pixels of a radian."""
    if _is_panorama(camera):
        return float(camera.params[0]) / (2 * math.pi)
    return float(camera.mean_focal_length())


def camera_matrix(camera: pycolmap.Camera) -> Float[np.ndarray, "3 3"]:
    """K: pixels of the image free of distortion = K (u, v, 1)."""
    if _is_panorama(camera):
        f, (width, height) = focal_length(camera), camera.params
        return np.array([[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]])
    return camera.calibration_matrix()


def to_photo(
    pixels: Float[np.ndarray, "point 2"], camera: pycolmap.Camera
) -> PhotoPoints:
    """Photo coordinates and cofactors of the keypoints of one camera."""
    f = focal_length(camera)
    if camera.model_name in ("SIMPLE_PINHOLE", "PINHOLE"):
        return _without_distortion(pixels, camera, f)
    with np.errstate(all="ignore"):  # keypoints without a ray: masked at the end
        u, v = np.asarray(camera.cam_from_img(pixels)).T
        seen = u * u + v * v < WIDEST**2
        u, v = np.where(seen, u, 0.0), np.where(seen, v, 0.0)
        off = _project(camera, u, v) - pixels
        step = STEP * np.sqrt(1 + u * u + v * v)
        along_u = _project(camera, u + step, v) - _project(camera, u - step, v)
        along_v = _project(camera, u, v + step) - _project(camera, u, v - step)
        along_u, along_v = (a / (2 * step[:, None]) for a in (along_u, along_v))
        det = along_u[:, 0] * along_v[:, 1] - along_u[:, 1] * along_v[:, 0]
        # beside and behind the photo pycolmap gives (u, v) of some other ray, and beyond
        # a fold of the distortion one that is seen mirrored
        seen &= (np.sum(off * off, axis=1) < ACCURATE**2) & (det > 0)
        dot = lambda a, b: np.sum(a * b, axis=1) * (f / det) ** 2
        found = PhotoPoints(
            x=f * u,
            y=-f * v,
            xx=dot(along_v, along_v),
            xy=dot(along_u, along_v),
            yy=dot(along_u, along_u),
            seen=seen,
        )
    return PhotoPoints(*(np.where(seen, values, 0) for values in found[:-1]), seen)


def _project(camera: pycolmap.Camera, u: Values, v: Values) -> np.ndarray:
    """The pixels at which rays (u, v, 1) are seen."""
    return np.asarray(camera.img_from_cam(np.stack([u, v, np.ones_like(u)], axis=1)))


def _without_distortion(
    pixels: Float[np.ndarray, "point 2"], camera: pycolmap.Camera, f: float
) -> PhotoPoints:
    """The same in closed form."""
    (fx, _, cx), (_, fy, cy), _ = camera.calibration_matrix()
    x, y = f * ((pixels[:, 0] - cx) / fx), -f * ((pixels[:, 1] - cy) / fy)
    seen = np.isfinite(x + y)
    full = lambda value: np.full(len(pixels), value)
    if not np.all(seen):
        x, y = np.where(seen, x, 0.0), np.where(seen, y, 0.0)
    return PhotoPoints(x, y, full((f / fx) ** 2), full(0.0), full((f / fy) ** 2), seen)
