"""What a procedure rejected, in what order and on what evidence, on the terminal."""

from collections import defaultdict

from rich.console import Console
from rich.markup import escape

from .columns import OUTCOME_ADVICE
from .pair import MOST_ROWS, join_names
from .text import number, table
from .verdicts import Verdicts


def show(console: Console, verdicts: Verdicts, procedure: str, unit: str) -> None:
    """One pair, or many with the name of the pair in every row."""
    names, rejected = verdicts.table.names, len(verdicts.rejected)
    many = len(names) > 1
    console.print(
        f"[bold]Cleaning of {f'{len(names)} pairs' if many else escape(names[0])}[/bold] "
        f"by {procedure}: {rejected} of {len(verdicts.table.points)} points rejected"
    )
    if rejected:
        _show_rejections(console, verdicts, unit)
    _show_doubts(console, verdicts)
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
                f"{join_names(members, MOST_ROWS)}{counted}: {OUTCOME_ADVICE[outcome]}"
            )
    console.print()


def _show_rejections(console: Console, verdicts: Verdicts, unit: str) -> None:
    owner, found = verdicts.table.owners, verdicts.of_points
    many = len(verdicts.table.names) > 1
    first = ("pair", "point") if many else ("point",)
    rows = table(*first, "order", "statistic", "limit", f"q [{unit}]", left=len(first))
    for row in verdicts.rejected[:MOST_ROWS]:
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
    count = len(verdicts.rejected)
    if count > MOST_ROWS:
        console.print(f"{MOST_ROWS} of {count} rejections; --out DIR writes all.")


def _show_doubts(console: Console, verdicts: Verdicts) -> None:
    """Of which points one is wrong, by pair."""
    doubtful, names = verdicts.undecided, verdicts.table.names
    for pair in list(doubtful)[:MOST_ROWS]:
        of = f"{names[pair]}: " if len(names) > 1 else ""
        console.print(
            f"{of}wrong is one of {', '.join(doubtful[pair])}; nothing tells which.",
            markup=False,
        )
    if len(doubtful) > MOST_ROWS:
        console.print(
            f"{MOST_ROWS} of {len(doubtful)} undecided pairs; --out DIR writes all."
        )
