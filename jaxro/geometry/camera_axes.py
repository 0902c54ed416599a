"""Poses in the axes of a camera: x to the right, y down, z forward, as computer vision
has them.

A photo has y up and looks along -z. With D = diag(1, -1, -1) a vector p in the axes of
a photo is D p in those of its camera. A point is X in the axes of the left photo and Y
in those of the right one:

    X = B + R Y   =>   D X = D B + (D R D) D Y

so that the right camera stands at D B in the left one's axes, turned by D R D. The
functions take arrays of NumPy or JAX; those of NumPy may have leading axes.
"""

from typing import Any

import numpy as np

SIGNS = np.array([1.0, -1.0, -1.0])
"""The diagonal of D."""


def to_camera_axes(rotation: Any, base: Any) -> tuple[Any, Any]:
    """(D R D, D B) of R (..., 3, 3) and B (..., 3)."""
    return rotation * np.outer(SIGNS, SIGNS), base * SIGNS


def invert(rotation: Any, translation: Any) -> tuple[Any, Any]:
    """The motion Y = Rᵀ X - Rᵀ t, which takes X = R Y + t back."""
    back = rotation.swapaxes(-1, -2)
    return back, -(back @ translation[..., None])[..., 0]
