"""The report of an adjusted network on the terminal."""

import numpy as np
from rich.console import Console

from ..surveys.geodetic import KINDS
from .network_files import AXES, Done
from .pair import digits, join_names, table
from .rows import left_out, most_rows
from .text import escape, number

SHOWN = 10
"""Names that a sentence tells of a longer list."""


def show(console: Console, done: Done) -> None:
    """Whether the network fits, what is wrong, how accurate its points are, and the
    measurements with the largest residuals."""
    kinds = [KINDS[line.kind].ends > 1 and line.kind for line in done.lines]
    counts = {kind: kinds.count(kind) for kind in dict.fromkeys(kinds) if kind}
    told = ", ".join(f"{count} of {kind}" for kind, count in counts.items())
    console.print(
        f"[bold]Network of {escape(done.title)}[/bold], {len(done.names)} points; "
        f"measurements: {told}"
    )
    console.print(_verdict(done))
    if done.result != "successful":
        return
    console.print(_fit(done))
    if done.solution.datum:
        of_all = done.solution.network.datum is None
        console.print(
            "Nothing is known of its position: a free network. Deviations are those "
            f"about {'all of its points' if of_all else 'the points of its datum'}."
        )
    _show_points(console, done)
    _show_checks(console, done)
    _show_measurements(console, done)
    for sentence in _promise(done):
        console.print(sentence)
    for warning in done.warnings:
        console.print(f"[yellow]Mind:[/yellow] {escape(warning)}")


def _verdict(done: Done) -> str:
    """What came of it, in one sentence."""
    if done.loose:
        return (
            "[bold red]not determined[/bold red]: nothing tells where the points "
            f"{escape(join_names(done.loose, SHOWN))} lie from those that are known; "
            "join them by more measurements, or give more known coordinates"
        )
    if done.result == "rank_deficient":
        return (
            "[bold red]not determined[/bold red]: the measurements do not determine all "
            "points; see whether each is joined to the others by enough of them"
        )
    if done.result != "successful":
        return (
            f"[bold red]{done.result}[/bold red]: no solution was found near the "
            "approximate coordinates"
        )
    if done.freedom < 1:
        return "[yellow]The measurements determine the points, and nothing checks them.[/yellow]"
    if not done.wrong:
        return "[green]The measurements fit each other.[/green]"
    names = [_name(done, k) for k in done.wrong]
    if len(names) == 1:
        return (
            f"[bold red]{escape(names[0])} is wrong[/bold red]: p = "
            f"{done.tests.p[done.wrong[0]]:.2g}, and {done.limit:.2g} is the limit where "
            f"none of all is wrong in {1 - done.level:.0%} of cases. Leave it out, or "
            "measure it again."
        )
    return (
        f"[bold red]One of {escape(', '.join(names))} is wrong[/bold red], and nothing "
        "tells which: the others fit without any one of them. Measure them again."
    )


def _promise(done: Done) -> list[str]:
    """What verdicts and intervals are worth, by simulation."""
    told, asked = done.promise, done.simulated
    if asked is None:
        return []
    if told is None:
        return ["Nothing is simulated: no measurement is checked by others."]
    percent = lambda share: "-" if np.isnan(share) else f"{share:.1%}"
    intervals = told.reported if done.sigma_known else told.estimated
    held = f"{percent(np.min(intervals))} to {percent(np.max(intervals))}"
    errors = f"{asked.wrong} wrong measurements of {asked.size:g} standard deviations"
    if asked.wrong == 0:
        errors = "no wrong measurement"
    elif asked.wrong == 1:
        errors = f"a wrong measurement of {asked.size:g} standard deviations"
    return [
        f"In {told.repetitions} simulated networks like this one, with {errors}: all are "
        f"said to fit in {percent(told.fits.said)}; one is named in "
        f"{percent(told.named.said)}, rightly in {percent(told.named.right)} of these; "
        f"several are in {percent(told.several.said)}, a wrong one among them in "
        f"{percent(told.several.right)}.",
        "Where a measurement that is named alone is left out and the rest adjusted "
        f"again, {percent(told.accepted)} pass all tests in the end, "
        f"{percent(told.exactly_right)} without just the wrong ones; of those that pass, "
        f"intervals of {told.confidence:.0%} hold the true coordinates in {held}.",
    ]


def _name(done: Done, k: int) -> str:
    line = done.lines[k]
    points = line.points
    if len(points) > 3:
        points = (*points[:3], "...")
    return f"{line.kind} {'-'.join(points)}"


def _fit(done: Done) -> str:
    """sigma0 and what it says."""
    if done.freedom < 1:
        return ""
    told = f"sigma0 {done.sigma0:.4g} ({done.freedom} degrees of freedom)"
    if not done.sigma_known:
        return f"{told}; deviations are multiplied by it."
    return (
        f"{told}; if the standard deviations are right, one as far from 1 occurs in "
        f"{done.global_p:.2g} of cases."
    )


def _show_points(console: Console, done: Done) -> None:
    """Adjusted coordinates with deviations."""
    there = np.any(np.isfinite(done.coordinates), axis=0)
    axes = [k for k in range(3) if there[k]]
    heads = [f"{AXES[k]}, {done.unit}" for k in axes] + [f"s{AXES[k]}" for k in axes]
    shown = table("point", *heads)
    spread = done.deviations
    least = np.min(spread[spread > 0], initial=np.inf)
    places = digits(least if np.isfinite(least) else None, 3)
    for k in range(min(len(done.names), most_rows())):
        cells = [number(done.coordinates[k, a], places) for a in axes]
        cells += [
            "known"
            if done.solution.network.held[k, a]
            else number(spread[k, a], places)
            for a in axes
        ]
        shown.add_row(escape(done.names[k]), *cells)
    console.print(shown)
    left_out(console, len(done.names) - most_rows(), "points")


def _show_checks(console: Console, done: Done) -> None:
    """Adjusted minus given coordinates of check points."""
    ground = done.ground
    if ground is None or not np.any(ground.is_a("check")):
        return
    shown = table("check point", *(f"d{axis}, {done.unit}" for axis in AXES))
    numbers = {name: k for k, name in enumerate(done.names)}
    for k in np.flatnonzero(ground.is_a("check")):
        if ground.names[k] in numbers:
            at = done.coordinates[numbers[ground.names[k]]]
            off = at - ground.coordinates[k]
            shown.add_row(escape(ground.names[k]), *(number(d, 4) for d in off))
    console.print(shown)


def _show_measurements(console: Console, done: Done) -> None:
    """The measurements with the smallest probabilities first."""
    if done.freedom < 1:
        return
    rows = done.table()
    test = "w" if done.sigma_known else "tau"
    heads = [
        "residual",
        "r",
        *((test, "detectable", "identifiable") if done.is_scalar else ()),
        "p",
    ]
    shown = table("measurement", *heads, title="largest residuals first")
    order = np.argsort(done.tests.p, kind="stable")
    for k in order[: most_rows()]:
        row = rows[k]
        cells = [
            " ".join(f"{float(v):.4g}" for v in row["residual"].split()),
            number(row["redundancy"], 2),
        ]
        if done.is_scalar:
            cells.append(number(row[test], 2))
            cells += [f"{row[name]:.3g}" for name in ("detectable", "identifiable")]
        shown.add_row(escape(_name(done, int(k))), *cells, f"{row['p']:.2g}")
    console.print(shown)
    left_out(console, len(rows) - most_rows(), "measurements")
