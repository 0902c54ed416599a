"""What the README shows is what happens: its code runs, its outputs are printed, its
tables are the code's lists."""

import inspect
import re
from pathlib import Path
from typing import NamedTuple

import optimistix as optx
import pytest

import jaxro
from jaxro import losses
from jaxro.orientation import starts
from jaxro.rejection import PROCEDURES

TEXT = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


class Block(NamedTuple):
    """One fenced block, with the marker comment above it, if any."""

    marker: str
    language: str
    body: str


BLOCKS = [
    Block(*found)
    for found in re.findall(
        r"(?:<!-- (.*?) -->\n)?^```(\w+)\n(.*?)^```$", TEXT, re.M | re.S
    )
]


def lines(text: str) -> list[str]:
    """Without trailing blanks and empty lines at the ends."""
    return [line.rstrip() for line in text.strip("\n").splitlines()]


def column(heading: str) -> list[str]:
    """The names in code font of the first column of the table whose first heading this
    is."""
    table = re.search(
        rf"^\| {heading} \|.*\n\|[-| ]+\n((?:\|.*\n)+)", TEXT, re.MULTILINE
    )
    assert table, f"README.md has no table that begins with '| {heading} |'"
    return re.findall(r"^\| `([\w-]+)`", table[1], re.MULTILINE)


def final(module, interface: type) -> list[str]:
    return [
        name
        for name, member in vars(module).items()
        if inspect.isclass(member)
        and issubclass(member, interface)
        and not inspect.isabstract(member)
    ]


def test_python_blocks_run_and_print_what_they_show(capsys):
    names: dict = {}
    shown = 0
    for block, following in zip(BLOCKS, [*BLOCKS[1:], Block("", "", "")], strict=True):
        if block.language == "python":
            exec(compile(block.body, "README.md", "exec"), names)
            printed = capsys.readouterr().out
            if following.language == "text" and not following.marker:
                assert lines(printed) == lines(following.body)
                shown += 1
    assert shown


def test_example_output_is_that_of_the_command():
    testing = pytest.importorskip(
        "typer.testing", reason="the command line needs typer and rich"
    )
    from jaxro.cli import app

    shown = next(block.body for block in BLOCKS if block.marker == "example output")
    result = testing.CliRunner(env={"COLUMNS": "100", "NO_COLOR": "1"}).invoke(
        app, ["orient"]
    )
    assert result.exit_code == 0
    assert lines(result.stdout) == lines(shown)


def test_test_command_stands_once():
    (command,) = (block.body for block in BLOCKS if block.marker == "test command")
    assert len(lines(command)) == 1


@pytest.mark.parametrize(
    ("heading", "names"),
    [
        ("element system", final(jaxro, jaxro.AbstractElements)),
        ("start", final(starts, starts.AbstractStart)),
        ("procedure", list(PROCEDURES)),
        ("loss", final(losses, losses.AbstractLoss)),
        (
            "result",
            [
                "successful",
                *(
                    n
                    for n in jaxro.RESULTS._name_to_item
                    if n not in optx.RESULTS._name_to_item
                ),
            ],
        ),
    ],
)
def test_tables_are_the_lists_of_the_code(heading, names):
    assert sorted(column(heading)) == sorted(names)
