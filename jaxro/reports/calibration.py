"""The report of a calibration on the terminal."""

import math

import numpy as np
from rich.console import Console
from rich.table import Table

from ..calibration.results import RESULTS
from .calibration_model import (
    BROWN,
    Done,
    Photo,
    describe,
    lens_names,
    zone_names,
)
from .calibration_test_words import difference_in_words, zones_in_words
from .calibration_words import (
    accuracy,
    advice,
    decision,
    sentences,
)
from .pair import digits, join_names, table
from .rows import left_out, some_rows, worst
from .text import escape, number, say

AXES = ("X", "Y", "Z")
ANGLES = ("omega", "phi", "kappa")

LARGEST = 8
"""Residuals that a terminal shows."""

SHOWN = 10
"""Names of images that are shown in a line."""

TRIED = 12
"""Variants that a terminal shows."""


def show(console: Console, done: Done) -> None:
    """What was decided, station, camera, residuals, the variants, and what to mind."""
    console.print(
        f"[bold]Calibration of {escape(done.title)}[/bold], {contents_in_words(done)}"
    )
    show_verdict(console, done)
    show_tests(console, done)
    if done.cameras:
        show_stations(console, done)
        show_cameras(console, done)
        show_points(console, done)
    show_distances(console, done)
    show_residuals(console, done)
    show_variants(console, done)
    for sentence in sentences(done):
        console.print(f"[yellow]Mind:[/yellow] {escape(sentence)}")


def contents_in_words(done: Done) -> str:
    """What is calibrated."""
    images = len(done.photos)
    how = ""
    if images > 1:
        cameras = len({one.camera for one in done.photos})
        how = f", {images} images"
        how += (
            f" together, {cameras} camera{'s' * (cameras > 1)}"
            if done.together
            else ", each alone"
        )
    return f"{len(done.named.image)} places of {len(done.named.points)} points{how}"


# -------------------------------------------------------------------------------------
# the verdict


def show_verdict(console: Console, done: Done) -> None:
    """What the images need, and how well it fits; why there is nothing."""
    if len(done.photos) == 1:
        _verdict(console, done, done.photos[0])
    else:
        _verdict_of_many(console, done)


def _verdict(console: Console, done: Done, one: Photo) -> None:
    if not one.usable:
        console.print(f"[bold red]{one.result}[/bold red]: {advice(one)}")
        return
    if one.result != "successful":
        console.print(f"[yellow]{one.result}[/yellow]: {RESULTS[one.found.result]}")
    console.print(f"[green]{decision(done, one)}[/green]")
    console.print(accuracy(done, one), markup=False)


def _verdict_of_many(console: Console, done: Done) -> None:
    failed = [one for one in done.photos if not one.usable]
    if done.together and failed:
        console.print(f"[bold red]{failed[0].result}[/bold red]: {advice(failed[0])}")
        return
    for result in dict.fromkeys(one.result for one in failed):
        alike = [one for one in failed if one.result == result]
        names = escape(join_names([one.name for one in alike], SHOWN))
        console.print(f"[bold red]{names}: {result}[/bold red]: {advice(alike[0])}")
    if done.together:
        console.print(f"[green]{decision(done, done.photos[0])}[/green]")
        console.print(accuracy(done, done.photos[0]), markup=False)
        return
    for one in done.photos:
        if one.usable:
            console.print(
                f"[green]{escape(one.name)}: {decision(done, one)}[/green] "
                + escape(accuracy(done, one))
            )


def show_tests(console: Console, done: Done) -> None:
    """Whether zones differ, and distortions."""
    usable = [one for one in done.photos if one.usable]
    for one in usable[:1] if done.together else usable:
        if said := zones_in_words(done, one):
            of = f"{one.name}: " if len(done.photos) > 1 and not done.together else ""
            say(console, f"{of}{said}")
    for both in done.differences:
        verdict, *rest = difference_in_words(done, both)
        console.print(f"[green]{escape(verdict)}[/green]")
        for text in rest:
            say(console, text)


# -------------------------------------------------------------------------------------
# tables


def show_stations(console: Console, done: Done) -> None:
    """Station and angles of each image; of one image a line for each number."""
    shown = [one for one in done.photos if one.usable]
    if len(done.photos) == 1:
        console.print(_station(shown[0]))
        return
    kept = worst(shown, lambda one: -float(np.max(one.figures.centre_deviations)))
    for names, part, title in (
        (AXES, slice(0, 3), "Stations in the unit of the object"),
        (ANGLES, slice(3, 6), "Angles in degrees, object to photo"),
    ):
        heads = [head for name in names for head in (name, "±")]
        rows = table("image", *heads, title=title)
        for one in kept:
            values, deviations = _numbers_of_station(one)
            rows.add_row(escape(one.name), *_cells(values[part], deviations[part]))
        console.print(rows)
    left_out(console, len(shown), "images, those with the weakest stations shown")


def _station(one: Photo) -> Table:
    rows = table("station", "value", "± sd", "unit")
    columns = (*AXES, *ANGLES), *_numbers_of_station(one)
    for name, value, deviation in zip(*columns, strict=True):
        unit = "°" if name in ANGLES else "unit of the object"
        rows.add_row(name, *_number_and_deviation(value, deviation), unit)
    return rows


def _numbers_of_station(one: Photo) -> tuple[np.ndarray, np.ndarray]:
    """Station and angles (degrees), and their standard deviations."""
    figures = one.figures
    values = np.concatenate([figures.centre, np.degrees(figures.angles)])
    angles = np.degrees(figures.angle_deviations)
    return values, np.concatenate([figures.centre_deviations, angles])


def _cells(values: np.ndarray, deviations: np.ndarray) -> list[str]:
    cells = []
    for value, deviation in zip(values, deviations, strict=True):
        decimals = digits(deviation, 1)
        cells += [number(value, decimals), number(deviation, decimals)]
    return cells


def show_cameras(console: Console, done: Done) -> None:
    """The inner orientation of each camera."""
    rows = table("camera", "parameter", "value", "± sd", title=_camera_title(done))
    rows.columns[1].justify = "left"
    shown = done.cameras
    for one in worst(shown, lambda one: -float(np.max(one.figures.focal_deviations))):
        name = escape(one.camera)
        for parameter, value, deviation in parameters(one):
            rows.add_row(name, parameter, *_number_and_deviation(value, deviation))
            name = ""
    console.print(rows)
    left_out(console, len(shown), "cameras, those with the weakest focal length shown")


def _camera_title(done: Done) -> str:
    lens = any(one.found.model.brown is not None for one in done.cameras)
    powers = f"; of Brown's lens per power of {done.unit}" if lens else ""
    return f"Principal place and focal lengths, {done.unit}{powers}"


def parameters(one: Photo) -> list[tuple[str, float, float]]:
    """The parameters of a camera: name, value, standard deviation."""
    figures, model = one.figures, one.found.model
    found: list[tuple[str, float, float]] = []
    for k, name in enumerate(("x0", "y0")):
        deviation = float(figures.principal_deviations[k])
        found.append((name, float(figures.principal[k]), deviation))
    zones = zone_names(model)
    for (axis, zone), value, deviation in zip(
        zones, figures.focal, figures.focal_deviations, strict=True
    ):
        alone = sum(axis == other for other, _ in zones) == 1
        name = axis if alone else f"{axis} {zone}"
        found.append((name, float(value), float(deviation)))
    for k, name in enumerate(BROWN):
        if name in lens_names(model):
            deviation = float(figures.brown_deviations[k])
            found.append((name, float(figures.brown[k]), deviation))
    return found


def _number_and_deviation(value: float, deviation: float) -> tuple[str, str]:
    """Both with two digits of the deviation, in powers of ten where they are small."""
    if 0 < deviation < 1e-4:
        places = max(0, math.floor(math.log10(max(abs(value), deviation) / deviation)))
        return f"{value:.{places + 1}e}", f"{deviation:.1e}"
    decimals = digits(deviation, 1)
    given = "given" if deviation == 0 else number(deviation, decimals)
    return number(value, decimals), given


def show_points(console: Console, done: Done) -> None:
    """How well the unknown object points are determined."""
    points = done.points
    if points is None or np.all(points.known):
        return
    free = np.flatnonzero(~points.known)
    deviations = points.deviations[free]
    rms = [number(a, digits(a)) for a in np.sqrt(np.mean(deviations**2, axis=0))]
    weakest = points.names[free[int(np.argmax(np.max(deviations, axis=1)))]]
    most = float(np.max(deviations))
    say(
        console,
        f"{free.size} unknown points: standard deviations X {rms[0]}, Y {rms[1]}, "
        f"Z {rms[2]} (root mean square), the weakest of {weakest} with "
        f"{number(most, digits(most))}",
    )


def show_distances(console: Console, done: Done) -> None:
    """The results by distances beside those by coordinates, where they are asked for."""
    found = done.distances
    if found is None:
        return
    one = done.photos[0].figures
    rows = table(
        "parameter",
        *("by distances", "± sd", "by coordinates", "± sd"),
        title="All distances with their full cofactor matrix, beside coordinates",
    )
    names = [
        "X",
        "Y",
        "Z",
        *(f"{a} {z}" for a, z in zone_names(done.photos[0].found.model)),
    ]
    columns = (
        (found.centre, found.focal),
        (found.centre_deviations, found.focal_deviations),
        (one.centre, one.focal),
        (one.centre_deviations, one.focal_deviations),
    )
    joined = [np.concatenate(parts) for parts in columns]
    for k, name in enumerate(names):
        value, deviation, other, own = (float(column[k]) for column in joined)
        cells = [*_number_and_deviation(value, deviation)]
        rows.add_row(name, *cells, *_number_and_deviation(other, own))
    console.print(rows)
    freedom = found.degrees_of_freedom
    console.print(
        f"By distances: sigma0 {number(found.sigma0, digits(found.sigma0, 2))}, "
        f"{freedom} degrees of freedom"
    )


def show_residuals(console: Console, done: Done) -> None:
    """The coordinates with the largest residuals over their standard deviations."""
    photos = [one for one in done.photos if one.usable]
    if not photos or not done.cameras:
        return
    several = len(photos) > 1
    entries = []
    for one in photos:
        w = np.abs(done.w(one))
        entries += [(one, k, float(np.max(w[k]))) for k in range(len(w))]
    shown = sorted(entries, key=lambda entry: -entry[2])[: some_rows(LARGEST)]
    w = "|w|" if done.sigma_known else "tau"
    limits = ", ".join({number(done.limit(one), 2) for one in photos[:1]})
    title = f"Largest residuals [{done.unit}], redundancy r, {w} (limit {limits})"
    heads = ("vx", "vy", "rx", "ry", w)
    rows = table("image, point" if several else "point", *heads, title=title)
    decimals = digits(_typical(photos), 1)
    for one, k, size in shown:
        name = f"{one.name}, {one.names[k]}" if several else one.names[k]
        rows.add_row(
            escape(name),
            *(number(v, decimals) for v in one.residuals[k]),
            *(number(r, 2) for r in one.redundancy[k]),
            number(size, 2),
            style="yellow" if size > done.limit(one) else None,
        )
    console.print(rows)


def _typical(photos: list[Photo]) -> float:
    """The root mean square of residuals."""
    every = np.concatenate([one.residuals.ravel() for one in photos])
    return float(np.sqrt(np.mean(every**2)))


def show_variants(console: Console, done: Done) -> None:
    """The models compared: the best ones, and the best without a field and a lens."""
    if len(done.variants) != 1:
        return
    (rows,) = done.variants.values()
    if len(rows) < 2:
        return
    shown = rows[: some_rows(TRIED)]
    plain = [v for v in rows if v.model.field is None]
    shown += [v for v in plain[:2] + plain[-2:] if all(v is not w for w in shown)]
    shown = [row for row in rows if any(row is one for one in shown)]
    title = (
        f"Models compared: error of coordinates left out [{done.unit}], -2 log evidence "
        "behind the best"
    )
    found = table("model", "unknowns", "sigma0", "left out", "behind", title=title)
    for variant in shown:
        found.add_row(
            escape(describe(variant.model)),
            number(variant.unknowns, 1),
            number(variant.sigma0, digits(variant.sigma0, 2)),
            number(variant.left_out, digits(variant.left_out, 2)),
            number(variant.behind, 1) if math.isfinite(variant.behind) else "failed",
        )
    console.print(found)
    if len(shown) < len(rows):
        console.print(f"{len(shown)} of {len(rows)} models; --out DIR writes all.")
