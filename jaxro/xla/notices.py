"""What a user is told while a program is compiled: one line, once a call.

The line goes to standard error after a second of compiling. `announce` sends it
elsewhere; the environment variable JAXRO_QUIET=1, or `announce(None)`, is silence, for
notebooks and logs.
"""

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SOON = 1.0
"""Seconds of compiling after which a user is told what he waits for."""

PAUSE = 1.0
"""Seconds without compiling after which the next program belongs to another call."""


def _print(line: str) -> None:
    if sys.stderr is not None and not os.environ.get("JAXRO_QUIET"):
        print(f"jaxro: {line}", file=sys.stderr, flush=True)


_say: Callable[[str], None] | None = _print


def announce(say: Callable[[str], None] | None) -> None:
    """Call say(line) where a program takes long to compile; None: say nothing."""
    global _say
    _say = say


class _Clock:
    """The seconds in which something was compiled, be it one program or several."""

    def __init__(self) -> None:
        self._lock, self._running = threading.Lock(), 0
        self._since = self._before = 0.0  # when the state changed, seconds until then
        self._call = 0.0  # seconds at the beginning of this call
        self._told = False

    @property
    def seconds(self) -> float:
        """Up to now."""
        now = time.perf_counter() if self._running else self._since
        return self._before + now - self._since

    def begin(self) -> float:
        """A compilation begins; how many seconds its call has compiled already."""
        with self._lock:
            now = time.perf_counter()
            if not self._running and now - self._since > PAUSE:
                self._call, self._told = self.seconds, False
            self._before, self._since = self.seconds, now
            self._running += 1
            return self._before - self._call

    def end(self) -> None:
        """A compilation has ended."""
        with self._lock:
            self._before, self._since = self.seconds, time.perf_counter()
            self._running -= 1

    def tell(self, line: str) -> None:
        """Say the line, if this call has said none."""
        with self._lock:
            told, self._told = self._told, True
        if not told and _say is not None:
            _say(line)


_clock = _Clock()


def seconds() -> float:
    """Seconds that this process has spent compiling."""
    return _clock.seconds


@contextmanager
def compiling(what: str) -> Iterator[None]:
    """Around a compilation: it is counted, and told of if it takes long."""
    left = SOON - _clock.begin()
    timer = threading.Timer(max(left, 0.0), _clock.tell, (f"compiling {what}",))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        _clock.end()
