"""COLMAP's models as text (cameras.txt, images.txt, points3D.txt), or as binary files of
the same names: pairs of photos that share points. Needs the extra `colmap`."""

from pathlib import Path
from typing import Any

import numpy as np

from ..tables.fields import TableError
from .colmap_cameras import pycolmap, see_by
from .matches import LEAST, Matches, Seen, Tracks, collect

FILES = ("cameras", "images", "points3D")


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
    model = _read_model(folder)
    warnings: list[str] = []
    tracks, twice = _tracks(folder, model, warnings).once()
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


def _read_model(folder: Path) -> Any:
    """The model of pycolmap. Raises TableError."""
    for ending in ("txt", "bin"):
        there = [f"{name}.{ending}" for name in FILES]
        if all((folder / name).is_file() for name in there):
            break
    else:
        names = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
        found = f"a folder with {', '.join(names[:9]) or 'nothing'}"
        raise TableError(
            folder,
            found=found if folder.is_dir() else "no folder",
            expected="a folder with cameras.txt, images.txt and points3D.txt",
        )
    model = pycolmap().Reconstruction()
    try:
        read = model.read_text if ending == "txt" else model.read_binary
        read(str(folder))
    except Exception as error:  # pycolmap raises whatever its parser meets
        raise TableError(
            folder,
            found=f"a model that pycolmap does not read ({_first_line(error)})",
            expected=f"{', '.join(there)} as COLMAP writes them",
        ) from None
    return model


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _tracks(folder: Path, model: Any, warnings: list[str]) -> Tracks:
    """Where the points of the model are seen. Raises TableError for a photo whose
    camera is none."""
    images = sorted(model.images.values(), key=lambda image: image.name)
    number = {point: k for k, point in enumerate(sorted(model.points3D))}
    photo, point, seen, focals = [], [], [], []
    for k, image in enumerate(images):
        keypoints = [p for p in image.points2D if p.has_point3D()]
        pixels = np.array([p.xy for p in keypoints], float).reshape(-1, 2)
        if image.camera_id not in model.cameras:
            raise TableError(
                folder,
                column=image.name,
                found=f"camera {image.camera_id}",
                expected="a camera of the model",
            )
        places, focal, there = see_by(model.cameras[image.camera_id], pixels)
        if not np.all(there):
            warnings.append(
                f"{folder}: {int(np.sum(~there))} points of photo {image.name!r} are "
                "left out, which its camera cannot have seen in front of the photo"
            )
        own = np.array([number[p.point3D_id] for p in keypoints], int)
        photo.append(np.full(int(np.sum(there)), k))
        point.append(own[there])
        seen.append(places.choose(there))
        focals.append(focal)
    together = lambda parts: np.concatenate(parts) if parts else np.zeros(0, int)
    if not images:
        raise TableError(folder, found="no photos", expected="a model with photos")
    return Tracks(
        photo=together(photo),
        point=together(point),
        seen=Seen(*map(np.concatenate, zip(*seen, strict=True))),
        photos=[image.name for image in images],
        points=[str(point) for point in number],
        focals=np.array(focals, float),
    )
