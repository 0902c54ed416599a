"""What each point does to the result: how well others check it, and what an error that
stays hidden in it would do."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..assessment.reliability import BOUNDS, CONTROL, Reliability
from .labels import NAMED, show_name
from .points import MOST
from .style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    RED,
    SMALL,
    add_legend,
    axes_or_new,
    describe,
    new_figure,
    with_unit,
)

CLASSES = ((RED, "xxx"), (ORANGE, "///"), (GREEN, "..."), (BLUE, ""))
"""Colour and hatch of the classes of control, the worst one first."""


def draw_redundancy(
    redundancy: Float[np.ndarray, " point"],
    *,
    names: Sequence[str] = (),
    title: str = "Redundancy numbers: how well the others check each point",
    axes: Any = None,
) -> Any:
    """A bar for each point, which tells the class of its control (Förstner 1979) by
    colour and hatch, and lines at the borders between classes. Of many points those with
    the smallest numbers are shown."""
    axes = axes_or_new(axes, height=2.6)
    r = np.asarray(redundancy)
    shown = np.sort(np.argsort(r, kind="stable")[:MOST])
    at, value = np.arange(len(shown)), r[shown]
    kinds = np.searchsorted(BOUNDS, value, side="right")
    for kind, (colour, hatch) in enumerate(CLASSES):
        which = kinds == kind
        if np.any(which):
            how = {"hatch": hatch, "edgecolor": BLACK, "linewidth": 0.5}
            label = f"{CONTROL[kind]} checked"
            axes.bar(at[which], value[which], 0.7, color=colour, label=label, **how)
    for bound in BOUNDS:
        axes.axhline(bound, color=BLACK, lw=0.8, ls=":")
    axes.set_ylim(0, max(1.0, float(np.max(value, initial=0.0))))
    _finish(axes, title, "redundancy number", names, shown, len(r))
    add_legend(axes)
    return axes


def draw_hidden(
    sizes: Float[np.ndarray, " point"],
    *,
    names: Sequence[str] = (),
    title: str = "Effect of an undetected error",
    of: str = "effect",
    axes: Any = None,
) -> Any:
    """A bar for each point: what the largest error that its test leaves hidden does. A
    point in which no error shows has no bound: a hatched bar up to the border. Of many
    points those with the largest effects are shown."""
    axes = axes_or_new(axes, height=2.6)
    effect = np.abs(np.asarray(sizes))
    shown = np.sort(np.argsort(-effect, kind="stable")[:MOST])
    at, value = np.arange(len(shown)), effect[shown]
    finite = np.isfinite(value)
    top = 1.15 * float(np.max(value[finite], initial=0.0)) or 1.0
    if np.any(finite):
        axes.bar(at[finite], value[finite], 0.7, color=BLUE, label="at most")
    if not np.all(finite):
        how = {"hatch": "xxx", "edgecolor": BLACK, "linewidth": 0.5}
        label = "without bound: no error shows"
        axes.bar(at[~finite], top, 0.7, color=RED, label=label, **how)
        add_legend(axes)
    axes.set_ylim(0, top)
    _finish(axes, title, of, names, shown, len(effect))
    return axes


def draw_influence(
    reliability: Reliability,
    *,
    names: Sequence[str] = (),
    unit: str = "",
    coordinates: tuple[int, ...] = (1, 3),
    axes: Any = None,
) -> Any:
    """Three pictures, one below the other, of the points in use: redundancy numbers;
    what an error that stays undetected does to the elements, in their standard
    deviations at most; and how far it moves the model height of its own point, `unit`,
    by the worse of y_left and y_right, or of the `coordinates` with other numbers in
    x_left, y_left, x_right, y_right. `axes`: all three."""
    used = np.asarray(reliability.used)
    every = list(names) or [str(k + 1) for k in range(len(used))]
    effects = [np.abs(np.asarray(reliability.effect_height[k])) for k in coordinates]
    return draw_influences(
        np.asarray(reliability.redundancy)[used],
        np.asarray(reliability.external)[used],
        np.max(effects, axis=0)[used],
        names=[str(every[k]) for k in np.flatnonzero(used).tolist()],
        unit=unit,
        power=reliability.power,
        axes=axes,
    )


def draw_influences(
    redundancy: Float[np.ndarray, " point"],
    on_elements: Float[np.ndarray, " point"],
    on_heights: Float[np.ndarray, " point"],
    *,
    names: Sequence[str] = (),
    unit: str = "",
    power: float = 0.80,
    axes: Any = None,
) -> Any:
    """The same of plain arrays; `power` with which the errors are found whose effects
    are given."""
    if axes is None:
        axes = new_figure(6.6).subplots(3, 1)
    first, second, third = axes
    draw_redundancy(redundancy, names=names, axes=first)
    draw_hidden(
        on_elements,
        names=names,
        title=f"Effect on the elements of an error found in {100 * power:g} % of cases",
        of="standard deviations",
        axes=second,
    )
    draw_hidden(
        on_heights,
        names=names,
        title="Effect of the same error on the model height of its point",
        of=with_unit("height", unit),
        axes=third,
    )
    return axes


def _finish(
    axes: Any, title: str, of: str, names: Sequence[str], shown: np.ndarray, count: int
) -> None:
    """Title and names; how many of the points are shown."""
    few = f", the worst {len(shown)} of {count} points" if count > len(shown) else ""
    describe(axes, title + few, "point", of)
    axes.margins(x=0.01)
    if len(shown) > NAMED:
        axes.set_xticks([])
        return
    every = [show_name(str(n)) for n in names] or [str(k + 1) for k in range(count)]
    texts = [every[k] for k in shown]
    long = max(map(len, texts), default=0) * len(texts) > 80
    axes.set_xticks(
        np.arange(len(shown)), texts, fontsize=SMALL, rotation=90 if long else 0
    )
