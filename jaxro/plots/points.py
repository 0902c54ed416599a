"""Tests of the points of a pair, one bar a point, with the limits beyond which a point is
marked and named."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..assessment.reliability import Reliability
from ..geometry.pairs import Pair
from ..rejection import LeaveOneOutGrubbs, Rejection
from ..rejection.base import AbstractProcedure
from .labels import NAMED, show_name
from .style import (
    BLACK,
    BLUE,
    GREY,
    RED,
    SMALL,
    TEXT,
    add_legend,
    axes_or_new,
    describe,
)

MOST = 60
"""Bars that a picture shows, those of the largest values."""


def draw_bars(
    values: Float[np.ndarray, " point"],
    limit: float,
    *,
    names: Sequence[str] = (),
    both_sides: bool = True,
    title: str = "Tests of points",
    of: str = "w",
    axes: Any = None,
) -> Any:
    """A bar for each value, in the order of the points; lines at the limit, and at minus
    it for tests of `both_sides`. Values beyond it are hatched bars with a name; a value
    that is not finite (a point that nothing tests) is a circle at zero. Of many points
    the `MOST` with the largest values are shown, which the title says."""
    axes = axes_or_new(axes, height=2.6)
    names = [show_name(str(n)) for n in names] or [
        str(k + 1) for k in range(len(values))
    ]
    size = np.nan_to_num(np.abs(values) if both_sides else values, nan=-np.inf)
    shown = np.sort(np.argsort(-size, kind="stable")[:MOST])
    at, value, size = np.arange(len(shown)), values[shown], size[shown]
    finite, beyond = np.isfinite(value), size > limit
    plain = finite & ~beyond
    axes.bar(at[plain], value[plain], 0.7, color=BLUE, label="within the limit")
    if np.any(beyond):
        how = {"color": RED, "hatch": "///", "edgecolor": BLACK, "linewidth": 0.5}
        top = np.where(np.isfinite(value), value, 1.3 * limit)[beyond]
        axes.bar(at[beyond], top, 0.7, label="beyond the limit", **how)
    if not np.all(finite | beyond):
        free = at[~(finite | beyond)]
        how = {"mec": GREY, "mfc": "none", "ms": 5}
        axes.plot(free, np.zeros(len(free)), "o", label="not testable", **how)
    if np.isfinite(limit):
        for k, level in enumerate((limit, -limit)[: 1 + both_sides]):
            label = f"limit {limit:.2f}" if k == 0 else None
            axes.axhline(level, color=BLACK, linestyle="--", lw=1.0, label=label)
    axes.axhline(0.0, color=BLACK, lw=0.6)
    few = len(values) > len(shown)
    count = f", the {len(shown)} largest of {len(values)} points" if few else ""
    describe(axes, title + count, "point", of)
    _write_names(axes, [names[k] for k in shown], value, beyond, limit)
    axes.margins(x=0.01, y=0.15)
    add_legend(axes)
    return axes


def draw_tests(
    reliability: Reliability, *, names: Sequence[str] = (), axes: Any = None
) -> Any:
    """Normalised residuals w of the points in use (tau, where sigma0 is estimated) with
    the limit of their tests."""
    used = np.asarray(reliability.used)
    w = np.where(np.asarray(reliability.testable), np.asarray(reliability.w), np.nan)
    of, what = ("w", "Normalised residuals w")
    if not reliability.known:
        of, what = ("tau", "Normalised residuals tau (sigma0 estimated)")
    level = 100 * float(reliability.level)
    return draw_bars(
        w[used],
        float(reliability.limit),
        names=_of(names, used),
        title=f"{what}, level {level:.3g} % a point",
        of=of,
        axes=axes,
    )


def draw_round(
    found: Rejection,
    number: int = 0,
    *,
    names: Sequence[str] = (),
    title: str = "",
    of: str = "statistic",
    both_sides: bool = False,
    axes: Any = None,
) -> Any:
    """The test statistics of a round of a procedure, counted from 0, of the points that
    were in use in it, with the limit of the round. Raises ValueError for a round that
    did not take place."""
    log = found.log
    happened = np.asarray(log.happened)
    if number >= len(happened) or not happened[number]:
        raise ValueError(
            f"draw_round: the procedure made {int(np.sum(happened))} rounds, there is "
            f"no round {number} (they are counted from 0)"
        )
    rejected = np.asarray(log.rejected)
    used = ~np.any(rejected[:number], axis=0)
    used &= np.asarray(found.mask) | np.any(rejected, axis=0)
    return draw_bars(
        np.asarray(log.statistic)[number][used],
        float(log.limit[number]),
        names=_of(names, used),
        both_sides=both_sides,
        title=title or f"Round {number + 1}",
        of=of,
        axes=axes,
    )


def draw_leave_one_out(
    pair: Pair,
    *,
    procedure: AbstractProcedure | None = None,
    number: int = 0,
    names: Sequence[str] = (),
    axes: Any = None,
) -> Any:
    """How much the mean y-parallax falls when each point in turn is left out, in
    standard deviations of these means (Grubbs' V; Burshtynskaya and Tumskaya 1989).

    `procedure`: `LeaveOneOutGrubbs()` if None, whose limit takes the means for a normal
    sample and is too low; one with limits of the layout comes from
    `jaxro.rejection.calibrate`. `number` of the round, from 0.
    """
    procedure = LeaveOneOutGrubbs() if procedure is None else procedure
    critical = getattr(procedure, "critical", None)
    kind = "Grubbs' formula" if critical is None else "simulated on the layout"
    return draw_round(
        procedure(pair),
        number,
        names=names,
        title=f"Leave-one-out, limit: {kind}",
        of="V",
        axes=axes,
    )


def _of(names: Sequence[str], used: np.ndarray) -> list[str]:
    """The names of the points in use; their numbers from 1 where they have none."""
    every = list(names) or [str(k + 1) for k in range(len(used))]
    return [str(every[k]) for k in np.flatnonzero(used)]


def _write_names(
    axes: Any,
    names: list[str],
    values: np.ndarray,
    beyond: np.ndarray,
    limit: float,
) -> None:
    """All names below the axes if they are few, else none there; and the names of the
    marked bars at their ends."""
    at = np.arange(len(names))
    if len(names) <= NAMED:
        long = max(map(len, names), default=0) * len(names) > 80
        turned = {"rotation": 90} if long else {}
        axes.set_xticks(at, names, fontsize=SMALL, **turned)
    else:
        axes.set_xticks([])
    for k in np.flatnonzero(beyond):
        end = values[k] if np.isfinite(values[k]) else 1.3 * limit
        text = names[k] if np.isfinite(values[k]) else f"{names[k]}: any limit"
        axes.annotate(
            text,
            (k, end),
            (0, 3 if end > 0 else -3),
            textcoords="offset points",
            ha="center",
            va="bottom" if end > 0 else "top",
            fontsize=TEXT,
            color=RED,
        )
