"""results.md: a page that is made of the committed figures.

A key reads "workload: figure". Figures of one workload are joined in a row, and those
of several programs after each other. The section follows from the unit: lengths and
angles are differences between programs, "times" are ratios, shares and counts say how
many answers are right. All single figures, times too, stand in baseline.json.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from .metrics import Baseline, Metric

PAGE = Path(__file__).with_name("results.md")
DEVICES = Path(__file__).with_name("devices.json")

INTRODUCTION = """\
# What was measured

`python -m benchmarks --update-baseline` makes this page of [baseline.json](baseline.json). Answers
are compared before times are measured. The other programs take turns with ours: PoseLib and OpenCV
in processes of their own, stock `optimistix.GaussNewton` under `jit(vmap)` on the same residual.
Times differ by half between two runs on one machine: only ratios of one suite count. A goal stands
in brackets, in bold where it is missed; [decisions.md](decisions.md) says why."""

SECTIONS = {
    "accuracy": "Accuracy: largest difference from other programs and independent fits",
    "answers": "Right and wrong answers (shares of all pairs, counts a pair)",
    "ratios": "Ratios (times; against a program: its time over ours) and other goals",
}


class Row(NamedTuple):
    """One figure: the workload, what was measured, of which program, and the text."""

    workload: str
    what: str
    who: str
    text: str


def page(baseline: Baseline) -> str:
    """The text of results.md."""
    parts = [INTRODUCTION, baseline.machine, *_earlier(baseline)]
    shown = _without_details(baseline.metrics)
    for section, title in SECTIONS.items():
        rows = [_split(metric) for metric in shown if _section(metric) == section]
        if rows:
            parts += [f"## {title}", _table(rows, folded=section != "answers")]
    parts += ["## Other devices", _devices()]
    parts += ["## Goals missed", _missed(baseline.metrics)]
    return "\n\n".join(parts) + "\n"


def _devices() -> str:
    """A line for each device that `benchmarks.devices` was run on."""
    measured = json.loads(DEVICES.read_text(encoding="utf-8"))
    lines = ["From host memory to host memory, million pairs a second, float64:"]
    for device, figures in measured.items():
        told = "; ".join(f"{name} {value:g}" for name, value in figures.items())
        lines.append(f"* {device}: {told}")
    return "\n".join([lines[0], "", *lines[1:]])


def _earlier(baseline: Baseline) -> list[str]:
    """A line for each day but the last, with the suites that were measured then."""
    days = _grouped(baseline.suites.items(), lambda item: item[1].measured)
    last = max(days)
    return [
        f"Measured {day}: {', '.join(name for name, _ in suites)}."
        for day, suites in days.items()
        if day != last
    ]


def write_page(baseline: Baseline) -> None:
    """Write results.md."""
    PAGE.write_text(page(baseline), encoding="utf-8")


def _section(metric: Metric) -> str | None:
    """The section of a figure; None for what stands in baseline.json alone."""
    if metric.unit in ("rad", "mm"):
        return "accuracy"
    if metric.unit in ("of 1", "a pair", "pairs") and "share of" not in metric.key:
        return "answers"
    return "ratios" if metric.unit == "times" or metric.goal is not None else None


def _split(metric: Metric) -> Row:
    workload, colon, figure = metric.key.partition(": ")
    if not colon:
        workload, _, figure = metric.key.partition(", ")
    what, who = figure, ""
    if _section(metric) == "answers" and ", " in figure:
        what, _, who = figure.partition(", ")
    unit = "" if metric.unit in ("times", "of 1", "a pair") else f" {metric.unit}"
    text = f"{metric.value:.3g}{unit}"
    if metric.goal is not None:
        goal = f"({metric.goal_text})"
        text += f" **{goal}**" if metric.missed else f" {goal}"
    return Row(workload, what, who, text)


def _without_details(metrics: Iterable[Metric]) -> list[Metric]:
    """Leave out workloads that are parts of another one ("A, forward" of "A")."""
    metrics = list(metrics)
    workloads = {_split(metric).workload for metric in metrics}
    whole = lambda name: name.rpartition(", ")[0] not in workloads
    return [metric for metric in metrics if whole(_split(metric).workload)]


def _table(rows: list[Row], *, folded: bool) -> str:
    """A line for each workload; `folded`: for all workloads that differ in their last
    part only, as the number of points."""
    lines = ["| workload | figures |", "|---|---|"]
    family = lambda row: row.workload.rpartition(", ")[0] or row.workload
    for name, members in _grouped(
        rows, family if folded else lambda row: row.workload
    ).items():
        cells = []
        for workload, figures in _grouped(members, lambda row: row.workload).items():
            label = workload.removeprefix(name).removeprefix(", ")
            cells.append((f"*{label}:* " if label else "") + _cell(figures))
        lines.append(f"| {name} | {' / '.join(cells)} |")
    return "\n".join(lines)


def _cell(rows: list[Row]) -> str:
    """All figures of a workload; those of several programs behind one another."""
    figures = []
    for what, programs in _grouped(rows, lambda row: row.what).items():
        texts = ", ".join(f"{row.who} {row.text}".strip() for row in programs)
        figures.append(f"{what}{':' if programs[0].who else ''} {texts}".strip())
    return "; ".join(figures)


def _missed(metrics: Iterable[Metric]) -> str:
    """A line for each goal that several workloads miss, and for each workload that misses
    goals of its own."""
    lines, alone = [], []
    for (what, goal), missed in _grouped(
        [metric for metric in metrics if metric.missed],
        lambda metric: (_split(metric).what, metric.goal_text),
    ).items():
        if len(missed) == 1:
            alone += missed
            continue
        values = "; ".join(
            f"{_split(metric).workload} {metric.value:.3g} {metric.unit}"
            for metric in missed
        )
        lines.append(f"* {what} {goal}: {values}".replace("*  ", "* "))
    for workload, missed in _grouped(alone, lambda m: _split(m).workload).items():
        values = "; ".join(
            f"{_split(metric).what} {metric.value:.3g} {metric.unit} "
            f"({metric.goal_text})".lstrip()
            for metric in missed
        )
        lines.append(f"* {workload}: {values}")
    return "\n".join(lines) or "None."


def _grouped(items: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """The items by their keys, in the order in which these first come."""
    groups: dict[Any, list[Any]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups
