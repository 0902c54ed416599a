"""Keypoints and matches of OpenCV, without OpenCV: whatever has the attributes of
`cv2.KeyPoint` (pt, size) and of `cv2.DMatch` (queryIdx, trainIdx) will do."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..geometry.pairs import Pair, Values
from . import lens
from .pixels import pair_from_pixels


def pair_from_opencv(
    keypoints_left: Sequence[Any],
    keypoints_right: Sequence[Any],
    matches: Sequence[Any],
    K_left: Values,
    K_right: Values | None = None,
    *,
    sigma: float | None = None,
    sigma_by_size: float | None = None,
    distortion_left: lens.Coefficients | None = None,
    distortion_right: lens.Coefficients | None = None,
) -> Pair:
    """A `Pair` of matches; the left photo is the one of the query. Points have the
    order of the matches.

    `sigma`: the standard deviation of a pixel coordinate of all keypoints.
    `sigma_by_size` in its place: standard deviation over `KeyPoint.size`, the diameter
    of the patch in pixels. A detector of scale space finds a place to a part of the
    scale, so that large patches are less accurate; the two keypoints of a match then
    have standard deviations of their own, and the pair has covariances. What the part
    is depends on the detector: with a guess sigma0 of the orientation says by what it
    is wrong. With neither all pixels have equal weight. The score of a match is minus its
    `DMatch.distance`, where all matches have one. Other parameters are those of
    `pair_from_pixels`.

    Raises ValueError for no matches, for those of `knnMatch` that were not chosen from,
    and for indices without a keypoint.
    """
    if sigma is not None and sigma_by_size is not None:
        raise ValueError("pair_from_opencv: sigma and sigma_by_size exclude each other")
    matches = list(matches)
    if not matches:
        raise ValueError("pair_from_opencv: no matches given")
    if isinstance(matches[0], list | tuple):
        raise ValueError(
            "pair_from_opencv: these are lists of several matches, as knnMatch returns "
            "them: choose one of each first, for example the nearest where the second "
            "is much farther"
        )
    left = _chosen(keypoints_left, [m.queryIdx for m in matches], "left")
    right = _chosen(keypoints_right, [m.trainIdx for m in matches], "right")
    deviations = sigma
    if sigma_by_size is not None:
        deviations = sigma_by_size * _sizes(left, right)
    return pair_from_pixels(
        np.array([k.pt for k in left], float),
        np.array([k.pt for k in right], float),
        K_left,
        K_right,
        sigma=deviations,
        score=_scores(matches),
        distortion_left=distortion_left,
        distortion_right=distortion_right,
    )


def _chosen(keypoints: Sequence[Any], indices: list[int], side: str) -> list[Any]:
    """The keypoints of these indices. Raises ValueError for one that is not there."""
    for number, index in enumerate(indices):
        if not 0 <= index < len(keypoints):
            raise ValueError(
                f"pair_from_opencv: match {number} names keypoint {index} of the {side} "
                f"photo, which has {len(keypoints)}; are the photos exchanged?"
            )
    return [keypoints[index] for index in indices]


def _scores(matches: list[Any]) -> Float[np.ndarray, " match"] | None:
    """How likely the matches are right: the less, the farther apart their descriptors
    are. None where nobody says, or all say the same."""
    distances = np.array([getattr(m, "distance", np.nan) for m in matches], float)
    told = np.all(np.isfinite(distances)) and np.ptp(distances) > 0
    return -distances if told else None


def _sizes(left: list[Any], right: list[Any]) -> Float[np.ndarray, "match 2"]:
    """The sizes of both keypoints. Raises ValueError where one has none."""
    sizes = np.array([[k.size for k in left], [k.size for k in right]], float).T
    if not np.all(sizes > 0):
        number = int(np.argmax(~np.all(sizes > 0, axis=1)))
        raise ValueError(
            f"pair_from_opencv: the keypoints of match {number} have the sizes "
            f"{sizes[number].tolist()}; sigma_by_size needs positive ones"
        )
    return sizes
