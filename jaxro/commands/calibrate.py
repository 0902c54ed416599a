"""One call of `jaxro calibrate` from its options to its report and files."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from .. import calibration
from ..calibration import Calibration, MeasuredImage, Model
from ..calibration.distances import DistanceAdjustment, adjust_distances
from ..calibration.measured_images import FEWEST, find_unreached
from ..calibration.of_image import of_image
from ..calibration.starts import NEARLY_FLAT
from ..plots import map_corrections
from ..reports import calibration as report
from ..reports.calibration_files import contents, summary
from ..reports.calibration_model import (
    Distances,
    Done,
    ObjectPoints,
    Photo,
    Variant,
    photo,
    variants,
    zone_names,
)
from ..reports.html.calibration import page_of_calibration
from ..reports.terminal import consoles, progress, say_what, warn
from ..tables import whole
from ..tables.examples import calibration as example
from ..tables.fields import TableError
from ..tables.images import NamedImages
from ..xla.programs import compiled
from .calibration_columns import MISFIT, find_cause
from .calibration_request import Options, Task, prepare
from .calibration_tests import Alone, compare_distortions, tested_zones
from .cameras_out import opencv_text
from .corrected import Wanted, corrected_texts, read_wanted
from .documents import settings, show_json
from .plots import pictures_of_calibration

LEAST_ROOM = 32
"""Points for which the program of a single image is compiled at least; further ones
double it, so that images of different lengths share their programs."""

SUPPORT = 4
"""Points that a focal length of a zone needs."""

CONTRADICTED = 10.0
"""Ratio of sigma0 to the standard deviations given that is no error of measurement."""

FEW_CHECKS = 3
"""Degrees of freedom from which on sigma0 is not so large by chance."""

MIRRORED = 2.0
"""How many times larger sigma0 is with the wrong direction of y, at least."""


def run(options: Options) -> bool:
    """Read, calibrate, show, write. True if every image has usable numbers. Raises
    TableError, with nothing written."""
    console, errors = consoles()
    inputs, texts, warnings = whole.Inputs(*options.read), {}, []
    out, force = (options.out, whole.check_target), options.force
    with options.documents.claimed(out, force=force, read=options.read):
        task = prepare(options)
        asked = read_wanted(options, task.named)
        with progress(errors, "Calibrating", len(task.named.images)) as told:
            done = calibrate(options, task, told)
        if options.out is not None:
            with say_what("Correcting ..."):
                texts, warnings = write_texts(done, asked)
            inputs.check()
            whole.write(options.out, texts, options.read)
        written = write_documents(done, options)
    if options.documents.json:
        show_json(summary(done))
        return done.usable
    report.show(console, done)
    for warning in warnings:
        warn(errors, warning)
    if texts:
        console.print(f"Written to {options.out}: {', '.join(texts)}", markup=False)
    console.print(written, end="", markup=False)
    if options.file is None:
        console.print(
            "This was a simulated example. Your own image: jaxro calibrate IMAGE.csv "
            "--object POINTS.csv",
            markup=False,
        )
    return done.usable


def write_documents(done: Done, options: Options) -> str:
    """Make the report and the pictures that are asked for; a line for each."""
    if not options.documents:
        return ""
    done = with_maps(done)
    told = settings(options, options.read)
    return options.documents.write(
        page=lambda: page_of_calibration(done, told),
        pictures=lambda: pictures_of_calibration(done),
        read=options.read,
    )


def with_maps(done: Done) -> Done:
    """The calibration with a map of the corrections of each camera."""
    maps = {one.camera: map_corrections(one.found) for one in done.cameras}
    return replace(done, maps=maps)


def write_texts(
    done: Done, asked: Wanted | None
) -> tuple[dict[str, str | bytes], list[str]]:
    """The files by name, and what to warn of."""
    done = with_maps(done)
    texts: dict[str, str | bytes] = {**contents(done), **opencv_text(done)}
    warnings = []
    if asked is not None:
        of_places, told = corrected_texts(done, asked)
        texts |= of_places
        warnings += [told] if told else []
    try:
        texts |= pictures_of_calibration(done)
    except ModuleNotFoundError:
        warnings.append("no pictures: they need matplotlib: pip install 'jaxro[plots]'")
    return texts, warnings


# -------------------------------------------------------------------------------------
# the calibration


def calibrate(options: Options, task: Task, told: Callable[..., None]) -> Done:
    """Calibrate every image alone, or all together. Raises TableError."""
    named = task.named
    common = {
        "title": task.title,
        "unit": options.unit if options.file is not None else example.UNIT,
        "sigma_known": task.sigma_known,
        "named": named,
        "together": task.together,
        "known_has_deviations": any((options.principal_sigma, options.focal_sigma)),
    }
    if task.together:
        photos, compared, points = calibrate_several(options, task)
        few = len(task.models) > 1 and not compared
        done = Done(
            photos=photos,
            variants=compared,
            points=points,
            chosen=bool(compared),
            few=tuple(named.images) if few else (),
            **common,
        )
    elif options.distances:
        one, told_by = calibrate_by_distances(options, task)
        done = Done(
            photos=[one], variants={}, chosen=False, distances=told_by, **common
        )
    else:
        images, compared = [], {}
        for image, name in enumerate(named.images):
            one, rows = calibrate_alone(options, task, image)
            images.append(one)
            compared[name] = rows
            told(image + 1)
        with say_what("Comparing distortions ..."):
            differences = compare_distortions(task, images)
        few = [not rows[1:] and len(task.models) > 1 for rows in compared.values()]
        done = Done(
            photos=[one.photo for one in images],
            variants=compared,
            chosen=len(task.models) > 1 and not all(few),
            few=tuple(
                name for name, is_few in zip(compared, few, strict=True) if is_few
            ),
            differences=differences,
            **common,
        )
    check_columns(options, task, done)
    check_support(done)
    zones = {} if task.together else tested_zones(done.photos, task.known)
    return replace(done, zones=zones)


def calibrate_alone(
    options: Options, task: Task, image: int
) -> tuple[Alone, list[Variant]]:
    """One image by the model that it needs."""
    rows = task.named.rows_of(image)
    measured = one_image(task, rows, options.y_down, room=_room(task.named))
    check_direction(options, task, measured)
    models = task.limit_choice(rows)
    with say_what("Comparing models ..."):
        found, compared = calibration.choose(measured, models, task.known)
    sigma = float(np.sqrt(np.mean(task.sigma[rows] ** 2)))
    one = Alone(_photo(task, image, found), compared)
    return one, variants(compared, sigma)


def _photo(task: Task, image: int, found: Calibration) -> Photo:
    far_off = float(found.sigma0) > CONTRADICTED
    checked = int(found.degrees_of_freedom) >= FEW_CHECKS
    # what looks weak by residuals of this size may be determined well
    weak = found.result == calibration.RESULTS.weakly_determined
    ended = bool(found.usable) or bool(weak)
    if task.sigma_known and far_off and checked and ended:
        found = replace(found, result=calibration.RESULTS.contradicted)
    named, rows = task.named, task.named.rows_of(image)
    name = named.images[image]
    camera = name if not task.together else named.cameras[named.camera[image]]
    own = rows if task.together else np.arange(len(rows))
    return photo(name, camera, found, named.names_of(rows), own)


def one_image(
    task: Task, rows: np.ndarray, y_down: bool | None, room: int = 0
) -> MeasuredImage:
    """The places of these rows with their object points, and masked ones up to the
    number `room`."""
    named = task.named
    at = named.point[rows]
    missing = max(room - len(rows), 0)
    longer = lambda a: np.pad(a, [(0, missing)] + [(0, 0)] * (a.ndim - 1))
    return calibration.image(
        longer(named.places[rows, 0]),
        longer(named.places[rows, 1]),
        longer(named.coordinates[at]),
        sigma=longer(task.sigma[rows]),
        point_sigma=longer(named.deviations[at]),
        mask=np.arange(len(rows) + missing) < len(rows),
        y_down=y_down,
    )


def _room(named: NamedImages) -> int:
    """A number of points that is enough for every image."""
    room = LEAST_ROOM
    while room < np.max(np.bincount(named.image)):
        room *= 2
    return room


def calibrate_several(
    options: Options, task: Task
) -> tuple[list[Photo], dict[str, list[Variant]], ObjectPoints]:
    """All images at once."""
    named = task.named
    y_down = options.y_down
    if (solid := _most_solid(task)) is not None:
        check_direction(options, task, solid)
        y_down = _y_down(task, solid) if y_down is None else y_down
    check_reached(named)
    measured = calibration.images(
        *named.places.T,
        named.image,
        named.point,
        named.coordinates,
        point_sigma=np.where(np.isnan(named.deviations), 0.0, named.deviations),
        sigma=task.sigma,
        camera=named.camera,
        y_down=True if y_down is None else y_down,
    )
    models = task.limit_choice(np.arange(len(named.image)))
    model, *others = models
    with say_what("Calibrating all images together ..."):
        if others:
            found, compared = calibration.choose_together(measured, models, task.known)
            mean = float(np.sqrt(np.mean(task.sigma**2)))
            tried = {"all images": variants(compared, mean)}
        else:
            found = calibration.calibrate_together(measured, model, task.known)
            tried = {}
    one = compiled(of_image)
    photos = [_photo(task, k, one(found, k)) for k in range(len(named.images))]
    fixed = named.deviations == 0
    points = ObjectPoints(
        names=named.points,
        coordinates=np.asarray(found.points),
        deviations=np.where(fixed, 0.0, found.point_deviations),
        known=named.known,
        rays=np.bincount(named.point, minlength=len(named.points)),
    )
    return photos, tried, points


def check_reached(named: NamedImages) -> None:
    """Raises TableError for images that nothing joins to the known points."""
    few, seen = find_unreached(named.image, named.point, named.known, len(named.images))
    if few.size:
        raise TableError(
            named.file,
            found=f"too few points: image {named.images[few[0]]!r} has {seen[0]} that "
            f"are known or seen in two images with {FEWEST} of them (images like it: "
            f"{few.size})",
            expected=f"at least {FEWEST}: known points in more images, or more points "
            "that images share",
        )


def calibrate_by_distances(options: Options, task: Task) -> tuple[Photo, Distances]:
    """One image by the distances between its points, and by its coordinates, which is
    where they begin."""
    measured = one_image(task, task.named.rows_of(0), options.y_down)
    check_direction(options, task, measured)
    found: DistanceAdjustment
    with say_what("Adjusting distances ..."):
        found = adjust_distances(measured, task.models[0])
    one = _photo(task, 0, found.coordinates)
    variances = np.diagonal(np.asarray(found.cofactor))[-found.focal.size :]
    size = float(found.coordinates.frame.size)
    return one, Distances(
        centre=np.asarray(found.centre),
        centre_deviations=np.asarray(found.centre_deviations),
        focal=np.asarray(found.focal) * size,
        focal_deviations=float(found.sigma0) * np.sqrt(variances) * size,
        sigma0=float(found.sigma0),
        degrees_of_freedom=found.degrees_of_freedom,
    )


# -------------------------------------------------------------------------------------
# what is wrong with the input, and seen in its result only


def check_direction(options: Options, task: Task, measured: MeasuredImage) -> None:
    """Raises TableError where points off a plane say that y points the other way."""
    if options.y_down is None or _is_flat(measured):
        return
    told = _y_down(task, measured)
    if told is None or told == options.y_down:
        return
    given, other = ("--y-down", "--y-up")[:: 1 if options.y_down else -1]
    sigma0 = [
        float(_plain(task, replace_direction(measured, y_down)).sigma0)
        for y_down in (options.y_down, told)
    ]
    if not sigma0[0] > MIRRORED * sigma0[1]:
        return
    raise TableError(
        given,
        found=f"an image that is mirrored then (one focal length: sigma0 "
        f"{sigma0[0]:.3g}, with {other} {sigma0[1]:.3g})",
        expected=f"{other}, or neither of them: the points tell it; or X and Y of the "
        "object points are exchanged",
    )


def _y_down(task: Task, measured: MeasuredImage) -> bool | None:
    """Whether the points say that y points down; None where they do not tell it."""
    found = _plain(task, replace_direction(measured, None))
    return bool(found.frame.handedness > 0) if bool(found.usable) else None


def replace_direction(measured: MeasuredImage, y_down: bool | None) -> MeasuredImage:
    """The image with this direction of y."""
    hand = 0.0 if y_down is None else 1.0 if y_down else -1.0
    return replace(measured, handedness=jnp.asarray(hand))


def _plain(task: Task, measured: MeasuredImage) -> Calibration:
    """The image with one focal length."""
    one = Model(rays=task.models[0].rays)
    return calibration.calibrate(measured, one, task.known)


def _is_flat(measured: MeasuredImage) -> bool:
    """Whether the points lie near a plane, which does not tell the direction of y."""
    points = np.asarray(measured.points)[np.asarray(measured.mask)]
    spread = np.linalg.svd(points - np.mean(points, axis=0), compute_uv=False)
    return bool(spread[-1] <= NEARLY_FLAT * np.linalg.norm(spread))


def _most_solid(task: Task) -> MeasuredImage | None:
    """The image with the most known points, if these tell the direction of y."""
    named = task.named
    known = named.known[named.point]
    counts = np.bincount(named.image[known], minlength=len(named.images))
    image = int(np.argmax(counts))
    if counts[image] < 2 * SUPPORT:
        return None
    rows = np.flatnonzero(known & (named.image == image))
    measured = one_image(task, rows, None, room=_room(named))
    return None if _is_flat(measured) else measured


def check_columns(options: Options, task: Task, done: Done) -> None:
    """Raises TableError where a whole column of the object points explains why an image
    does not fit."""
    rows = list(done.variants.values()) or [[]]
    for image, one in enumerate(done.photos):
        tried = rows[min(image, len(rows) - 1)]
        simplest = min(tried, key=lambda v: v.unknowns, default=None)
        plain = 0.0 if simplest is None else simplest.sigma0
        far = plain > MISFIT * float(one.found.focal[0])
        if bool(one.found.usable) and not far:
            continue
        named = task.named
        own = named.rows_of(image)
        known = own[named.known[named.point[own]]]
        if len(known) < FEWEST:
            continue
        measured = one_image(task, known, None, room=_room(named))
        with say_what("Looking for wrong columns of the object points ..."):
            cause = find_cause(measured, task.models[0].rays, task.known)
        if cause is not None:
            raise TableError(
                options.object or named.file,
                found=f"object points that image {one.name!r} contradicts",
                expected=f"other ones. {cause.sentence}",
            )


def check_support(done: Done) -> None:
    """Raises TableError where a focal length of a zone has too few points."""
    for one in done.photos:
        model: Model = one.found.model
        if model.focals <= (1 if model.y is None else 2):
            continue
        counts: Sequence[int] = one.figures.in_zones.tolist()
        few = [k for k, count in enumerate(counts) if count < SUPPORT]
        if few:
            axis, number = zone_names(model)[few[0]]
            raise TableError(
                "--zones-y" if axis == "fy" else "--zones",
                found=f"{counts[few[0]]} points for {axis} of zone {number} in "
                f"{one.name!r}",
                expected=f"at least {SUPPORT} points in each zone; choose fewer zones",
            )
