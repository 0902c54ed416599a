"""The papers' tables calculated again, and procedures compared by simulation.

Each experiment is a function that returns numbers, and one in a module beside it that
makes tables of them. Those of papers are in REPRODUCTIONS.
"""

from collections.abc import Callable
from typing import NamedTuple

from . import (
    burshtynskaya1989,
    burshtynskaya1989_tables,
    dorozhinsky1971,
    dorozhinsky1971_tables,
    gutkin1982,
    gutkin1982_tables,
)


class Reproduction(NamedTuple):
    """An experiment of a paper: run(), or run(trials, seed, progress) where it is
    `random`, and tables(results)."""

    run: Callable
    tables: Callable
    random: bool
    trials: int = 0


REPRODUCTIONS: dict[str, Reproduction] = {
    "dorozhinsky1971": Reproduction(
        dorozhinsky1971.run, dorozhinsky1971_tables.tables, False
    ),
    "burshtynskaya1989": Reproduction(
        burshtynskaya1989.run,
        burshtynskaya1989_tables.tables,
        True,
        burshtynskaya1989.VARIANTS,
    ),
    "gutkin1982": Reproduction(gutkin1982.run, gutkin1982_tables.tables, False),
}
"""By the name on the command line."""
