"""How many programs the tests of each folder compile, and how many they may.

Most of the time of the tests goes into compiling. A test that asks for many small
programs, or a change of the package that compiles for every number, shows here before
it shows on a clock. A run that finds kept programs counts fewer.
"""

from collections import Counter
from pathlib import Path

import jax
import pytest

BUDGET = {
    "adjustment": 750,
    "assessment": 2000,
    "batches": 850,
    "block": 1600,
    "calibration": 1800,
    "colmap": 200,
    "commands": 2000,
    "exchange": 1300,
    "experiments": 200,
    "geometry": 600,
    "laws": 400,
    "orientation": 850,
    "plots": 1100,
    "published": 250,
    "rejection": 1150,
    "reports": 900,
    "statistics": 400,
    "surveys": 1400,
    "tables": 50,
    "texts": 900,
    "xla": 600,
}
"""Programs that the tests of a folder may compile in a whole run: twice what they do,
because what two files share depends on which process runs them; the examples of the
command line count for the folder that asks first."""

TESTS = Path(__file__).parent
COMPILED = "/jax/core/compile/backend_compile_duration"


class Budget:
    """Counts the programs of each folder in this process; where several processes share
    the tests, the one that starts them adds up."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._folder = "before the tests"
        jax.monitoring.register_event_duration_secs_listener(self._count)

    def _count(self, event: str, seconds: float, **_: object) -> None:
        if event == COMPILED:
            self.counts[self._folder] += 1

    @property
    def exceeded(self) -> dict[str, int]:
        """The folders that compiled more than they may."""
        return {
            folder: count
            for folder, count in self.counts.items()
            if count > BUDGET.get(folder, count)
        }

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        folder = item.path.relative_to(TESTS).parts[0]
        self._folder = "texts" if folder.endswith(".py") else folder

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node, error) -> None:
        self.counts.update(getattr(node, "workeroutput", {}).get("programs", {}))

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        output = getattr(session.config, "workeroutput", None)
        if output is not None:
            output["programs"] = dict(self.counts)
        elif self.exceeded and "slow" not in session.config.option.markexpr.split():
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter) -> None:
        write = terminalreporter.write_line
        write(f"programs compiled: {sum(self.counts.values())}")
        for folder, count in sorted(self.exceeded.items()):
            write(
                f"{folder}: {count} programs, {BUDGET[folder]} are allowed "
                "(tests/program_budget.py): share sizes and results, or raise the number",
                red=True,
            )
