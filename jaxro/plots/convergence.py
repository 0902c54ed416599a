"""How fast an adjustment comes to its minimum."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..geometry.elements import AbstractElements, vertical
from ..geometry.pairs import Pair, double
from ..orientation.orient import orient
from .style import (
    BLACK,
    LINES,
    MARKERS,
    SERIES,
    add_legend,
    axes_or_new,
    describe,
    plain,
)

AT_REST = 1e-12
"""Relative change of the sum of squares below which it is at rest."""


def sums_by_step(
    pair: Pair,
    start: AbstractElements | None = None,
    *,
    steps: int = 15,
    **options: Any,
) -> list[float]:
    """The sum of squares of the whitened residuals at the start, and after each step of
    the adjustment until it rests, or after so many `steps`.

    `start`: known elements, those of vertical photos if None. Other `options` are those
    of `orient`. Each step is an adjustment of its own from the elements of the one
    before, so that one program makes all of them.
    """
    pair = double(pair)
    found: Any = vertical(pair.focal_left) if start is None else start
    first = orient(pair, start=found, max_steps=0, **options)
    sums = [_squares(first)]
    for _ in range(steps):
        one = orient(pair, start=found, max_steps=1, **options)
        sums.append(_squares(one))
        found = one.pose
        if not abs(sums[-2] - sums[-1]) > AT_REST * sums[-1]:
            break
    return sums


def draw_sums(
    sums: Mapping[str, Sequence[float]],
    *,
    unit: str = "",
    title: str = "Sum of squares by iteration",
    axes: Any = None,
) -> Any:
    """Sums of squares by iteration, one line for each name, on a logarithmic axis; the
    smallest of all is drawn as a limit. `unit` of the sums."""
    axes = axes_or_new(axes, height=3.0)
    least = min(min(values) for values in sums.values())
    for k, (name, values) in enumerate(sums.items()):
        axes.semilogy(
            range(len(values)),
            values,
            LINES[k % len(LINES)],
            marker=MARKERS[k % len(MARKERS)],
            color=SERIES[k % len(SERIES)],
            ms=5,
            label=plain(name),
        )
    axes.axhline(least, color=BLACK, ls=":", lw=1.0, label=f"minimum {least:.4g}")
    axes.xaxis.get_major_locator().set_params(integer=True)
    describe(axes, title, "iteration", f"sum of squares{unit and f' [{unit}]'}")
    axes.grid(axis="y", alpha=0.3)
    add_legend(axes)
    return axes


def draw_convergence(
    pair: Pair,
    start: AbstractElements | None = None,
    *,
    unit: str = "",
    axes: Any = None,
    **options: Any,
) -> Any:
    """The sums of squares of the adjustment of a pair by iteration (`sums_by_step`)."""
    name = "from vertical photos" if start is None else "from the given elements"
    return draw_sums({name: sums_by_step(pair, start, **options)}, unit=unit, axes=axes)


def _squares(orientation: Any) -> float:
    return float(np.sum(np.square(np.asarray(orientation.residuals))))
