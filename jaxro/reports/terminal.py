"""Where reports and warnings go, and the bar that shows how far a long calculation
is."""

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from rich.console import Console

from ..xla import store


def consoles() -> tuple[Console, Console]:
    """(for reports, for warnings and progress)."""
    # text that goes to a file or a pipe is not wrapped at 80 columns
    wide = None if sys.stdout.isatty() or "COLUMNS" in os.environ else 200
    return Console(width=wide, highlight=False, emoji=False), Console(
        stderr=True, highlight=False, emoji=False
    )


def abort() -> NoReturn:
    """The end of a process after Ctrl-C, while the exception still holds what its calls
    hold.

    Of a program that it compiles JAX frees the text with the interrupted call, but XLA
    goes on in a thread of its own and reads it: the process died of a segmentation
    fault.
    """
    sys.stdout.flush()
    print("Aborted.", file=sys.stderr, flush=True)
    os._exit(130)


SOON = 1.0
"""Seconds after which a user is told what he waits for."""


@contextmanager
def say_compiling(shape: tuple[int, ...]) -> Iterator[None]:
    """Around a compilation for pairs of this shape: a line on the terminal if it takes
    longer than SOON."""
    *pairs, points = shape or (0,)
    of = f"{pairs[0]} pairs of up to " if pairs and pairs[0] > 1 else ""
    once = ", once on this machine" if store.active() else ""
    line = f"Compiling for {of}{points} points{once} ..."
    if not sys.stderr.isatty():
        yield
        return
    say = lambda: print(line, file=sys.stderr, flush=True)
    timer = threading.Timer(SOON, say)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def progress(
    errors: Console, what: str, total: int | None
) -> Iterator[Callable[..., None]]:
    """A function to be told how many are done, and of how many where `total` is None.

    It draws a bar where there are several and somebody looks.
    """
    if total == 1 or not errors.is_terminal:
        yield lambda done, total=None: None
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=errors, transient=True) as bar:
        task = bar.add_task("", total=total)
        yield lambda done, total=None: bar.update(task, completed=done, total=total)
