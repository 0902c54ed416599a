"""Where reports and warnings go, the bar that shows how far a long calculation is, and
the time that it takes."""

import codecs
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple, NoReturn, TextIO

from rich.console import Console
from rich.segment import Segment

from ..tables.fields import tell, tell_lines
from ..xla import notices

PLAIN = str.maketrans(
    {
        "σ": "s",
        "µ": "u",
        "±": "+-",
        "°": " deg",
        "²": "^2",
        "χ": "chi",
        "…": "...",
        "–": "-",
        "−": "-",
        "×": "x",
        "≤": "<=",
        "≥": ">=",
    }
)
"""Letters of the reports where a terminal has not got them."""


class Steady:
    """A stream that may be closed, or full, while a report is written: that is
    remembered as `error`, and what is calculated is not lost with it."""

    def __init__(self, stream: TextIO):
        self._stream = stream
        self.error: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """As of the stream."""
        with self._remember():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """As of the stream."""
        with self._remember():
            self._stream.flush()

    @contextmanager
    def _remember(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = self.error or error
            # what is left in buffers goes nowhere, also at the end of the process
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


class _Console(Console):
    """A console that shows no control characters of names."""

    def render(self, *arguments: Any, **options: Any) -> Iterable[Segment]:
        for segment in super().render(*arguments, **options):
            if segment.control:
                yield segment
            else:
                yield segment._replace(text=tell_lines(segment.text))


def consoles() -> tuple[Console, Console]:
    """(for reports, for warnings and progress)."""
    # text that goes to a file or a pipe is not wrapped at 80 columns
    looked_at = sys.stdout is not None and sys.stdout.isatty()
    wide = None if looked_at or "COLUMNS" in os.environ else 200
    return (
        _Console(width=wide, highlight=False, emoji=False),
        _Console(stderr=True, highlight=False, emoji=False),
    )


def warn(errors: Console, text: str) -> None:
    """A warning, in one line."""
    errors.print(f"Warning: {tell(text)}", style="yellow", markup=False)


@contextmanager
def steady_streams() -> Iterator[Callable[[], OSError | None]]:
    """Standard output and error that never stop the work; the error of standard output
    by a call."""
    codecs.register_error("plain", _plain_letters)
    before = sys.stdout, sys.stderr
    steady = [_steady(stream) for stream in before]
    sys.stdout, sys.stderr = steady

    def flush() -> OSError | None:
        out = steady[0]
        if out is None:
            return None
        out.flush()
        return out.error

    try:
        yield flush
    finally:
        sys.stdout, sys.stderr = before


def _steady(stream: Any) -> Any:
    """The stream, None where the process has none."""
    if stream is None:
        return None
    if hasattr(stream, "reconfigure"):
        stream.reconfigure(errors="plain")
    return Steady(stream)


def _plain_letters(error: UnicodeError) -> tuple[str, int]:
    """What is written for letters that the encoding of a stream has not got."""
    assert isinstance(error, UnicodeEncodeError)
    letters = error.object[error.start : error.end].translate(PLAIN)
    known = (
        letters if letters.isascii() else letters.encode("ascii", "replace").decode()
    )
    return known, error.end


def abort() -> NoReturn:
    """The end of a process after Ctrl-C, while the exception still holds what its calls
    hold.

    Of a program that it compiles JAX frees the text with the interrupted call, but XLA
    goes on in a thread of its own and reads it: the process died of a segmentation
    fault.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, AttributeError):
            if stream is sys.stderr:
                print("Aborted.", file=stream)
            stream.flush()
    os._exit(130)


class Spent(NamedTuple):
    """Seconds of a work, and of compiling in addition to them."""

    work: float
    compiling: float

    def __str__(self) -> str:
        if self.compiling < LEAST_TOLD:
            return f"{self.work:.1f} s"
        return f"{self.work:.1f} s, and {self.compiling:.1f} s for compiling"


def stopwatch() -> Callable[[], Spent]:
    """What was spent since this call."""
    began, before = time.perf_counter(), notices.seconds()

    def spent() -> Spent:
        compiling = notices.seconds() - before
        return Spent(time.perf_counter() - began - compiling, compiling)

    return spent


LEAST_TOLD = 0.05
"""Seconds of compiling that are told of."""


def say_compiling(line: str) -> None:
    """Tell of a compilation that takes long, if somebody looks."""
    if sys.stderr is not None and sys.stderr.isatty():
        print(tell(f"{line.capitalize()} ..."), file=sys.stderr, flush=True)


@contextmanager
def say_what(line: str) -> Iterator[None]:
    """Around a work that nothing tells of: the line on the terminal if it takes longer
    than `notices.SOON`."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield
        return
    say = lambda: print(tell(line), file=sys.stderr, flush=True)
    timer = threading.Timer(notices.SOON, say)
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
