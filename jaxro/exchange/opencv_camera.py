"""A calibrated image, or the cameras of a block, as cameras of OpenCV: camera matrix and
distortion.

The calibration corrects measured places, by Brown's series about the principal place,
focal lengths by zones and a field. OpenCV distorts rays (`lens`):

    x = fx u' + cx,    y = fy v' + cy,    (u', v') = distorted (u, v)

Both cannot be the same function. So the camera is fitted to the calibration over the
places that it was found from, and told with what is left, in the unit of the image: what
zones, a field, sides of a pixel that are not equal or not at right angles, or the inverse
of the series do that OpenCV's coefficients cannot. The eight of the rational form would
leave the same.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..adjustment import RESULTS
from ..block.adjust import BlockAdjustment
from ..block.cameras import cameras_of
from ..block.displacements import areas_of
from ..block.network import places_of
from ..calibration.correct import correct
from ..calibration.result import Calibration
from .lens import check_coefficients, distort

ACROSS = 30
"""Places in a row of the grid over the measured area."""

AHEAD = 0.1
"""Cosine of the angle to the axis below which a ray is none that tan can describe."""


class OpencvCamera(NamedTuple):
    """`matrix`, K, with y down; `distortion`, (k1, k2, p1, p2, k3); `rest` and
    `largest`: root mean square and largest distance between a place of the calibration
    and that of this camera, over the measured area, in the unit of the image."""

    matrix: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, "5"]
    rest: float
    largest: float

    def in_pixels(
        self, pixel_size: float, origin: tuple[float, float], *, y_down: bool
    ) -> "OpencvCamera":
        """The camera of the image itself, whose pixels have this size and whose place
        `origin` was that of the photo coordinates 0, 0; with y upwards (not `y_down`)
        for the places x, -y, as OpenCV has them."""
        x, y = origin
        matrix = np.diag([1 / pixel_size, 1 / pixel_size, 1.0]) @ self.matrix
        matrix[:2, 2] += x, y if y_down else -y
        rest, largest = self.rest / pixel_size, self.largest / pixel_size
        return OpencvCamera(matrix, self.distortion, rest, largest)


def opencv_camera(found: Calibration) -> OpencvCamera:
    """The camera of OpenCV that is nearest to a calibration.

    Places of an image whose y counts upwards are those of OpenCV with -y. Raises
    ValueError for a calibration that is not usable, or whose rays are at more than 84°
    to the axis.
    """
    if not bool(found.usable):
        raise ValueError("opencv_camera: the calibration is not usable")
    return _fit(*_seen(found))


def opencv_cameras(adjusted: BlockAdjustment) -> dict[str, OpencvCamera]:
    """The camera of OpenCV that is nearest to each camera of a block, over the area that
    its photos have places in, by its name: in the unit of the photos, y down, the origin
    where the principal point was given to be (`OpencvCamera.in_pixels`).

    Raises ValueError for an adjustment that is not usable or has no unknown inner
    parameters, which is the camera that was given.
    """
    if adjusted.result != RESULTS.successful:
        raise ValueError("opencv_cameras: the adjustment is not usable")
    if adjusted.inner is None:
        raise ValueError("opencv_cameras: no inner parameters are unknown")
    cameras, found = cameras_of(adjusted.block), {}
    camera = cameras.of_photo[adjusted.block.photo]
    areas = areas_of(cameras, camera, places_of(adjusted.block))
    for k, (name, area) in enumerate(zip(cameras.names, areas, strict=True)):
        grid = area.grid
        rays = adjusted.ideal(np.full(len(grid), k), grid)
        found[name] = _fit(grid * cameras.focal[k], rays)
    return found


def _fit(
    places: Float[np.ndarray, "place 2"], rays: Float[np.ndarray, "place 2"]
) -> OpencvCamera:
    """The camera that shows rays (u, v) nearest to their places, y down."""
    from scipy.optimize import least_squares

    focal = np.ptp(places, axis=0) / np.ptp(rays, axis=0)
    # all unknowns are near 1
    units = np.array([*focal, *focal, *np.ones(5)])
    start = np.zeros(9)
    start[:4] = 1.0, 1.0, *(np.mean(places - focal * rays, axis=0) / focal)

    def misfit(unknowns: np.ndarray) -> np.ndarray:
        fx, fy, cx, cy, *distortion = unknowns * units
        seen = distort(rays, check_coefficients(distortion)) * [fx, fy] + [cx, cy]
        return ((seen - places) / focal).ravel()

    best = least_squares(misfit, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    fx, fy, cx, cy, *distortion = best.x * units
    left = np.hypot(*(misfit(best.x).reshape(-1, 2) * focal).T)
    return OpencvCamera(
        matrix=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        distortion=np.array(distortion),
        rest=float(np.sqrt(np.mean(left**2))),
        largest=float(np.max(left)),
    )


def _seen(
    found: Calibration,
) -> tuple[Float[np.ndarray, "place 2"], Float[np.ndarray, "place 2"]]:
    """Places among the measured ones, y down, and their rays (u, v) of OpenCV. Raises
    ValueError where a ray has none."""
    frame = found.frame
    half = np.asarray(frame.half_sides * frame.size)
    ticks = [
        centre + side * np.linspace(-1, 1, ACROSS)
        for centre, side in zip(np.asarray(frame.centre), half, strict=True)
    ]
    grid = np.stack(np.meshgrid(*ticks), axis=-1).reshape(-1, 2)
    corrected = correct(found, grid)
    grid = grid[corrected.inside]
    ideal = np.asarray(corrected.places)[corrected.inside] / float(corrected.focal)
    # the frame has y down
    directions = jax.vmap(lambda at: jnp.stack(found.model.rays.direction(at)))
    x, y, z = np.asarray(directions(jnp.asarray(ideal * [1.0, -1.0]))).T
    if np.any(z < AHEAD * np.sqrt(x * x + y * y + z * z)):
        raise ValueError(
            "opencv_camera: rays at more than 84° to the axis, which OpenCV's camera "
            "matrix cannot describe"
        )
    down = 1.0 if float(frame.handedness) > 0 else -1.0
    return grid * [1.0, down], np.stack([x / z, y / z], axis=1)
