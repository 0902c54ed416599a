"""What a report prints on a terminal, as blocks of a page: so both say the same."""

from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.table import Table as Printed
from rich.text import Text

from .page import Block, Prose, Row, Table, Tone

TONES = {"green": Tone.good, "yellow": Tone.mind, "red": Tone.bad, "bold red": Tone.bad}
"""What the colours of the terminal say."""

WARNING = "Mind:"
"""How a sentence begins that the page shows at its top, in a list of its own."""


class Recorder(Console):
    """A console that keeps what is printed as blocks of a page."""

    def __init__(self) -> None:
        super().__init__(quiet=True)
        self.blocks: list[Block] = []

    def print(self, *objects: Any, **options: Any) -> None:
        """As of a console; a table, or a text with or without markup."""
        for one in objects:
            block = (
                as_table(one)
                if isinstance(one, Printed)
                else as_prose(str(one), options.get("markup", True))
            )
            is_empty = isinstance(block, Prose) and not block.text.strip()
            if not is_empty:
                self.blocks.append(block)


def record(show: Callable[..., None], *arguments: Any) -> list[Block]:
    """The blocks that `show(console, *arguments)` prints, without warnings."""
    console = Recorder()
    show(console, *arguments)
    warns = lambda one: isinstance(one, Prose) and one.text.startswith(WARNING)
    return [block for block in console.blocks if not warns(block)]


def as_table(printed: Printed) -> Table:
    """A table of the terminal as one of a page."""
    plain = lambda cell: Text.from_markup(str(cell)).plain
    columns = [[plain(cell) for cell in column.cells] for column in printed.columns]
    return Table(
        title="" if printed.title is None else plain(printed.title).replace("\n", " "),
        heads=[plain(column.header) for column in printed.columns],
        numbers=[column.justify == "right" for column in printed.columns],
        rows=[
            Row(cells, TONES.get(str(row.style), Tone.plain))
            for *cells, row in zip(*columns, printed.rows, strict=True)
        ],
    )


def as_prose(printed: str, markup: bool) -> Prose:
    """A text of the terminal as one of a page; its first colour tells its tone."""
    if not markup:
        return Prose(printed.strip())
    text = Text.from_markup(printed)
    styles = [str(span.style) for span in text.spans]
    tones = [TONES[style] for style in styles if style in TONES]
    return Prose(text.plain.strip(), tones[0] if tones else Tone.plain)
