"""Pixels of COLMAP's cameras as photo coordinates with cofactors, with a word about
what is missing where pycolmap is not installed."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from .matches import FARTHEST, Seen, is_focal

LARGEST = 2**31 - 1
"""Pixels of the longest side of a photo."""


def pycolmap() -> Any:
    """The module. Raises SystemExit with the way to install it."""
    try:
        import pycolmap
    except ModuleNotFoundError:
        raise SystemExit(
            "Cameras and models of COLMAP need pycolmap: pip install 'jaxro[colmap]'"
        ) from None
    return pycolmap


def _models() -> dict[str, Any]:
    """The camera models by their names."""
    known = dict(pycolmap().CameraModelId.__members__)
    known.pop("INVALID", None)
    return known


def model_of_name(name: str) -> Any:
    """The camera model of pycolmap. Raises ValueError for none of COLMAP's."""
    known = _models()
    if name not in known:
        raise ValueError(f"the model {name!r}; COLMAP has {', '.join(sorted(known))}")
    return known[name]


def model_of_number(number: int) -> Any:
    """The camera model that binary files name by a number. Raises ValueError."""
    numbers = {int(model): model for model in _models().values()}
    if number not in numbers:
        raise ValueError(
            f"the model {number}; COLMAP has {min(numbers)}-{max(numbers)}"
        )
    return numbers[number]


def count_parameters(model: Any) -> int:
    """How many parameters a camera of this model has."""
    return len(pycolmap().Camera.create_from_model_id(1, model, 1.0, 1, 1).params)


def make_camera(
    model: Any, width: int, height: int, params: Float[np.ndarray, " _"]
) -> Any:
    """A camera of pycolmap. Raises ValueError where it can be none: another number of
    parameters, sizes or a focal length beyond those of photos."""
    from ..colmap.cameras import camera_matrix, focal_length

    if len(params) != (count := count_parameters(model)):
        found = f"{len(params)} parameters of model {model.name}"
        raise ValueError(f"{found}, which has {count}")
    if not (0 <= width <= LARGEST and 0 <= height <= LARGEST):
        raise ValueError(f"a photo of {width} x {height} pixels")
    if not np.all(np.abs(params) <= FARTHEST):
        raise ValueError(f"the parameters {params.tolist()}")
    camera = pycolmap().Camera(model=model, width=width, height=height, params=params)
    focal = focal_length(camera_matrix(camera))
    if not is_focal(focal):
        raise ValueError(f"a focal length of {focal:g} pixels")
    return camera


def see_by(
    camera: Any, pixels: Float[np.ndarray, "point 2"]
) -> tuple[Seen, float, Bool[np.ndarray, " point"]]:
    """The points on photos of a camera of pycolmap, the focal length in pixels, and
    which points a ray in front of the photo has."""
    from ..colmap.cameras import camera_matrix, focal_length, to_photo

    points = to_photo(pixels, camera)
    rows = [[points.xx, points.xy], [points.xy, points.yy]]
    cofactors = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    focal = focal_length(camera_matrix(camera))
    seen = Seen(points.x, points.y, cofactors)
    return seen, focal, points.seen & seen.usable
