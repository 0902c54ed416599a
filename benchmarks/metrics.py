"""One measured figure, what is promised of it, and how far it may slip; and the
committed figures."""

import json
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

BASELINE = Path(__file__).with_name("baseline.json")


@dataclass(frozen=True)
class Metric:
    """One measured figure. `tolerance` is the share by which it may be worse than the
    committed one."""

    key: str
    value: float
    unit: str
    direction: Literal["higher", "lower"]
    tolerance: float = 0.25
    goal: float | None = None

    @property
    def is_time(self) -> bool:
        """Whether it is a time, which says nothing on another machine."""
        return self.unit.split()[0] in ("s", "ms", "µs", "ns")

    @property
    def missed(self) -> bool:
        """Whether it has a goal and does not reach it."""
        return self.goal is not None and not self.reaches(self.goal)

    def reaches(self, bound: float) -> bool:
        """Whether the value is at least as good as `bound`."""
        return (
            self.value >= bound if self.direction == "higher" else self.value <= bound
        )

    def holds(self, committed: float) -> bool:
        """Whether the value is within the tolerance of the committed one."""
        slack = 1 - self.tolerance if self.direction == "higher" else 1 + self.tolerance
        return self.reaches(committed * slack)

    @property
    def goal_text(self) -> str:
        """The goal as a bound: ">= 8"; empty without a goal."""
        if self.goal is None:
            return ""
        return f"{'>=' if self.direction == 'higher' else '<='} {self.goal:.3g}"

    def row(self) -> str:
        """The line of a Markdown table."""
        reached = "" if self.goal is None else "**no**" if self.missed else "yes"
        return (
            f"| {self.key} | {self.value:.4g} | {self.unit} | {self.direction} | "
            f"{self.goal_text} | {reached} |"
        )


class Suite(NamedTuple):
    """The figures of one suite, which are compared with each other, and their day."""

    measured: str
    metrics: list[Metric]


class Baseline(NamedTuple):
    """The committed figures by suite, and the machine that measured last, in a line."""

    machine: str
    suites: dict[str, Suite]

    @property
    def metrics(self) -> list[Metric]:
        """All figures."""
        return [metric for suite in self.suites.values() for metric in suite.metrics]

    def values(self) -> dict[str, float]:
        """The value of each figure by its key."""
        return {metric.key: metric.value for metric in self.metrics}


def table(metrics: Iterable[Metric]) -> str:
    """All metrics as a Markdown table."""
    head = (
        "| metric | value | unit | better | goal | reached |\n|---|---|---|---|---|---|"
    )
    return "\n".join([head, *(metric.row() for metric in metrics)])


def read_baseline() -> Baseline:
    """The figures of baseline.json. Tolerances are not among them: those of the code
    hold."""
    content = json.loads(BASELINE.read_text(encoding="utf-8"))
    suites = {
        name: Suite(
            suite["measured"], [_metric(*item) for item in suite["figures"].items()]
        )
        for name, suite in content["suites"].items()
    }
    return Baseline(content["machine"], suites)


def _metric(key: str, entry: Mapping[str, Any]) -> Metric:
    goal = entry.get("goal")
    return Metric(key, entry["value"], entry["unit"], entry["better"], goal=goal)


def write_baseline(baseline: Baseline) -> None:
    """Write baseline.json, one figure a line, so that a change of one figure changes
    one line."""
    suites = ",\n".join(
        f"    {_json(name)}: {{\n"
        f'      "measured": {_json(suite.measured)},\n'
        f'      "figures": {{\n{_lines(suite.metrics)}\n      }}\n'
        "    }"
        for name, suite in baseline.suites.items()
    )
    BASELINE.write_text(
        f'{{\n  "machine": {_json(baseline.machine)},\n'
        f'  "suites": {{\n{suites}\n  }}\n}}\n',
        encoding="utf-8",
    )


def _lines(metrics: Iterable[Metric]) -> str:
    """A line for each figure."""
    return ",\n".join(
        f"        {_json(metric.key)}: {_json(_entry(metric))}" for metric in metrics
    )


def _entry(metric: Metric) -> dict[str, Any]:
    short = lambda number: float(f"{number:.4g}")
    goal = {} if metric.goal is None else {"goal": short(metric.goal)}
    found = {"value": short(metric.value), "unit": metric.unit}
    return found | {"better": metric.direction} | goal


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def median_seconds(
    contestants: Mapping[str, Callable[[], object]], repeats: int
) -> dict[str, float]:
    """Median wall time of each call; the contestants take turns, so that a disturbance
    meets all of them."""
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(repeats):
        for name, call in contestants.items():
            begin = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - begin)
    return {name: statistics.median(values) for name, values in times.items()}
