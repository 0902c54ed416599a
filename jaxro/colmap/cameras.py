"""COLMAP's cameras: from keypoints in pixels to photo coordinates free of distortion.

COLMAP's image has its origin at the upper left corner, x to the right, y down, the
centre of the first pixel at (.5, .5); its camera looks along +z. With the parameters
fx, fy, cx, cy a ray (u, v, 1) is seen at

    (fx u' + cx, fy v' + cy),
    u' = u d + 2 p1 u v + p2 (r² + 2 u²),    v' = v d + 2 p2 u v + p1 (r² + 2 v²),
    d = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶),    r² = u² + v²

(SIMPLE_RADIAL to FULL_OPENCV; what a model does not have is zero). Here the camera
looks along -z, y up:

    x = f u,    y = -f v,    f = (fx + fy) / 2,
    that is (x, y, -f) = f D (u, v, 1),    D = diag(1, -1, -1)

so that the units of the photo are pixels of the mean focal length. No shift by half a
pixel is needed: cx and cy count from the same corner.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..xla.programs import Program

ONE_FOCAL = ("f", "cx", "cy")
TWO_FOCALS = ("fx", "fy", "cx", "cy")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

MODELS: dict[int, tuple[str, tuple[str, ...]]] = {
    0: ("SIMPLE_PINHOLE", ONE_FOCAL),
    1: ("PINHOLE", TWO_FOCALS),
    2: ("SIMPLE_RADIAL", (*ONE_FOCAL, "k1")),
    3: ("RADIAL", (*ONE_FOCAL, "k1", "k2")),
    4: ("OPENCV", (*TWO_FOCALS, *COEFFICIENTS[:4])),
    6: ("FULL_OPENCV", (*TWO_FOCALS, *COEFFICIENTS)),
}
"""Number in the database, name and parameters of the camera models that are
understood."""

OTHERS = {
    5: "OPENCV_FISHEYE",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
    12: "SIMPLE_DIVISION",
    13: "DIVISION",
    14: "SIMPLE_FISHEYE",
    15: "FISHEYE",
    16: "EUCM",
    17: "EQUIRECTANGULAR",
}
"""Those that are not, so that an error can name them."""

STEPS = 25
"""Newton steps at most; a distortion of a third takes six."""

EXACT = 1e-11
"""Distance (in focal lengths) within which a ray is seen where the keypoint is."""

TOGETHER = 1 << 16
"""Keypoints in one call."""

Number = Float[Array, "..."]


class PhotoCamera(NamedTuple):
    """A camera of the database: name of the model, by that its parameters, focal length
    known beforehand or guessed."""

    model: str
    parameters: dict[str, float]
    known: bool

    @property
    def focals(self) -> tuple[float, float]:
        """fx, fy"""
        p = self.parameters
        return (p["f"], p["f"]) if "f" in p else (p["fx"], p["fy"])

    @property
    def focal(self) -> float:
        """The focal length of the photo coordinates."""
        return sum(self.focals) / 2

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K, pixels of the image without distortion = K (u, v, 1)."""
        fx, fy = self.focals
        return np.array(
            [
                [fx, 0.0, self.parameters["cx"]],
                [0.0, fy, self.parameters["cy"]],
                [0.0, 0.0, 1.0],
            ]
        )


class PhotoPoints(NamedTuple):
    """Keypoints: x, y as above; `scale`, how much larger an error is in them than it
    was in the image; `seen`, false where no ray is seen at the keypoint (their
    coordinates are zero)."""

    x: Float[np.ndarray, "point"]
    y: Float[np.ndarray, "point"]
    scale: Float[np.ndarray, "point"]
    seen: Bool[np.ndarray, "point"]


def distorted(
    u: Number, v: Number, coefficients: tuple[Number, ...]
) -> tuple[Number, Number]:
    """(u', v') of one ray; the coefficients in the order of COEFFICIENTS."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    r2 = u * u + v * v
    d = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return u * d + 2 * p1 * u * v + p2 * (
        r2 + 2 * u * u
    ), v * d + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)


def undistorted(u: Number, v: Number, coefficients: tuple[Number, ...]):
    """(u, v) of the ray seen at (u', v') by Newton's method from there, det d(u',
    v')/d(u, v), and whether it exists: what lies beyond a fold of the distortion, where
    the determinant is not positive, is no image of a ray."""

    def at(x, y):
        (a, b), along = jax.linearize(lambda x, y: distorted(x, y, coefficients), x, y)
        one, zero = jnp.ones_like(x), jnp.zeros_like(x)
        (ax, bx), (ay, by) = along(one, zero), along(zero, one)
        return a - u, b - v, (ax, ay, bx, by), ax * by - ay * bx

    def step(_, ray):
        x, y = ray
        a, b, (ax, ay, bx, by), det = at(x, y)
        safe = jnp.where(det == 0, 1.0, det)
        dx, dy = (by * a - ay * b) / safe, (ax * b - bx * a) / safe
        # not further than half the way to the axis, so that no step passes over a fold
        most = (1 + jnp.sqrt(x * x + y * y)) / 2
        shrink = jnp.minimum(
            1.0, most / jnp.sqrt(jnp.maximum(dx * dx + dy * dy, 1e-300))
        )
        return x - shrink * dx, y - shrink * dy

    x, y = jax.lax.fori_loop(0, STEPS, step, (u, v))
    a, b, _, det = at(x, y)
    return x, y, det, (a * a + b * b <= EXACT**2) & (det > 0)


def _all(measured: tuple) -> tuple:
    return jax.vmap(undistorted)(*measured)


def photo_points(
    pixels: Float[np.ndarray, "point 2"], cameras: list[PhotoCamera], lengths: list[int]
) -> PhotoPoints:
    """The keypoints of all images, one image after another, `lengths` of them by each
    of the cameras."""
    names = ("cx", "cy", *COEFFICIENTS)
    rows = [
        [*c.focals, c.focal, *(c.parameters.get(name, 0.0) for name in names)]
        for c in cameras
    ]
    of_image = np.array(rows).reshape(-1, 3 + len(names)).T
    every = lambda values: np.repeat(values, lengths)  # to the keypoints of every image
    fx, fy, f, cx, cy = (
        every(a) if np.any(a != a[:1]) else a[:1] for a in of_image[:5]
    )
    u, v = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    scale = f / np.sqrt(fx * fy)
    seen = np.isfinite(u + v)
    if np.any(of_image[5:]):
        u, v, det, exists = _in_parts(u, v, list(map(every, of_image[5:])))
        seen = seen & exists & np.isfinite(u + v)
        scale = scale / np.sqrt(np.where(seen, det, 1.0))
    x, y, scale = f * u, -f * v, np.broadcast_to(scale, seen.shape)
    if not np.all(seen):
        x, y, scale = (np.where(seen, a, 0.0) for a in (x, y, scale))
    return PhotoPoints(x, y, scale, seen)


def _in_parts(
    u: np.ndarray, v: np.ndarray, coefficients: list[np.ndarray]
) -> list[np.ndarray]:
    """`undistorted` of all keypoints, TOGETHER at a time, so that few programs are
    compiled."""
    run = Program(_all, {})
    found = []
    for begin in range(0, len(u), TOGETHER):
        part = slice(begin, begin + TOGETHER)
        found.append(_padded(run, (u[part], v[part]), [c[part] for c in coefficients]))
    empty = np.zeros(0), np.zeros(0), np.ones(0), np.zeros(0, bool)
    return [np.concatenate(columns) for columns in zip(empty, *found, strict=True)]


def _padded(run: Program, wanted: tuple, coefficients: list) -> tuple:
    """The program on arrays of one of few lengths, each of which is compiled once."""
    count = len(wanted[0])
    size = min(TOGETHER, 1 << max(count - 1, 0).bit_length())
    fill = lambda a: np.pad(a, (0, size - count))
    out = run((*map(fill, wanted), tuple(map(fill, coefficients))))
    return tuple(np.asarray(a)[:count] for a in out)
