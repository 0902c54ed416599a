"""The report of an absolute orientation on the terminal."""

import numpy as np
from rich.console import Console

from ..adjustment import critical_values as critical
from ..block.absolute_result import NAMES
from ..block.absolute_verdict import RESULTS, advice_of
from .absolute_files import Done
from .control import AXES, CONTRADICTED, add_rows, in_words, kinds_in_words, show_checks
from .pair import digits, join_names, table
from .reliability import DOUBTFUL
from .rows import left_out
from .text import escape, number, say

POORLY = 0.1
"""Redundancy below which a control coordinate is said to be poorly checked."""

SHOWN = 10
"""Names that a sentence tells of a longer list."""


def show(console: Console, done: Done) -> None:
    """The verdict, the elements, control and check points, and what to mind."""
    _head(console, done)
    console.print(_verdict(done))
    if done.usable:
        say(console, accuracy(done))
        _elements(console, done)
        _control(console, done)
        show_checks(console, done.checks, "model", done.unit, done.limit_of_checks)
        _points(console, done)
    for sentence in sentences(done):
        console.print(f"[yellow]Mind:[/yellow] {escape(sentence)}")


def _head(console: Console, done: Done) -> None:
    told = kinds_in_words(done.control.known)
    named = "" if done.title == done.model.pair else f" ({escape(done.model.pair)})"
    console.print(
        f"[bold]Absolute orientation of {escape(done.title)}[/bold]{named}, "
        f"{len(done.model.names)} points; control {told}; "
        f"{len(done.checks.names)} check points"
    )


# -------------------------------------------------------------------------------------
# the verdict


def _verdict(done: Done) -> str:
    """What came of it, in one sentence or two."""
    if done.cause is not None:
        return (
            f"[bold red]not usable as given[/bold red]: {escape(done.cause.sentence)}."
        )
    if done.contradiction and done.suspects:
        return f"[bold red]not usable[/bold red]: {escape(_of_suspects(done)[0])}"
    if done.contradiction:
        return f"[bold red]not usable[/bold red]: {escape(done.contradiction)}{CONTRADICTED}"
    if not done.usable:
        return f"[bold red]{done.result}[/bold red]: {advice(done)}"
    if done.freedom == 0 and not done.checks.names:
        text = (
            "[yellow]The control determines the model, and nothing checks it.[/yellow]"
        )
    else:
        text = f"[green]{_fits(done)}[/green]"
    if done.result != "successful":
        text += f"\n[yellow]{done.result}[/yellow]: {RESULTS[done.first.result]}"
    if done.result == "two_solutions":
        text += " The other one is taken with --second."
    return text


def advice(done: Done) -> str:
    """What to do about control that is not enough, or not suitable."""
    return advice_of(done.first.result, np.asarray(done.first.missing))


def _fits(done: Done) -> str:
    text = f"The model fits its control within {in_words(done.control, done.unit)}"
    if done.checks.names:
        text += f", and the check points within {in_words(done.checks, done.unit)}"
    return f"{text} (root mean squares)."


def accuracy(done: Done) -> str:
    """sigma0 with its unit, and its test where all standard deviations are given."""
    freedom = done.freedom
    if freedom == 0:
        return "no sigma0, 0 degrees of freedom"
    sigma0 = float(done.first.sigma0)
    unit = f" {done.unit}" if done.unit_weights else ""
    text = f"sigma0 {number(sigma0, digits(sigma0, 2))}{unit}, {freedom} degree"
    text += f"{'s' * (freedom != 1)} of freedom"
    if done.sigma_known:
        text += f", probability beside 1: {chance(done):.2g}"
    return text


def chance(done: Done) -> float:
    """The probability of a sigma0 that is farther from 1."""
    squares = done.freedom * float(done.first.sigma0) ** 2
    return float(critical.global_p(squares, done.freedom))


# -------------------------------------------------------------------------------------
# tables


def _elements(console: Console, done: Done) -> None:
    """The seven elements; of two solutions both."""
    several = len(done.found) > 1
    heads = ("value", "± sd", *(("other solution",) if several else ()), "unit")
    rows = table("element", *heads, title="Rotation from ground to model axes")
    values, deviations = done.elements(done.first)
    others = done.elements(done.found[-1])[0]
    of_model = {"": "unit of the model", "bases": "base"}
    lengths = f"{done.unit} per {of_model.get(done.model.unit, done.model.unit)}"
    units = (lengths, "°", "°", "°", *[done.unit] * 3)
    for k, name in enumerate(NAMES):
        decimals = digits(deviations[k], 1)
        cells = [number(values[k], decimals), number(deviations[k], decimals)]
        cells += [number(others[k], decimals)] if several else []
        rows.add_row(name, *cells, escape(units[k]))
    console.print(rows)


def _control(console: Console, done: Done) -> None:
    w = "|w|" if done.sigma_known else "tau"
    title = (
        f"Control: model minus given [{done.unit}], redundancy r;\n"
        f"largest {w}, limit {number(done.limit, 2)}"
    )
    rows = table("point", "vX", "vY", "vZ", "rX", "rY", "rZ", w, title=title)
    add_rows(rows, done.control, done.limit, done.redundancy)
    console.print(rows)
    left_out(console, len(done.control.names), "points, those with the largest shown")


def _points(console: Console, done: Done) -> None:
    """How accurate the points are."""
    deviations = done.point_deviations
    if not np.all(np.isfinite(deviations)):
        return
    rms = [number(a, digits(a, 1)) for a in np.sqrt(np.mean(deviations**2, axis=0))]
    k = int(np.argmax(np.max(deviations, axis=1)))
    most = float(np.max(deviations[k]))
    say(
        console,
        f"{len(done.model.names)} points: standard deviations X {rms[0]}, Y {rms[1]}, Z "
        f"{rms[2]} {done.unit} (root mean square), the weakest of {done.model.names[k]} "
        f"with {number(most, digits(most, 1))}",
    )


# -------------------------------------------------------------------------------------
# what to mind


def sentences(done: Done) -> list[str]:
    """What a careful user should know of the result."""
    # what the verdict says is not said twice
    said = [] if done.contradiction else _of_suspects(done)
    if done.usable:
        said += (
            _of_fit(done) + _of_control(done) + _of_checks(done) + _of_position(done)
        )
    if done.strange:
        names = join_names(done.strange, SHOWN)
        said.append(f"The model has not got these points of the ground: {names}.")
    if done.approximate:
        said.append(
            f"{done.approximate} approximate points are not used: no approximate values "
            "are needed."
        )
    return said


def _of_suspects(done: Done) -> list[str]:
    if not done.suspects:
        return []
    before, after = float(done.first.sigma0), done.sigma0_without
    digit = digits(after, 2)
    fall = f"sigma0 {number(before, digit)} to {number(after, digit)}"
    if len(done.suspects) == 1:
        return [
            f"Without control point {done.suspects[0]} the others fit far better "
            f"({fall}): it is wrong on the ground or in the model, or has the name of "
            "another point."
        ]
    return [
        f"Without control points {' and '.join(done.suspects)} the others fit far better "
        f"({fall}): they are wrong, or each has the name of the other."
    ]


def _of_fit(done: Done) -> list[str]:
    if not (done.sigma_known and done.freedom > 0) or chance(done) >= DOUBTFUL:
        return []
    sigma0 = float(done.first.sigma0)
    if sigma0 > 1:
        return [
            f"The residuals are {sigma0:.1f} times as large as the standard deviations "
            f"say (probability {chance(done):.1g}): these are too small, or points are "
            "wrong."
        ]
    return [
        f"The residuals are {1 / sigma0:.1f} times smaller than the standard deviations "
        f"say (probability {chance(done):.1g}): these are too large."
    ]


def _of_control(done: Done) -> list[str]:
    said = []
    sizes, limit = np.abs(done.control.w), done.limit
    k, axis = np.unravel_index(int(np.argmax(sizes)), sizes.shape)
    if sizes[k, axis] > limit and not done.suspects:
        others = int(np.sum(sizes > limit)) - 1
        also = f" ({others} more exceed the limit, perhaps by it)" if others else ""
        w = "|w|" if done.sigma_known else "tau"
        said.append(
            f"{AXES[axis]} of control point {done.control.names[k]} has {w} = "
            f"{sizes[k, axis]:.1f} where {limit:.1f} is allowed{also}: it is wrong on "
            "the ground or in the model, or has the name of another point."
        )
    poorly = done.control.known & (done.redundancy < POORLY)
    if np.any(poorly) and done.freedom > 0:
        named = [
            f"{AXES[axis]} of {done.control.names[k]}"
            for k, axis in np.argwhere(poorly)
        ]
        said.append(
            f"Poorly checked (redundancy below {POORLY}), an error there hardly shows: "
            f"{join_names(named, SHOWN)}."
        )
    return said


def _of_checks(done: Done) -> list[str]:
    if not done.checks.names:
        return [
            "No check points: the residuals at control say how well these fit together, "
            "not how accurate new points are. Give some points of the ground the role "
            "check."
        ]
    sizes, limit = np.abs(done.checks.w), done.limit_of_checks
    beyond = np.flatnonzero(np.max(sizes, axis=1) > limit)
    if not beyond.size:
        return []
    names = join_names([done.checks.names[k] for k in beyond], SHOWN)
    return [
        f"Check points differ by more than their standard deviations allow: {names}."
    ]


def _of_position(done: Done) -> list[str]:
    said = []
    if float(np.asarray(done.first.rotation)[2, 2]) < 0:
        said.append(
            "The z axis of the model points downwards on the ground: the model lies "
            "upside down. Of photos taken from above this is wrong: exchange X and Y of "
            "the ground if X points north, or look for the other solution."
        )
    if not done.sigma_known:
        said.append(
            "The model points have no standard deviations: those on the ground are of "
            "scale, rotation and shift alone, and sigma0 stands for errors of the model, "
            "too. Give --model-sigma, or sigma in the table of the model."
        )
    return said
