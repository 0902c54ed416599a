"""The report of an adjusted block on the terminal: internal consistency apart from
accuracy on the ground."""

import numpy as np
from rich.console import Console

from ..adjustment import RESULTS
from ..tables.fields import tell
from .block_files import ANGLES
from .block_model import Done
from .block_sentences import SHOWN, sentences
from .control import AXES, CONTRADICTED, add_rows, in_words, kinds_in_words, show_checks
from .pair import digits, table
from .rows import left_out, most_rows, worst
from .text import escape, number


def show(console: Console, done: Done) -> None:
    """The verdict, what fits, how accurate photos and points are, what to mind."""
    console.print(
        f"[bold]Block of {escape(done.title)}[/bold], {contents_in_words(done)}"
    )
    console.print(verdict(done))
    if done.usable:
        show_consistency(console, done)
        show_accuracy(console, done)
        show_cameras(console, done)
        show_photos(console, done)
        show_control(console, done)
        show_check_points(console, done)
        show_bars(console, done)
    elif done.contradictions and done.oriented.cause is None:
        # what does not fit, so that it can be looked for
        show_cameras(console, done)
        show_control(console, done)
        show_bars(console, done)
    for sentence in sentences(done):
        console.print(f"[yellow]Mind:[/yellow] {escape(sentence)}")


def contents_in_words(done: Done) -> str:
    """What the block consists of, and what is known of the ground."""
    block = done.adjusted.block
    told = kinds_in_words(done.fitting_control.known)
    if number_wrong := len(_wrong_control(done)):
        told += f", {number_wrong} left out as wrong"
    ground = "free network" if done.ground is None else f"control {told}"
    checks = f"; {len(done.checks.names)} check points" if done.ground else ""
    if done.bars is not None:
        checks += f"; {len(done.bars.one)} scale bars"
    return (
        f"{len(block.photos)} photos in {len(done.pairs)} pairs, "
        f"{np.sum(done.determined)} points on {len(block.x)} places; {ground}{checks}"
    )


# -------------------------------------------------------------------------------------
# the verdict


def verdict(done: Done) -> str:
    """Whether the numbers may be used, in one sentence."""
    cause = done.oriented.cause
    if cause is not None and not done.usable:
        return f"[bold red]not usable as given[/bold red]: {escape(cause.sentence)}."
    if done.contradictions:
        told = " ".join(done.contradictions)
        return f"[bold red]not usable[/bold red]: {escape(told)}{CONTRADICTED}"
    if done.adjusted.result != RESULTS.successful:
        return f"[bold red]not usable[/bold red]: {RESULTS[done.adjusted.result]}"
    if not done.usable:
        return (
            "[bold red]not settled[/bold red]: residuals beyond their limit are left "
            "after many rounds of tests; too much of the block is wrong"
        )
    checked = done.ground is None or done.checks_control or bool(done.checks.names)
    colour = "green" if checked else "yellow"
    told = f"[{colour}]{escape(_fits(done))}[/{colour}]"
    if cause is not None:
        return f"[yellow]{escape(cause.sentence)}.[/yellow]\n{told}"
    return told


def _fits(done: Done) -> str:
    """The photos, and the ground if there is any, in one sentence."""
    if done.ground is None:
        return "The photos fit each other; nothing is known of the ground."
    if not done.checks_control:
        text = "The photos fit each other; nothing checks the control"
    else:
        rms = in_words(done.fitting_control, done.unit)
        text = f"The photos fit the control within {rms}"
    if done.checks.names:
        text += f", and the check points within {in_words(done.checks, done.unit)}"
    if not (done.checks_control or done.checks.names):
        return f"{text}."
    return f"{text} (root mean squares)."


def show_consistency(console: Console, done: Done) -> None:
    """sigma0 with its test, and what was left out as wrong."""
    console.print(_consistency(done), markup=False)
    _show_left_out(console, done)


def show_accuracy(console: Console, done: Done) -> None:
    """Standard deviations of the points, and what an error that no test finds does."""
    console.print(_accuracy(done), markup=False)


def show_check_points(console: Console, done: Done) -> None:
    """What check points say of the accuracy."""
    show_checks(console, done.checks, "adjusted", done.unit, done.limit_of_checks)


def _consistency(done: Done) -> str:
    """Internal consistency: sigma0 with its test."""
    adjusted = done.adjusted
    freedom = adjusted.degrees_of_freedom
    if freedom == 0:
        return "Internal consistency: no sigma0, 0 degrees of freedom"
    sigma0 = adjusted.sigma0
    return (
        f"Internal consistency: sigma0 {number(sigma0, digits(sigma0, 2))}, {freedom} "
        f"degrees of freedom, probability beside 1: {done.chance:.2g} ({done.sigma})"
        f"{_components(done)}"
    )


def _components(done: Done) -> str:
    """By which factors each group differs from the stated standard deviations."""
    found = done.oriented.components
    if len(found) < 2:
        return ""
    told = [
        f"{name} {one.factor:.2f} ± {one.deviation:.2f}"
        if np.isfinite(one.deviation)
        else f"{name} not told"
        for name, one in found.items()
    ]
    return f"\nVariance components, times the stated: {', '.join(told)}"


def _show_left_out(console: Console, done: Done) -> None:
    """What was left out as wrong."""
    rays, control, bars = done.left_out, _wrong_control(done), _wrong_bars(done)
    for sentence in bars:
        console.print(
            f"[yellow]Scale bar left out as wrong:[/yellow] {escape(sentence)}"
        )
    if not rays and not control and not bars:
        console.print("Nothing was left out as wrong.")
        return
    if control:
        console.print(
            f"[yellow]Control points left out as wrong:[/yellow] "
            f"{escape(', '.join(_sizes(done)))}"
        )
    if not rays:
        return
    block = done.adjusted.block
    title = (
        f"{len(rays)} of {len(block.x)} places left out as wrong: adjusted minus "
        f"measured [{done.photo_unit}]"
    )
    rows = table("photo", "point", "v x", "v y", "|v|/sd", title=title)
    rows.columns[1].justify = "left"
    for one in rays[: most_rows()]:
        photo = block.photos[block.photo[one.ray]]
        point = block.points[block.point[one.ray]]
        cells = [number(value, 4) for value in one.misfit]
        rows.add_row(escape(photo), escape(point), *cells, number(one.ratio, 1))
    console.print(rows)
    left_out(console, len(rays), "places, the worst ones shown")


def _wrong_control(done: Done) -> list[str]:
    wrong = np.any(done.wrong_control & done.control.known, axis=1)
    return [done.control.names[k] for k in np.flatnonzero(wrong)]


def _sizes(done: Done) -> list[str]:
    """The control points that were left out, each with its largest difference and its
    test."""
    one = done.control
    rows = np.flatnonzero(np.any(done.wrong_control & one.known, axis=1))
    told = []
    for k in rows[:SHOWN]:
        sizes = np.where(one.known[k], np.abs(np.nan_to_num(one.w[k])), -1.0)
        axis = int(np.argmax(sizes))
        off = one.differences[k, axis]
        size = f"{AXES[axis]} {number(off, 3)} {done.unit}, |d|/sd {number(sizes[axis], 1)}"
        told.append(f"{one.names[k]} ({size})" if np.isfinite(off) else one.names[k])
    return told + ["..."] * (len(rows) > SHOWN)


def _wrong_bars(done: Done) -> list[str]:
    """The bars that were left out, each with its difference and its test."""
    bars, wrong = done.bars, done.oriented.wrong.bars
    if bars is None:
        return []
    off, sizes = done.bar_differences[0], np.abs(done.bar_tests)
    return [
        f"{bars.one[k]} to {bars.other[k]}, adjusted minus given "
        f"{number(off[k], 3)} {done.unit}, |d|/sd {number(sizes[k], 1)}"
        for k in np.flatnonzero(wrong)
    ]


def _accuracy(done: Done) -> str:
    """Standard deviations of all points."""
    there = np.flatnonzero(done.determined)
    deviations = done.adjusted.deviations[there]
    rms = [number(a, digits(a, 1)) for a in np.sqrt(np.mean(deviations**2, axis=0))]
    k = int(np.argmax(np.max(deviations, axis=1)))
    most = float(np.max(deviations[k]))
    name = done.adjusted.block.points[there[k]]
    return (
        f"Accuracy: standard deviations of the points X {rms[0]}, Y {rms[1]}, Z "
        f"{rms[2]} {done.unit} (root mean square), the weakest of {tell(name)} with "
        f"{number(most, digits(most, 1))}{_hidden(done)}"
    )


def _hidden(done: Done) -> str:
    """What errors that no test finds would do."""
    checked = done.reliability.rays
    used = np.isfinite(checked.redundancy)
    largest = np.where(np.isfinite(checked.largest), checked.largest, -1.0)
    k = int(np.argmax(largest))
    text = ""
    if largest[k] > 0:
        block = done.adjusted.block
        name = block.points[block.point[k]]
        text = (
            "\nAn error of a place that is found in 80 % of cases moves its point by up "
            f"to {number(largest[k], digits(largest[k], 1))} {done.unit} ({tell(name)})"
        )
    if number_unchecked := int(np.sum(checked.unchecked & used)):
        text += f"; {number_unchecked} coordinates of places are checked by nothing"
    return text


# -------------------------------------------------------------------------------------
# tables


def show_cameras(console: Console, done: Done) -> None:
    """The inner parameters that were unknown."""
    if done.adjusted.inner is None:
        return
    found = done.adjusted.cameras
    rows = table("camera", "parameter", "value", "± sd", title="Inner parameters")
    rows.columns[1].justify = "left"
    values = zip(found.cameras, found.values, found.deviations, strict=True)
    for camera, own, deviations in values:
        for name, value, spread in zip(found.names, own, deviations, strict=True):
            cells = f"{value:.6g}", f"{spread:.2g}"
            rows.add_row(escape(camera), name, *cells)
    if found.names:
        console.print(rows)
    _show_fields(console, done)


def _show_fields(console: Console, done: Done) -> None:
    """The displacement fields of the cameras."""
    field, fields = done.adjusted.field, done.adjusted.fields
    if field is None:
        return
    unit = done.photo_unit
    rows = table(
        "camera", "rms", "largest", "± sd", title=f"Displacement fields [{unit}]"
    )
    for one in fields:
        spread = float(np.sqrt(np.mean(one.deviations**2)))
        places = digits(spread)
        cells = (number(value, places) for value in (one.rms, one.largest, spread))
        rows.add_row(escape(one.camera), *cells)
    console.print(rows)
    console.print(
        f"They change over some {field.length:g} of half the photo, and are about "
        f"{float(field.strength):.2g} standard deviations of a place: by the evidence"
    )


def show_photos(console: Console, done: Done) -> None:
    adjusted = done.adjusted
    centres, of_centres = adjusted.centres, adjusted.centre_deviations
    angles, of_angles = (
        np.degrees(a) for a in (adjusted.angles, adjusted.angle_deviations)
    )
    least = digits(float(np.median(of_centres)), 1), digits(float(np.median(of_angles)))
    heads = [f"{a} ± sd" for a in (*AXES, *ANGLES)]
    title = f"Photos [{done.unit}, °]"
    rows = table("photo", *heads, "places", title=title)
    weak = np.max(of_centres, axis=1)
    for k in worst(list(range(len(weak))), lambda k: -weak[k]):
        values = np.concatenate([centres[k], angles[k]])
        spread = np.concatenate([of_centres[k], of_angles[k]])
        places = [least[0]] * 3 + [least[1]] * 3
        cells = [
            f"{number(value, d)} ± {number(s, d)}"
            for value, s, d in zip(values, spread, places, strict=True)
        ]
        name = escape(adjusted.block.photos[k])
        rows.add_row(name, *cells, str(done.points_of_photos[k]))
    console.print(rows)
    left_out(console, len(weak), "photos, the weakest shown")


def show_control(console: Console, done: Done) -> None:
    if not done.control.names:
        return
    limit = done.tested.limit
    title = (
        f"Control: adjusted minus given [{done.unit}], redundancy r;\n"
        f"largest |w|, limit {number(limit, 2)}"
    )
    heads = ("dX", "dY", "dZ", "r X", "r Y", "r Z", "|w|")
    rows = table("point", *heads, title=title)
    add_rows(rows, done.control, limit, done.control_redundancy)
    console.print(rows)
    left_out(console, len(done.control.names), "points, those with the largest shown")


def show_bars(console: Console, done: Done) -> None:
    bars, found = done.bars, done.adjusted
    if bars is None:
        return
    title = f"Scale bars: adjusted minus given [{done.unit}], redundancy r"
    rows = table("from", "to", "length", "d", "r", "|w|", title=title)
    rows.columns[1].justify = "left"
    sizes = done.bar_tests
    decimals = digits(float(np.median(bars.sigma)), 1)
    every = zip(
        bars.one,
        bars.other,
        bars.length,
        done.bar_differences[0],
        np.nan_to_num(found.bar_redundancy),
        sizes,
        strict=True,
    )
    for one, other, length, residual, redundancy, w in every:
        cells = number(length, decimals), number(residual, decimals + 1)
        tests = number(redundancy, 2), number(abs(w), 2)
        rows.add_row(escape(one), escape(other), *cells, *tests)
    console.print(rows)
