"""COLMAP's models as text (cameras.txt, images.txt, points3D.txt), or as binary files of
the same names: pairs of photos that share points. Needs the extra `colmap`."""

from pathlib import Path

import numpy as np

from ..tables.fields import TableError
from .colmap_cameras import see_by
from .colmap_model import Model, read_model
from .matches import LEAST, Matches, Seen, Tracks, collect


def read_colmap_text(
    path: str | Path, *, sigma: float | None = None, least: int = LEAST
) -> Matches:
    """The pairs of photos of a model in this folder that share at least `least` of its
    points, without the distortion of their cameras. Points are named by their numbers,
    photos by their names, so that they tie the photos of a block together.

    `sigma`: the standard deviation of a pixel coordinate. Keypoints that belong to no
    point of the model are not read. Raises TableError for what is no model.
    """
    folder = Path(path)
    warnings: list[str] = []
    tracks, twice = _tracks(read_model(folder), str(folder), warnings).once()
    if twice:
        warnings.append(
            f"{folder}: {twice} times a photo shows a point at two keypoints; both are "
            "left out"
        )
    pairs = tracks.pairs(least)
    if not pairs:
        raise TableError(
            folder,
            found=f"no two photos that share {least} points",
            expected="a pair of photos with as many",
        )
    return collect(str(folder), pairs, sigma, warnings)


def _tracks(model: Model, file: str, warnings: list[str]) -> Tracks:
    """Where the points of the model are seen, photo by photo in the order of their
    names; what is left out is added to the warnings."""
    photo, point, seen, focals = [], [], [], []
    photos = sorted(model.photos, key=lambda photo: photo.name)
    unknown = 0
    for k, one in enumerate(photos):
        known = np.isin(one.points, model.points)
        unknown += int(np.sum(~known))
        places, focal, there = see_by(one.camera, one.places[known])
        if not np.all(there):
            warnings.append(
                f"{file}: {int(np.sum(~there))} points of photo {one.name!r} are left "
                "out, which its camera cannot have seen in front of the photo"
            )
        own = np.searchsorted(model.points, one.points[known])
        photo.append(np.full(int(np.sum(there)), k))
        point.append(own[there])
        seen.append(places.choose(there))
        focals.append(focal)
    if unknown:
        warnings.append(
            f"{file}: {unknown} keypoints are left out whose point is none of the model"
        )
    return Tracks(
        photo=np.concatenate(photo),
        point=np.concatenate(point),
        seen=Seen(*map(np.concatenate, zip(*seen, strict=True))),
        photos=[one.name for one in photos],
        points=list(map(str, model.points)),
        focals=np.array(focals, float),
    )
