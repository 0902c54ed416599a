"""COLMAP's two-view geometry of an oriented pair: configuration and matrices.

With D = diag(1, -1, -1) a pose R, b of jaxro is in COLMAP's frames
(`geometry.camera_axes`)

    cam2_from_cam1:  R' = D Rᵀ D,  t = -R' D b,    E = [t]x R',
    F = K2⁻ᵀ E K1⁻¹,    H = K2 (R' + t (D n)ᵀ) K1⁻¹

b of unit length, n · X = 1 the plane. F and H hold for keypoints free of distortion.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..geometry.camera_axes import SIGNS, invert, to_camera_axes
from ..rejection.classification import Found, Kind
from .database import Geometry, Matches

CONFIG = {
    Kind.oriented: 2,
    Kind.plane: 4,
    Kind.two_poses: 4,
    Kind.rotation: 5,
    Kind.weak: 2,
    Kind.no_consensus: 1,
    Kind.too_few: 1,
    Kind.several: 8,
}
"""COLMAP's number: CALIBRATED 2, PLANAR 4, PANORAMIC 5, DEGENERATE 1, MULTIPLE 8."""

CONTENT = {
    Kind.oriented: ("F", "E", "qvec", "tvec"),
    Kind.plane: ("F", "E", "H", "qvec", "tvec"),
    Kind.two_poses: ("F", "E", "H"),
    Kind.rotation: ("H", "qvec", "tvec"),
    Kind.weak: ("F", "E"),
    Kind.no_consensus: (),
    Kind.too_few: (),
    Kind.several: (),
}
"""What is written of a pair besides its matches: no pose where the matches have two or
more, nor where the base is too short for its errors."""

Matrices = Float[np.ndarray, "pair 3 3"]


def geometries(
    pair_ids: Sequence[int],
    matches: Sequence[Matches],
    found: Found,
    k1: Matrices,
    k2: Matrices,
) -> list[Geometry]:
    """The rows of two_view_geometries of these pairs; k1, k2: the matrices of their
    cameras."""
    columns = matrices(found, k1, k2)
    rows = []
    for i, (pair_id, given) in enumerate(zip(pair_ids, matches, strict=True)):
        kind = Kind(int(found.kind[i]))
        rows.append(
            Geometry(
                pair_id=pair_id,
                matches=given[found.kept[i, : len(given)]],
                config=CONFIG[kind],
                matrices={name: columns[name][i] for name in CONTENT[kind]},
            )
        )
    return rows


def matrices(found: Found, k1: Matrices, k2: Matrices) -> dict[str, np.ndarray]:
    """F, E, H, qvec and tvec of every pair; without a base H and tvec are those of the
    rotation alone."""
    placed = to_camera_axes(np.asarray(found.rotation), np.asarray(found.base))
    rotation, t = invert(*placed)
    without_base = found.kind == Kind.rotation
    t = np.where(without_base[:, None], 0.0, t)
    columns = [np.cross(t, rotation[:, :, k]) for k in range(3)]
    essential = np.stack(columns, axis=-1)
    plane = t[:, :, None] * (SIGNS * found.normal)[:, None, :]
    k1_inverse = np.linalg.inv(k1)
    k2_inverse_transposed = np.swapaxes(np.linalg.inv(k2), 1, 2)
    # the inverse of a rotation, its axis mirrored by D: of the quaternion -x
    quaternion = np.asarray(found.quaternion) * np.array([1.0, -1.0, 1.0, 1.0])
    return {
        "F": k2_inverse_transposed @ essential @ k1_inverse,
        "E": essential,
        "H": k2 @ (rotation + plane) @ k1_inverse,
        "qvec": quaternion,
        "tvec": t,
    }
