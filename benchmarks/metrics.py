"""A benchmark is a contract: what was measured, what is promised, how far it may
slip."""

import re
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

RESULTS = Path(__file__).with_name("results.md")
START, END = "<!-- measured -->", "<!-- end of measured -->"


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
    def of_the_machine(self) -> bool:
        """Whether it is a time, which says nothing on another machine."""
        return self.unit.split()[0] in ("s", "ms", "µs", "ns")

    def reaches(self, bound: float) -> bool:
        """Whether the value is at least as good as `bound`."""
        return (
            self.value >= bound if self.direction == "higher" else self.value <= bound
        )

    def held_against(self, committed: float) -> bool:
        """Whether the value is within the tolerance of the committed one."""
        slack = 1 - self.tolerance if self.direction == "higher" else 1 + self.tolerance
        return self.reaches(committed * slack)

    def row(self) -> str:
        """The line of the results table."""
        goal = (
            ""
            if self.goal is None
            else f"{'>=' if self.direction == 'higher' else '<='} {self.goal:g}"
        )
        verdict = (
            ""
            if self.goal is None
            else ("yes" if self.reaches(self.goal) else "**no**")
        )
        return (
            f"| {self.key} | {self.value:.4g} | {self.unit} | {self.direction} | "
            f"{goal} | {verdict} |"
        )


def table(metrics: Iterable[Metric]) -> str:
    """All metrics as a Markdown table."""
    head = (
        "| metric | value | unit | better | goal | reached |\n|---|---|---|---|---|---|"
    )
    return "\n".join([head, *(metric.row() for metric in metrics)])


def committed() -> dict[str, float]:
    """key -> value of the table in results.md."""
    text = RESULTS.read_text() if RESULTS.exists() else ""
    rows = re.findall(
        r"^\| (.+?) \| (\S+) \|",
        text.partition(START)[2].partition(END)[0],
        re.MULTILINE,
    )
    return {key: float(value) for key, value in rows if key not in ("metric", "---")}


def write(metrics: Iterable[Metric], machine: str) -> None:
    """Puts the table between the markers of results.md; the text around them stays."""
    before, _, rest = RESULTS.read_text().partition(START)
    RESULTS.write_text(
        f"{before}{START}\n{machine}\n\n{table(metrics)}\n{END}{rest.partition(END)[2]}"
    )


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
