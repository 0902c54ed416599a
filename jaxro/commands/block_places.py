"""A block that is measured photo by photo: a table with one row for each place, and the
pairs that its photos are chained from."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..block.measured_block import MeasuredBlock
from ..block.photo_pairs import CommonPoints
from ..geometry.pairs import Camera
from ..reports.terminal import say_what
from ..tables import images
from ..tables.cameras import Cameras
from ..tables.survey_checks import Row
from . import request, sigma as deviation
from .places import Numbered, check_one_camera, number


@dataclass(frozen=True)
class Places:
    """A measured block, the points in common of the pairs that join its photos, its
    sigma in words, and whether it was given; the `cameras` of its photos."""

    block: MeasuredBlock
    common: CommonPoints
    sigma: str
    sigma_known: bool
    cameras: tuple[Camera, ...]


def read(options: request.Options, *, are_unknown: bool) -> Places:
    """The block of a table of places; `are_unknown`: whether inner parameters of its
    cameras are, so that one camera that is given may stand for several. Raises
    TableError."""
    assert options.file is not None
    with say_what(f"Reading {options.file} ..."):
        rows = images.read_places(options.file)
    has_sigma = "sigma" in rows[0].cells
    request.check_numbers(
        options, has_sigma, str(options.file), request.SYSTEMS["relative"]
    )
    cameras = request.read_cameras(options, request.MEASURED, may_be_named=True)
    if not (cameras.photos or cameras.named or are_unknown):
        check_one_camera(rows)
    measured = in_photos(rows, cameras)
    numbered = number(rows, options.file)
    of_photo = dict(zip(numbered.photo.tolist(), rows, strict=True))
    own = tuple(_camera(of_photo[k], cameras) for k in range(len(numbered.photos)))
    block, common = _block(rows, own, numbered, *measured), numbered.common
    unit, stated = deviation.parse(options.sigma), "to the given standard deviations"
    if not has_sigma and unit is None:
        with say_what("Finding the standard deviation of the photo coordinates ..."):
            noise = deviation.from_residuals(common.as_pairs(block))
        unit, stated = noise.sigma, deviation.sentence(noise, options.unit)
    block = block._replace(sigma=block.sigma * (1.0 if has_sigma else unit))
    known = has_sigma or options.sigma not in (None, deviation.AUTO)
    return Places(block, common, stated, known, own)


def in_photos(
    rows: list[Row], cameras: Cameras
) -> tuple[Float[np.ndarray, "row 2"], Float[np.ndarray, " row"]]:
    """Photo coordinates of rows of places, and their standard deviations, NaN where the
    table has none. Raises TableError for a photo without a camera."""
    each = [_camera(row, cameras) for row in rows]
    size = np.array([camera.pixel_size for camera in each])
    down = np.array([camera.y_down for camera in each])
    signs = np.stack([np.ones(len(rows)), np.where(down, -1.0, 1.0)], axis=1)
    at = np.array([[row.cells["x"], row.cells["y"]] for row in rows])
    at = at - np.array([camera.principal_point for camera in each])
    sigma = np.array([row.cells.get("sigma", np.nan) for row in rows])
    return at * signs * size[:, None], sigma * size


def _camera(row: Row, cameras: Cameras) -> Camera:
    """The camera of a photo. Raises TableError where it has none."""
    name = row.cells["image"]
    if cameras.named:
        return _named(row, cameras)
    camera = cameras.of_photo(name)
    if camera is None:
        photos = ", ".join(cameras.photos)
        expected = (
            f"a photo of {cameras.file}: {photos}"
            if photos
            else f"[camera], or [photo.NAME] for each photo, in {cameras.file}"
        )
        raise row.error("photo", found=repr(name), expected=expected)
    return camera


def _check_focal(
    names: tuple[str, ...], cameras: tuple[Camera, ...], of_photo: dict[int, Row]
) -> None:
    """Raises TableError where the photos of one camera are given with two."""
    first: dict[str, Camera] = {}
    for k, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        if first.setdefault(name, camera) != camera:
            raise of_photo[k].error(
                "camera",
                found=f"{name!r} for photos with different entries in --camera",
                expected=f"one camera by one name, as [camera.{name}] gives it",
            )


def _named(row: Row, cameras: Cameras) -> Camera:
    """The camera that a row names. Raises TableError where there is none."""
    expected = f"a camera of {cameras.file}: {', '.join(cameras.named)}"
    if "camera" not in row.cells:
        raise row.error("camera", found="no such column", expected=expected)
    name = row.cells["camera"]
    if name not in cameras.named:
        raise row.error("camera", found=repr(name), expected=expected)
    return cameras.named[name]


def _block(
    rows: list[Row],
    own: tuple[Camera, ...],
    numbered: Numbered,
    places: Float[np.ndarray, "row 2"],
    sigma: Float[np.ndarray, " row"],
) -> MeasuredBlock:
    """The block of rows with these photo coordinates, and photos with cameras of their
    `own`; sigma is one pixel where the table has none."""
    photos, points, photo, point, _ = numbered
    of_photo = dict(zip(photo.tolist(), rows, strict=True))
    size = np.array([camera.pixel_size for camera in own])
    names = None
    if "camera" in rows[0].cells:
        each = images.cameras_of(rows)
        names = tuple(each[photo] for photo in map(str, photos))
        _check_focal(names, own, of_photo)
    return MeasuredBlock(
        photos=tuple(map(str, photos)),
        points=tuple(map(str, points)),
        photo=photo,
        point=point,
        x=places[:, 0],
        y=places[:, 1],
        sigma=np.where(np.isnan(sigma), size[photo], sigma),
        focal=np.array([camera.focal for camera in own]),
        cameras=names,
    )
