"""Places that `jaxro calibrate` corrects: --correct and --pair, and the tables that
`jaxro orient` and `jaxro clean` read."""

from dataclasses import dataclass

import numpy as np

from ..calibration import correct
from ..reports.calibration_model import Done, Photo, distortion
from ..reports.files import csv_text
from ..tables import cameras, images as tables
from ..tables.fields import TableError
from ..tables.images import NamedImages
from ..tables.survey_checks import Row
from .calibration_request import Options, two_images

FEWEST = 5
"""Points in common without which a pair cannot be oriented."""


@dataclass(frozen=True)
class Wanted:
    """Rows to be corrected, and the pairs to be made of them."""

    rows: list[Row]
    pairs: list[tuple[str, str]]


@dataclass(frozen=True)
class Place:
    """A corrected place: x to the right and y up from the principal place, in the unit
    of the image.

    `sx`, `sy`: standard deviations from everything. `sigma`: that of a coordinate
    without the errors of principal place and focal length, which all places of the
    camera share. `inside`: whether it lies among the places that calibrated the image.
    """

    image: str
    point: str
    x: float
    y: float
    sx: float
    sy: float
    sigma: float
    inside: bool


def read_wanted(options: Options, named: NamedImages) -> Wanted | None:
    """What is to be corrected: the rows of --correct, or those that calibrate; None
    where nothing is. Raises TableError."""
    if options.correct is None and not options.pairs:
        return None
    path = options.file if options.correct is None else options.correct
    if path is None:
        raise TableError(
            "--pair", found="it without IMAGE.csv", expected="a table with two images"
        )
    rows = tables.read_places(path)
    if named.is_single and "image" not in rows[0].cells:
        rows = [
            row._replace(cells=row.cells | {"image": named.images[0]}) for row in rows
        ]
    for row in rows:
        if row.cells["image"] not in named.images:
            raise row.error(
                "image",
                found=repr(row.cells["image"]),
                expected=f"an image of {named.file}: {', '.join(named.images)}",
            )
    return Wanted(rows, [_pair(text, rows, named) for text in options.pairs])


def _pair(text: str, rows: list[Row], named: NamedImages) -> tuple[str, str]:
    """LEFT,RIGHT with points in common. Raises TableError."""
    left, right = two_images("--pair", text, named)
    points = [
        {row.cells["point"] for row in rows if row.cells["image"] == side}
        for side in (left, right)
    ]
    common = len(points[0] & points[1])
    if common < FEWEST:
        raise TableError(
            "--pair",
            found=f"{common} points in common of {left!r} and {right!r} in "
            f"{rows[0].file}",
            expected=f"at least {FEWEST} with the same name in both",
        )
    return left, right


def corrected_texts(done: Done, wanted: Wanted) -> tuple[dict[str, str], str]:
    """corrected.csv, and of pairs pairs.csv and cameras.toml; and what to mind of the
    corrected places, if anything."""
    places, focal = _correct(done, wanted.rows)
    header = ("image", "point", "x", "y", "sx", "sy", "sigma", "inside")
    found = [tuple(vars(place).values()) for place in places]
    texts = {"corrected.csv": csv_text([header, *found])}
    pairs = [both for both in wanted.pairs if set(both) <= set(focal)]
    if pairs:
        texts["pairs.csv"] = _pairs(pairs, places)
        texts["cameras.toml"] = _cameras(pairs, focal)
    outside = sum(not place.inside for place in places)
    told = (
        f"{outside} of {len(places)} corrected places lie outside of those that "
        "calibrated their camera: their corrections are extrapolated."
    )
    return texts, told if outside else ""


def _correct(done: Done, rows: list[Row]) -> tuple[list[Place], dict[str, float]]:
    """The corrected places, and the focal length of the ideal camera of each image."""
    places, focal = [], {}
    for one in done.cameras:
        images = [p.name for p in done.photos if p.camera == one.camera]
        own = [row for row in rows if row.cells["image"] in images]
        if not own:
            continue
        at = np.array([[row.cells[axis] for axis in "xy"] for row in own])
        ideal = correct(one.found, at)
        measured = _sigma(done, one, own) ** 2
        total = np.sqrt(np.asarray(ideal.deviations) ** 2 + measured[:, None])
        shared = np.mean(distortion(one.found, at) ** 2, axis=1)
        sigma = np.sqrt(shared + measured)
        focal |= dict.fromkeys(images, float(ideal.focal))
        for k, row in enumerate(own):
            x, y = np.asarray(ideal.places)[k].tolist()
            places.append(
                Place(
                    image=row.cells["image"],
                    point=row.cells["point"],
                    x=x,
                    y=y,
                    sx=float(total[k, 0]),
                    sy=float(total[k, 1]),
                    sigma=float(sigma[k]),
                    inside=bool(ideal.inside[k]),
                )
            )
    return places, focal


def _sigma(done: Done, one: Photo, rows: list[Row]) -> np.ndarray:
    """Standard deviations of measured coordinates: those of the table, in the scale of
    sigma0 if sigma was given there as well, else that of the calibration."""
    sigma0 = float(one.figures.sigma0)
    if "sigma" in rows[0].cells:
        factor = sigma0 if done.sigma_known else 1.0
        return factor * np.array([row.cells["sigma"] for row in rows])
    measured = one.found.measured
    mean = np.sqrt(np.mean(np.asarray(measured.sigma)[np.asarray(measured.mask)] ** 2))
    return np.full(len(rows), sigma0 * mean)


def _pairs(pairs: list[tuple[str, str]], places: list[Place]) -> str:
    """The table of pairs. One sigma serves the four coordinates of a point: the root
    of the mean of their variances."""
    at = {(place.image, place.point): place for place in places}
    rows: list[tuple] = [
        ("pair", "point", "x_left", "y_left", "x_right", "y_right", "sigma")
    ]
    for left, right in pairs:
        for image, point in list(at):
            if image != left or (right, point) not in at:
                continue
            a, b = at[left, point], at[right, point]
            sigma = float(np.sqrt((a.sigma**2 + b.sigma**2) / 2))
            rows.append((f"{left}-{right}", point, a.x, a.y, b.x, b.y, sigma))
    return csv_text(rows)


def _cameras(pairs: list[tuple[str, str]], focal: dict[str, float]) -> str:
    """The focal lengths of the photos of all pairs."""
    return cameras.text_of({name: focal[name] for both in pairs for name in both})
