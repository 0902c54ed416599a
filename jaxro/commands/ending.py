"""How a command ends: its exit code, and what is told meanwhile."""

from collections.abc import Callable

import typer

from ..tables.fields import TableError

NOT_SHOWN = 74
"""Exit code where the report could not be written to standard output (EX_IOERR)."""


def end(work: Callable[[], bool]) -> None:
    """Do the work with compiled programs kept; the exit code says how it ended.

    0: all is usable; 1: some of it is not; 2: the input could not be used; 74: standard
    output could not be written, files are; 130: Ctrl-C. Who reads standard output may
    stop at any time.
    """
    from ..reports.terminal import abort, say_compiling, steady_streams
    from ..xla import notices, store

    with steady_streams() as flush:
        try:
            notices.announce(say_compiling)
            store.keep_programs()
            good = work()
        except KeyboardInterrupt:
            abort()
        except TableError as error:
            _say(str(error))
            raise typer.Exit(2) from None
        refused = flush()
        if refused is not None and not isinstance(refused, BrokenPipeError):
            _say(
                f"standard output: found {refused.strerror}; expected room for the "
                "report; files of --out are written"
            )
            raise typer.Exit(NOT_SHOWN)
    raise typer.Exit(0 if good else 1)


def _say(error: str) -> None:
    typer.secho(f"Error: {error}", err=True, fg="red")
