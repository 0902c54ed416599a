"""How pictures look: colours that colour-blind readers tell apart, sizes that can be read
in print, and axes to draw on.

A colour never says something alone: a symbol, a line style or a text says it, too.
"""

import re
from typing import Any

from ..tables.fields import tell

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
BLUE = "#0072B2"
RED = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#666666"
"""The colours of Okabe and Ito (2008), and a grey for what stands in the background."""

SERIES = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY, BLACK)
MARKERS = "osD^vPX"
LINES = ("-", "--", "-.", ":")
"""Colours, symbols and line styles of series of which a picture shows several."""

SIZES, DEVIATIONS = "viridis", "cividis_r"
"""Colour maps of values and of standard deviations: the brightness grows evenly."""

WIDTH = 160 / 25.4
"""Width of a picture in inches: the text of a printed page."""

TITLE, TEXT, SMALL = 9.0, 8.0, 7.0
"""Sizes of the letters in points, at this width."""

LONGEST = 120
"""Letters of a line of text that are shown."""

DOLLAR = re.compile(r"(?<!\\)\$")
"""What matplotlib takes for the beginning of a formula."""


def new_figure(height: float = 4.0, width: float = WIDTH) -> Any:
    """An empty figure that nothing shows on a screen, inches. It belongs to nobody
    else: `pyplot` does not know it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def axes_or_new(axes: Any, height: float = 4.0, width: float = WIDTH) -> Any:
    """The axes, or those of a new figure where there are none."""
    return new_figure(height, width).subplots() if axes is None else axes


def plan_or_new(axes: Any, places: Any) -> Any:
    """The axes, or those of a new figure of about the form of the area in which the
    places, (point, 2), lie."""
    if axes is not None:
        return axes
    wide, high = _extent(places)
    longer = max(wide, high)
    width = min(WIDTH, max(4.2, 1.2 + 4.6 * wide / longer))
    inside = width - 1.2 if wide >= high else 4.6
    height = max(2.8, 1.4 + inside * high / longer)
    return new_figure(height, width).subplots()


def two_axes_or_new(axes: Any, height: float = 3.6) -> Any:
    """Both axes, or those of a new figure, side by side."""
    return new_figure(height).subplots(1, 2) if axes is None else axes


def two_plans_or_new(axes: Any, places: Any) -> Any:
    """Both axes, or those of a new figure: side by side, or one below the other where
    the area in which the places, (point, 2), lie is wider than high."""
    if axes is not None:
        return axes
    wide, high = _extent(places)
    if wide > 1.2 * high:
        return new_figure(2 * min(4.2, 2.0 + 5.0 * high / wide)).subplots(2, 1)
    return new_figure(4.2).subplots(1, 2)


def _extent(places: Any) -> tuple[float, float]:
    """Width and height of the area in which places lie; 1 where it has none."""
    import numpy as np

    if not len(places):
        return 1.0, 1.0
    wide, high = np.ptp(np.asarray(places), axis=0).tolist()
    return (wide, high) if max(wide, high) > 0 else (1.0, 1.0)


def plain(text: str) -> str:
    """Text of a user as a picture shows it, once or again: no formula between dollars, no
    control characters, and no more letters than there is room for."""
    lines = [tell(line, LONGEST) for line in text.split("\n")]
    return DOLLAR.sub(r"\\$", "\n".join(lines))


def describe(axes: Any, title: str, x: str, y: str, *, room: float = 6.0) -> Any:
    """Write title and names of the axes; `room` between title and axes, points."""
    axes.set_title(plain(title), fontsize=TITLE, pad=room)
    axes.set_xlabel(plain(x), fontsize=TEXT)
    axes.set_ylabel(plain(y), fontsize=TEXT)
    axes.tick_params(labelsize=TEXT)
    return axes


def make_plan(axes: Any, *, margin: float = 0.1) -> Any:
    """Equal units along both axes, room around what is drawn, and few ticks, whose
    numbers have no offset."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(margin)
    axes.use_sticky_edges = False
    axes.locator_params(nbins=5)
    axes.ticklabel_format(useOffset=False, style="plain")
    return axes


def add_legend(axes: Any, columns: int = 4) -> Any:
    """Write the legend below the axes, where it hides nothing; none without labels."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return None
    return axes.legend(
        handles,
        labels,
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        borderaxespad=4.5,  # letters: below ticks and name of the axis
        ncols=min(columns, len(handles)),
        fontsize=SMALL,
        frameon=False,
        handletextpad=0.4,
        columnspacing=1.2,
    )


def add_colours(axes: Any, drawn: Any, label: str, *, below: bool = False) -> Any:
    """Write the scale of the colours of `drawn` beside the axes, or below them."""
    where = "bottom" if below else "right"
    bar = axes.figure.colorbar(
        drawn, ax=axes, location=where, shrink=0.85, aspect=40 if below else 25
    )
    bar.set_label(plain(label), fontsize=TEXT)
    bar.ax.tick_params(labelsize=TEXT)
    bar.ax.locator_params(nbins=5)
    return bar


def times(factor: float) -> str:
    """How many times larger something is drawn: "× 2000"."""
    return f"× {factor:.10g}" if factor < 1e10 else f"× {factor:g}"


def with_unit(name: str, unit: str) -> str:
    """The name of an axis."""
    return f"{name} [{unit}]" if unit else name
