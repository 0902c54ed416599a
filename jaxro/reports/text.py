"""Tables of an experiment for the terminal; the only place here that needs rich."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, SupportsFloat

if TYPE_CHECKING:
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


def number(value: SupportsFloat, digits: int) -> str:
    """The value with so many decimals, "-" if it does not exist; never minus zero."""
    value = float(value)
    if not math.isfinite(value):
        return "-"
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if not float(text) else text
