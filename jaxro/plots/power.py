"""Power of procedures: which share of the wrong points each finds, over their size."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from .style import (
    LINES,
    MARKERS,
    SERIES,
    add_legend,
    axes_or_new,
    describe,
)


class Curve(NamedTuple):
    """Power of one procedure: the `found` shares of the wrong points at errors of these
    `sizes` (standard deviations), the standard errors of the shares, and the share of
    pairs without errors that lost a point (`false_alarms`, None where nobody asked)."""

    procedure: str
    sizes: Sequence[float]
    found: Sequence[float]
    errors: Sequence[float]
    false_alarms: float | None = None


def draw_power(
    curves: Sequence[Curve], *, title: str = "Power", axes: Any = None
) -> Any:
    """One line for each procedure, by colour, symbol and line style, with bars of two
    standard errors; the legend tells its false alarms in percent. Procedures that reject
    more find more: compare those with the same false alarms."""
    axes = axes_or_new(axes, height=4.2)
    for k, curve in enumerate(curves):
        order = sorted(range(len(curve.sizes)), key=lambda i: curve.sizes[i])
        sorted_by_size = lambda values: [values[i] for i in order]  # noqa: B023
        alarms = curve.false_alarms
        told = "" if alarms is None else f" ({100 * alarms:.1f} % false alarms)"
        axes.errorbar(
            sorted_by_size(curve.sizes),
            [100 * share for share in sorted_by_size(curve.found)],
            yerr=[200 * error for error in sorted_by_size(curve.errors)],
            color=SERIES[k % len(SERIES)],
            marker=MARKERS[k % len(MARKERS)],
            linestyle=LINES[k % len(LINES)],
            ms=5,
            lw=1.3,
            capsize=2,
            label=f"{curve.procedure}{told}",
        )
    describe(
        axes, title, "size of the error [standard deviations]", "wrong points found [%]"
    )
    axes.set_ylim(-3, 103)
    axes.grid(alpha=0.3)
    add_legend(axes, columns=2)
    return axes
