"""Pixels of COLMAP's cameras as photo coordinates with cofactors, with a word about
what is missing where pycolmap is not installed."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from .matches import Seen


def pycolmap() -> Any:
    """The module. Raises SystemExit with the way to install it."""
    try:
        import pycolmap
    except ModuleNotFoundError:
        raise SystemExit(
            "Cameras and models of COLMAP need pycolmap: pip install 'jaxro[colmap]'"
        ) from None
    return pycolmap


def see(
    model: str,
    width: int,
    height: int,
    params: Float[np.ndarray, " _"],
    pixels: Float[np.ndarray, "point 2"],
) -> tuple[Seen, float, Bool[np.ndarray, " point"]]:
    """The points, the focal length in pixels, and which points a ray in front of the
    photo has. Raises ValueError for no camera of COLMAP."""
    module = pycolmap()
    known = module.CameraModelId.__members__
    if model not in known:
        raise ValueError(f"the model {model!r}; COLMAP has {', '.join(sorted(known))}")
    camera = module.Camera(model=model, width=width, height=height, params=params)
    if not camera.verify_params():
        raise ValueError(f"{len(params)} parameters of model {model}")
    return see_by(camera, pixels)


def see_by(
    camera: Any, pixels: Float[np.ndarray, "point 2"]
) -> tuple[Seen, float, Bool[np.ndarray, " point"]]:
    """The same of a camera of pycolmap."""
    from ..colmap.cameras import camera_matrix, focal_length, to_photo

    points = to_photo(pixels, camera)
    rows = [[points.xx, points.xy], [points.xy, points.yy]]
    cofactors = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    focal = focal_length(camera_matrix(camera))
    return Seen(points.x, points.y, cofactors), focal, points.seen
