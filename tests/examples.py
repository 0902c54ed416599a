"""The examples of the command line, each run once in a session for all tests: what it
said, and what it wrote."""

import json
import os
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest

ARGUMENTS = {
    "orient": ("orient",),
    "clean": ("clean",),
    "calibrate": ("calibrate", "--model", "one-f"),
    "block": ("block", "--models", "4", "--seed", "3"),
    "heights": ("heights",),
}
"""By name, without the options that ask for files."""


class Outcome(NamedTuple):
    """What an example said, and where its files are. Tests only read them.

    `out`, `report`, `plots`: what the options of these names wrote. `json`: what
    standard output holds where `--json` is asked for; `json_code`: the exit code then.
    """

    exit_code: int
    stdout: str
    stderr: str
    json_code: int
    json: str
    out: Path
    report: Path
    plots: Path


@pytest.fixture(scope="session")
def example(tmp_path_factory) -> Callable[[str], Outcome]:
    """`example("orient")` is the outcome of `jaxro orient`. Processes that share the
    tests share the outcomes; each waits only for the example that it needs."""
    pytest.importorskip("typer", reason="the command line needs typer and rich")
    pytest.importorskip("jinja2", reason="reports need jinja2")
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    from filelock import FileLock

    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # that of all workers
    folder = folder / "examples"
    folder.mkdir(exist_ok=True)

    @cache
    def outcome(name: str) -> Outcome:
        place = folder / name
        with FileLock(folder / f"{name}.lock"):
            if not (place / "said.json").exists():
                shutil.rmtree(place, ignore_errors=True)  # of one that was stopped
                place.mkdir()
                (place / "said.json").write_text(json.dumps(call(name, place)))
        said = json.loads((place / "said.json").read_text())
        return Outcome(**said, **files(place))

    return outcome


def files(place: Path) -> dict[str, Path]:
    """Where an example writes. `out` is in a folder that the command has to make."""
    return {
        "out": place / "new" / "out",
        "report": place / "report.html",
        "plots": place / "plots",
    }


def call(name: str, place: Path) -> dict[str, Any]:
    """Run an example with all its files, and once more with `--json` alone."""
    from command_line import run

    wanted = [f for kind, at in files(place).items() for f in (f"--{kind}", at)]
    told = run(*ARGUMENTS[name], *wanted)
    for_programs = run(*ARGUMENTS[name], "--json")
    return {
        "exit_code": told.exit_code,
        "stdout": told.stdout,
        "stderr": told.stderr,
        "json_code": for_programs.exit_code,
        "json": for_programs.stdout,
    }
