"""The report of heights over a grid on the terminal."""

import numpy as np
from rich.console import Console

from .pair import table
from .rows import left_out, worst
from .survey_files import Done, shares
from .text import escape, number, say

SOURCES = {
    "camera_height": "camera height",
    "base": "base",
    "side": "squares in nature",
    "photo_side": "squares on the photo",
    "grid": "readings of the grid",
    "point": "readings of points",
    "legs": "readings of legs",
}


def show(console: Console, done: Done, title: str) -> None:
    """Heights, traverses, what the errors come from, and what to mind."""
    console.print(
        f"[bold]Heights over the grid of {escape(title)}[/bold], {contents_in_words(done)}"
    )
    console.print(geometry_in_words(done))
    show_heights(console, done)
    show_traverses(console, done)
    show_shares(console, done)
    for doubt in doubts(done):
        console.print(f"[red]Mind:[/red] {escape(doubt)}")
    for note in notes(done):
        say(console, f"Mind: {note}")


def contents_in_words(done: Done) -> str:
    """How many points there are."""
    known = sum(origin == "known" for origin in done.origin)
    return f"{done.named.points} points, {known} of known height"


def geometry_in_words(done: Done) -> str:
    """How the photos were taken."""
    measured = done.named.survey.measured
    p_c = np.asarray(measured.base * measured.photo_side / measured.side)
    return (
        f"H {float(measured.camera_height):g} mm, B {float(measured.base):g} mm, "
        f"{len(done.named.squares)} squares, "
        f"parallax of the grid {np.min(p_c):.2f} to {np.max(p_c):.2f} mm"
    )


def show_heights(console: Console, done: Done) -> None:
    """Heights with their standard deviations, beside those of the grid alone."""
    named, found = done.named, done.found
    rows = table(
        "point",
        "height",
        "± sd",
        "by (1)",
        "± sd",
        title="Heights and those over the grid alone (1), mm",
    )
    rows.add_column("read from")
    entries = []
    for i in range(named.points):
        numbers = (
            found.heights.value,
            found.deviations.value,
            found.heights.over_grid,
            found.deviations.over_grid,
        )
        entries.append((i, [float(a[i]) for a in numbers]))
    for i, (h, sd, over, sd_over) in worst(entries, lambda entry: -entry[1][1]):
        cells = [
            number(h, 1),
            "given" if done.origin[i] == "known" else number(sd, 2),
            number(over, 1),
            number(sd_over, 2),
        ]
        rows.add_row(escape(named.names[i]), *cells, escape(done.origin[i]))
    console.print(rows)
    left_out(
        console,
        named.points,
        "points, those with the largest standard deviations shown",
    )


def show_traverses(console: Console, done: Done) -> None:
    """Misclosures of traverses, and sigma0."""
    adjusted = done.found.adjusted
    if adjusted is None:
        return
    for c in done.closures:
        allowed = float(done.found.limit) * c.deviation
        legs = "1 leg" if c.legs == 1 else f"{c.legs} legs"
        console.print(
            f"Traverse {escape(c.name)}, {legs}, closes with {number(c.misclosure, 2)} "
            "mm "
            f"(± {number(c.deviation, 2)} by its readings, allowed "
            f"{number(allowed, 2)})"
        )
    rows = table(
        "traverse",
        "legs",
        "misclosure",
        "± sd",
        "|w|",
        "detectable",
        title="Traverses between nodes: misclosure left, mm",
    )
    for t in done.traverses:
        there = np.isfinite(t.detectable)
        cells = (
            [number(t.misclosure, 2), number(t.deviation, 2)] if there else ["-", "-"]
        )
        cells += [number(abs(t.w), 2) if there else "-", number(t.detectable, 1)]
        style = "red" if t in done.suspicious else None
        rows.add_row(
            escape(f"{t.names}: {t.first} - {t.last}"), str(t.legs), *cells, style=style
        )
    console.print(rows)
    freedom = int(adjusted.degrees_of_freedom)
    console.print(
        f"sigma0 {number(float(adjusted.sigma0), 2)} of the readings' standard "
        f"deviation, {freedom} "
        f"degree{'s' * (freedom != 1)} of freedom; |w| allowed "
        f"{float(done.found.limit):.2f}"
    )


def show_shares(console: Console, done: Done) -> None:
    """What the variance of the heights comes from."""
    parts = {
        name: float(np.mean(share)) if share.size else 0.0
        for name, share in shares(done).items()
    }
    parts["legs"] = parts.pop("back") + parts.pop("fore")
    costs = sorted(
        ((parts[name], text) for name, text in SOURCES.items()), reverse=True
    )
    told = ", ".join(f"{text} {share:.0%}" for share, text in costs if share >= 0.005)
    console.print(f"Variance of the heights comes from: {told}", markup=False)


def doubts(done: Done) -> list[str]:
    """What the tests found."""
    said = []
    worst_w = abs(done.suspicious[0].w) if done.suspicious else 0.0
    most = [t for t in done.suspicious if abs(t.w) > worst_w - 1e-6]
    if most:
        named = " or ".join(f"{t.names} ({t.first} - {t.last})" for t in most)
        sizes = " or ".join(f"{abs(t.error):.1f}" for t in most)
        rest = len(done.suspicious) - len(most)
        also = (
            f" {rest} more exceed{'s' * (rest == 1)} the limit, perhaps by the same "
            "error."
            if rest
            else ""
        )
        said.append(
            f"Traverse {named} has |w| = {worst_w:.1f} where "
            f"{float(done.found.limit):.2f} is allowed: one of its legs is wrong by "
            f"some {sizes} mm, the misclosure "
            f"cannot tell which. Read them again.{also}"
        )
    for i in done.doubtful:
        height, read, sd = (
            float(a[i])
            for a in (
                done.found.heights.value,
                done.found.heights.over_grid,
                done.found.deviations.over_grid,
            )
        )
        said.append(
            f"The height of {done.named.names[i]} is given as {height:.1f} mm, and "
            f"read as {read:.1f} ± {sd:.1f} mm."
        )
    return said


def notes(done: Done) -> list[str]:
    """What a careful user should know besides."""
    said = []
    unchecked = [
        f"{t.names} ({t.first} - {t.last})"
        for t in done.traverses
        if not np.isfinite(t.detectable)
    ]
    if unchecked:
        said.append(f"Nothing checks {', '.join(unchecked)}.")
    free = [
        i for i, origin in enumerate(done.origin) if origin not in ("known", "grid")
    ]
    if free:
        ours, alone = (
            np.sqrt(np.mean(np.square(a[free])))
            for a in (done.found.deviations.value, done.found.deviations.over_grid)
        )
        if alone < ours:
            said.append(
                f"By (1) alone these heights would have ± {alone:.2f} mm, not "
                f"{ours:.2f}. What the traverses give for it is a check, and that an "
                "error of the camera height or of the grid hardly enters."
            )
    return said
