"""What `jaxro calibrate` tests of finished calibrations: whether the zones of an image
differ, and whether two images have the same distortion (--difference)."""

from typing import NamedTuple

import numpy as np

from .. import calibration
from ..calibration import Calibration, Comparison, Known, Model
from ..reports.calibration_model import Photo
from ..reports.calibration_tests import (
    Compared,
    TestedZones,
    find_inside,
    has_zones,
)
from ..tables.fields import TableError
from .calibration_request import Task


class Alone(NamedTuple):
    """An image that was calibrated alone, and the comparison of the models among which
    its own was chosen."""

    photo: Photo
    compared: Comparison


def tested_zones(photos: list[Photo], known: Known) -> dict[str, TestedZones]:
    """The test of each image whose model has zones; none where a focal length is known,
    which would be known of every zone."""
    if np.any(np.isfinite(known.focal_sigma)):
        return {}
    with_zones = [one for one in photos if has_zones(one.found.model)]
    return {one.name: _test(one.found, known) for one in with_zones}


def _test(found: Calibration, known: Known) -> TestedZones:
    tested = calibration.test_zones(found.measured, found.model, known)
    return TestedZones(
        merged=tested.merged.model,
        f=float(tested.f),
        above=int(tested.above),
        below=int(tested.below),
        probability=float(tested.probability),
    )


def compare_distortions(task: Task, images: list[Alone]) -> list[Compared]:
    """The pairs of --difference. Raises TableError for images that do not compare."""
    by_name = {one.photo.name: one for one in images}
    return [_compare(task, by_name[a], by_name[b]) for a, b in task.differences]


def _compare(task: Task, first: Alone, second: Alone) -> Compared:
    """Both images by one model: the parts of a distortion that two models find would
    differ by the models."""
    photos = first.photo, second.photo
    for model in common_models(first.compared, second.compared):
        one, other = (
            calibration.calibrate(photo.found.measured, model, task.known)
            for photo in photos
        )
        usable = [
            bool(f.usable) and int(f.degrees_of_freedom) > 0 for f in (one, other)
        ]
        if all(usable):
            break
    found, inside = None, np.zeros(0, bool)
    if all(usable):
        try:
            found = calibration.difference(one, other, refocused=task.refocused)
        except ValueError as error:
            raise _not_comparable(photos, error) from None
        inside = find_inside((one, other), found.places)
    return Compared(
        first=photos[0].name,
        second=photos[1].name,
        model=model,
        refocused=task.refocused,
        found=found,
        failed=[p.name for p, fine in zip(photos, usable, strict=True) if not fine],
        inside=inside,
        sigma0=(float(one.sigma0), float(other.sigma0)),
        freedom=(int(one.degrees_of_freedom), int(other.degrees_of_freedom)),
        areas=np.stack([photo.figures.area for photo in photos]),
    )


def common_models(first: Comparison, second: Comparison) -> list[Model]:
    """The models by which two images can be compared, the first one first: for each
    number of Brown's coefficients, the largest first, the model with the greatest
    evidence of both images together.

    All coefficients are taken even where the evidence says that fewer are enough: what
    is chosen by the measurements that are tested is, too often, what differs by chance.
    """
    scores = np.asarray(first.figures.score) + np.asarray(second.figures.score)
    best: dict[int, Model] = {}
    for k in np.argsort(scores, kind="stable"):
        best.setdefault(coefficients(first.models[k]), first.models[k])
    return [best[number] for number in sorted(best, reverse=True)]


def coefficients(model: Model) -> int:
    """How many of Brown's coefficients are unknowns."""
    return 0 if model.brown is None else sum(model.brown.free)


def _not_comparable(photos: tuple[Photo, Photo], error: ValueError) -> TableError:
    """What `calibration.difference` says of two images, as an error of the option."""
    said, _, advice = str(error).removeprefix("difference: ").partition("; ")
    names = ",".join(photo.name for photo in photos)
    return TableError(
        "--difference",
        found=f"{names!r}: {said}",
        expected=advice or "two images in one measuring system of one camera",
    )
