"""The command line: `jaxro NAME`, and what `jaxro --help` shows of it.

Exit code 0: every result is usable; 1: at least one is not; 2: the input could not be
used.
"""

from collections.abc import Callable

try:
    import typer
    from typer.core import TyperGroup
except ModuleNotFoundError:
    raise SystemExit(
        "The command line needs typer and rich: pip install 'jaxro[cli]'"
    ) from None

from .commands.lines import options as given
from .commands.lines.absolute import absolute
from .commands.lines.adjust import adjust
from .commands.lines.block import block
from .commands.lines.calibrate import calibrate
from .commands.lines.clean import clean
from .commands.lines.colmap import colmap
from .commands.lines.heights import heights, plan
from .commands.lines.orient import orient
from .commands.lines.simulate import compare, reproduce

GROUPS: dict[str, tuple[Callable, ...]] = {
    "Pairs of photos": (orient, clean, compare),
    "Cameras": (calibrate,),
    "Many photos": (block, absolute, colmap),
    "Heights over a grid": (heights, plan),
    "Geodetic networks": (adjust,),
    "Published papers": (reproduce,),
}
"""The commands by what they are for, in the order of the help."""

TRY = "Without a file most commands work on an example: try jaxro orient."


class Grouped(TyperGroup):
    """Lists the commands by what they are for."""

    def format_commands(self, ctx, formatter) -> None:
        """As of click, a list for each of `GROUPS`."""
        width = max(map(len, self.commands))
        for title, functions in GROUPS.items():
            names = [function.__name__ for function in functions]
            rows = [
                (n.ljust(width), self.commands[n].get_short_help_str(64)) for n in names
            ]
            with formatter.section(title):
                formatter.write_dl(rows)
        formatter.write_paragraph()
        formatter.write_text(TRY)


app = typer.Typer(
    cls=Grouped,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    rich_markup_mode=None,
)


@app.callback()
def main(version: given.Version = False) -> None:
    """Adjustment of photogrammetric measurements: relative orientation, wrong points,
    cameras, blocks, heights, with standard deviations of everything."""


for _functions in GROUPS.values():
    for _function in _functions:
        app.command()(_function)
