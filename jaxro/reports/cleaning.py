"""What a procedure rejected, in what order and on what evidence, on the terminal."""

from collections import defaultdict

from rich.console import Console
from rich.markup import escape

from .pair import MOST_ROWS
from .text import number, table
from .verdicts import ADVICE, Verdict


def show(console: Console, verdicts: list[Verdict], procedure: str, unit: str) -> None:
    """One pair, or many with the name of the pair in every row."""
    rejected, points = (
        sum(len(v.rejected) for v in verdicts),
        sum(len(v.measured.points) for v in verdicts),
    )
    many = len(verdicts) > 1
    of = f"{len(verdicts)} pairs" if many else verdicts[0].measured.name
    console.print(
        f"[bold]Cleaning of {escape(of)}[/bold] by {procedure}: {rejected} of {points} "
        "points rejected"
    )
    if rejected:
        _rejections(console, verdicts, rejected, unit)
    _doubts(console, verdicts)
    outcomes: dict[str, list[str]] = defaultdict(list)
    for v in verdicts:
        outcomes[v.outcome].append(v.measured.name)
    for outcome, names in outcomes.items():
        if outcome == "finished":
            console.print(
                f"[green]finished[/green]{f' ({_pairs(names)})' if many else ''}"
            )
        else:
            listed = ", ".join(map(escape, names[:MOST_ROWS])) + (
                ", ..." if len(names) > MOST_ROWS else ""
            )
            of = f" ({_pairs(names)})" if many else ""
            console.print(
                f"[bold red]{outcome.upper()}[/bold red] {listed}{of}: "
                f"{ADVICE[outcome]}"
            )
    console.print()


def _pairs(names: list[str]) -> str:
    return f"{len(names)} pair{'s' * (len(names) != 1)}"


def _rejections(
    console: Console, verdicts: list[Verdict], count: int, unit: str
) -> None:
    many = len(verdicts) > 1
    first = ("pair", "point") if many else ("point",)
    rows = table(*first, "order", "statistic", "limit", f"q [{unit}]", left=len(first))
    for v in verdicts:
        for i in v.rejected:
            if rows.row_count == MOST_ROWS:
                break
            d = v.decision
            names = [v.measured.name] * many + [v.measured.points[i]]
            evidence = [_evidence(float(x)) for x in (d.statistic[i], d.limit[i])]
            rows.add_row(
                *map(escape, names),
                str(int(d.order[i])),
                *evidence,
                number(float(v.parallax[i]), 4),
            )
    console.print(
        "Statistic against its limit, and q at the orientation of the points kept:"
    )
    console.print(rows)
    if count > MOST_ROWS:
        console.print(f"{MOST_ROWS} of {count} rejections; --out DIR writes all.")


def _doubts(console: Console, verdicts: list[Verdict]) -> None:
    """Of which points one is wrong, by pair."""
    doubtful = [v for v in verdicts if v.undecided]
    for v in doubtful[:MOST_ROWS]:
        of = f"{v.measured.name}: " if len(verdicts) > 1 else ""
        console.print(
            f"{of}wrong is one of {', '.join(v.undecided)}; nothing tells which.",
            markup=False,
        )
    if len(doubtful) > MOST_ROWS:
        console.print(
            f"{MOST_ROWS} of {len(doubtful)} undecided pairs; --out DIR writes all."
        )


def _evidence(value: float) -> str:
    """Statistics are millimetres, ratios or squares: as many decimals as four digits
    need."""
    return f"{value:.4g}"
