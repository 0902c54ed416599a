"""Words, numbers and tables for the terminal, where names of users are text."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, SupportsFloat

from ..tables.fields import tell

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def table(*heads: str, left: int = 1) -> Table:
    """An empty table; its first `left` columns are text, the others numbers."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    empty = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for place, head in enumerate(heads):
        empty.add_column(
            Text(head), justify="left" if place < left else "right", no_wrap=True
        )
    return empty


def escape(text: str) -> str:
    """A name, or a sentence with names, as markup that shows it as it is, in one line."""
    from rich.markup import escape as in_markup

    return in_markup(tell(text))


def say(console: Console, text: str) -> None:
    """A sentence with names, in one line."""
    console.print(tell(text), markup=False)


def number(value: SupportsFloat, digits: int) -> str:
    """The value with so many decimals, "-" if it does not exist; never minus zero."""
    value = float(value)
    if not math.isfinite(value):
        return "-"
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if not float(text) else text
