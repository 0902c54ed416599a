"""What a procedure rejected, in what order and on what evidence, on the terminal."""

from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from jaxtyping import Int
from rich.console import Console

from ..orientation.pure_rotation import ANGLES
from .columns import OUTCOME_ADVICE
from .pair import join_names
from .rows import left_out, most_rows
from .text import escape, number, say, table
from .verdicts import Verdicts


def show(console: Console, verdicts: Verdicts, procedure: str, unit: str) -> None:
    """One pair, or many with the name of the pair in every row."""
    names, rejected = verdicts.table.names, len(verdicts.rejected)
    many = len(names) > 1
    console.print(
        f"[bold]Cleaning of {f'{len(names)} pairs' if many else escape(names[0])}[/bold] "
        f"by {procedure}: {rejected} of {len(verdicts.table.points)} points rejected"
    )
    _show_rejections(console, verdicts, verdicts.rejected, unit, many)
    _show_doubts(console, verdicts, many)
    _show_solutions(console, verdicts, many)
    by_outcome: dict[str, list[str]] = defaultdict(list)
    for name, outcome in zip(names, verdicts.outcomes, strict=True):
        by_outcome[outcome].append(name)
    for outcome, members in by_outcome.items():
        plural = "s" * (len(members) != 1)
        counted = f" ({len(members)} pair{plural})" if many else ""
        if outcome == "finished":
            console.print(f"[green]finished[/green]{counted}")
        else:
            console.print(
                f"[bold red]{outcome.upper()}[/bold red] "
                f"{escape(join_names(members, most_rows()))}{counted}: {OUTCOME_ADVICE[outcome]}"
            )
    console.print()


def show_one(console: Console, verdicts: Verdicts, pair: int, unit: str) -> None:
    """What was decided about one of many pairs."""
    rejected = verdicts.rejected
    own = rejected[verdicts.table.owners[rejected] == pair]
    if not own.size:
        console.print("No point was rejected.")
    _show_rejections(console, verdicts, own, unit, many=False)
    doubtful = verdicts.undecided
    if pair in doubtful:
        say(console, _doubt(doubtful[pair]))
    for said in _solutions(verdicts, pair):
        say(console, said)


def _show_rejections(
    console: Console,
    verdicts: Verdicts,
    rejected: Int[np.ndarray, " some"],
    unit: str,
    many: bool,
) -> None:
    """The rejected points of these rows; `many`: with the name of their pair."""
    if not rejected.size:
        return
    owner, found = verdicts.table.owners, verdicts.of_points
    first = ("pair", "point") if many else ("point",)
    rows = table(*first, "order", "statistic", "limit", f"q [{unit}]", left=len(first))
    for row in rejected[: most_rows()]:
        pair, point = verdicts.table.names[owner[row]], verdicts.table.points[row]
        rows.add_row(
            *map(escape, (pair, point) if many else (point,)),
            str(found["order"][row]),
            f"{found['statistic'][row]:.4g}",
            f"{found['limit'][row]:.4g}",
            number(found["q"][row], 4),
        )
    console.print(
        "Statistic against its limit, and q at the orientation of the points kept:"
    )
    console.print(rows)
    left_out(console, len(rejected), "rejections")
    unchecked = rejected[verdicts.of_points["unchecked"][rejected]]
    if unchecked.size:
        points = verdicts.table.points[unchecked]
        owners = verdicts.table.names[owner[unchecked]]
        named = [f"{a} {b}" for a, b in zip(owners, points, strict=True)]
        listed = join_names(named if many else list(points), most_rows())
        say(
            console,
            "Below the limit, but checked by no other point, and so perhaps by chance "
            f"among so many wrong ones: {listed}",
        )


def _show_doubts(console: Console, verdicts: Verdicts, many: bool) -> None:
    """Of which points one is wrong, by pair."""
    doubtful, names = verdicts.undecided, verdicts.table.names
    for pair in list(doubtful)[: most_rows()]:
        of = f"{names[pair]}: " if many else ""
        say(console, of + _doubt(doubtful[pair]))
    left_out(console, len(doubtful), "undecided pairs")


def _show_solutions(console: Console, verdicts: Verdicts, many: bool) -> None:
    """The solutions, by pair, where there are several."""
    found, names = verdicts.solutions, verdicts.table.names
    for pair in list(found)[: most_rows()]:
        of = f"{names[pair]}: " if many else ""
        for said in _solutions(verdicts, pair):
            say(console, of + said)
    left_out(console, len(found), "pairs with several solutions")


def _solutions(verdicts: Verdicts, pair: int) -> Iterator[str]:
    """A sentence on each of several solutions."""
    for number_of, (rows, pose, probability) in enumerate(
        verdicts.solutions.get(pair, [])
    ):
        points = list(verdicts.table.points[rows])
        bx, by, bz, *angles = pose.values()
        base = ", ".join(number(b, 3) for b in (bx, by, bz))
        turned = zip(ANGLES, angles, strict=True)
        named = ", ".join(f"{name} {number(angle, 2)}°" for name, angle in turned)
        which = (
            f"others: {join_names(points, most_rows())}" if number_of else "those kept"
        )
        yield (
            f"{len(points)} points agree with base ({base}), {named}; by accident with "
            f"the probability {probability:.1g}; {which}."
        )


def _doubt(points: list[str]) -> str:
    return f"wrong is one of {', '.join(points)}; nothing tells which."
