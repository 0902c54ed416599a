"""How a command ends: its exit code, and what is told meanwhile."""

from collections.abc import Callable

import typer

from ..tables.fields import TableError


def end(work: Callable[[], bool]) -> None:
    """Do the work with compiled programs kept; the exit code says how it ended.

    0: all is usable; 1: some of it is not; 2: the input could not be used; 130: Ctrl-C.
    """
    from ..reports.terminal import abort, say_compiling
    from ..xla import programs, store

    programs.watch(say_compiling)
    store.use(store.default_folder())
    try:
        good = work()
    except KeyboardInterrupt:
        abort()
    except TableError as error:
        typer.secho(f"Error: {error}", err=True, fg="red")
        raise typer.Exit(2) from None
    raise typer.Exit(0 if good else 1)
