"""How many rows of a long table are shown: few on a terminal, more on a page."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from rich.console import Console

ON_TERMINAL = 40
"""Longer tables show their worst rows there; --out writes all."""

ON_PAGE = 1000
"""The same of a page of a browser."""

_most = ContextVar("most", default=ON_TERMINAL)


@contextmanager
def showing(rows: int) -> Iterator[None]:
    """Within the block tables show so many rows."""
    before = _most.set(rows)
    try:
        yield
    finally:
        _most.reset(before)


def most_rows() -> int:
    """The rows that a table shows at most."""
    return _most.get()


def some_rows(on_terminal: int) -> int:
    """The rows of a table that shows only so many on a terminal."""
    return on_terminal if most_rows() <= ON_TERMINAL else most_rows()


def worst(rows: list, key: Callable) -> list:
    """As many rows as are shown, the worst by `key`, in their own order."""
    kept = {id(row) for row in sorted(rows, key=key)[: most_rows()]}
    return [row for row in rows if id(row) in kept]


def left_out(console: Console, count: int, what: str) -> None:
    """A line about rows that are not shown."""
    if count > most_rows():
        console.print(f"{most_rows()} of {count} {what}; --out DIR writes all.")
