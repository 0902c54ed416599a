"""README and docs show what happens: their code runs, their outputs are printed, their
commands exist, their tables are the code's lists."""

import importlib
import inspect
import re
import shlex
import sys
from pathlib import Path
from typing import NamedTuple

import optimistix as optx
import pytest

import jaxro
from jaxro import losses
from jaxro.orientation import starts
from jaxro.rejection import PROCEDURES

ROOT = Path(__file__).parents[1]
TEXTS = {
    str(file.relative_to(ROOT)): file.read_text(encoding="utf-8")
    for file in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
}
EXAMPLE = "output of: "


class Block(NamedTuple):
    """One fenced block, with the marker comment above it, if any."""

    marker: str
    language: str
    body: str


BLOCKS = {
    name: [
        Block(*found)
        for found in re.findall(
            r"(?:<!-- (.*?) -->\n)?^```(\w+)\n(.*?)^```$", text, re.M | re.S
        )
    ]
    for name, text in TEXTS.items()
}
OF_PYTHON = [
    name
    for name, blocks in BLOCKS.items()
    if any(block.language == "python" for block in blocks)
]
EXAMPLES = [
    block
    for blocks in BLOCKS.values()
    for block in blocks
    if block.marker.startswith(EXAMPLE)
]
COMMANDS = [
    (name, line)
    for name, blocks in BLOCKS.items()
    for block in blocks
    if block.language == "sh"
    for line in block.body.splitlines()
    if line.startswith("jaxro ")
]


def lines(text: str) -> list[str]:
    """Without trailing blanks and empty lines at the ends."""
    return [line.rstrip() for line in text.strip("\n").splitlines()]


def column(document: str, heading: str) -> list[str]:
    """The names in code font of the first column of the table whose first heading this
    is."""
    table = re.search(
        rf"^\| {heading} \|.*\n\|[-| ]+\n((?:\|.*\n)+)", TEXTS[document], re.MULTILINE
    )
    assert table, f"{document} has no table that begins with '| {heading} |'"
    return re.findall(r"^\| `([\w-]+)`", table[1], re.MULTILINE)


def final(module, interface: type) -> list[str]:
    return [
        name
        for name, member in vars(module).items()
        if inspect.isclass(member)
        and issubclass(member, interface)
        and not inspect.isabstract(member)
    ]


def command_line():
    """The command line as an object of click, and the library that runs it in a
    test."""
    typer = pytest.importorskip("typer", reason="the command line needs typer and rich")
    testing = pytest.importorskip("typer.testing")
    from jaxro.cli import app

    return app, typer.main.get_command(app), testing.CliRunner


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(name, marks=() if name == "README.md" else pytest.mark.slow)
        for name in OF_PYTHON
    ],
)
def test_python_blocks_run_and_print_what_they_show(document, capsys):
    """The build of the site holds the pages of docs/ to the same."""
    names: dict = {}
    shown = 0
    blocks = BLOCKS[document]
    for block, following in zip(blocks, [*blocks[1:], Block("", "", "")], strict=True):
        if block.language == "python":
            exec(compile(block.body, document, "exec"), names)
            printed = capsys.readouterr().out
            if following.language == "text" and not following.marker:
                assert lines(printed) == lines(following.body)
                shown += 1
            else:
                assert not printed, f"{document} does not show what is printed"
    assert shown


@pytest.mark.parametrize(
    "example", EXAMPLES, ids=lambda block: block.marker.removeprefix(EXAMPLE)
)
def test_example_output_is_that_of_the_command(example):
    app, _, runner = command_line()
    _, *arguments = shlex.split(example.marker.removeprefix(EXAMPLE))
    result = runner(env={"COLUMNS": "100", "NO_COLOR": "1"}).invoke(app, arguments)
    assert result.exit_code == 0
    assert lines(result.stdout) == lines(example.body)


@pytest.mark.parametrize(
    ("document", "command"), COMMANDS, ids=[line for _, line in COMMANDS]
)
def test_commands_are_understood(document, command):
    """Every command and option that is shown exists; the command itself is not run."""
    _, group, _ = command_line()
    _, *arguments = shlex.split(command)
    above = group.make_context("jaxro", arguments.copy(), resilient_parsing=True)
    name, subcommand, rest = group.resolve_command(above, arguments)
    subcommand.make_context(name, rest, parent=above)


def test_test_command_stands_once():
    (command,) = (
        block.body for block in BLOCKS["README.md"] if block.marker == "test command"
    )
    assert len(lines(command)) == 1


@pytest.mark.parametrize("document", TEXTS)
def test_links_lead_somewhere(document):
    for place, anchor in re.findall(r"\]\(([^)#:]*)(?:#([\w-]+))?\)", TEXTS[document]):
        file = (ROOT / document).parent / place if place else ROOT / document
        assert file.exists(), f"{document} links to {place}, which does not exist"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text("utf-8"), re.M)
            known = [
                re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-")
                for heading in headings
            ]
            assert anchor in known, f"{document} links to #{anchor} of {place}"


@pytest.mark.parametrize(
    ("document", "heading", "names"),
    [
        ("docs/choices.md", "element system", final(jaxro, jaxro.AbstractElements)),
        ("docs/choices.md", "start", final(starts, starts.AbstractStart)),
        ("README.md", "procedure", list(PROCEDURES)),
        ("docs/choices.md", "loss", final(losses, losses.AbstractLoss)),
        (
            "docs/choices.md",
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
def test_tables_are_the_lists_of_the_code(document, heading, names):
    assert sorted(column(document, heading)) == sorted(names)


def exists(place: str) -> bool:
    """Whether this is a module of the package, or a member of one: "xla.slabs.spread"
    is."""
    found = importlib.import_module("jaxro")
    for name in place.split("."):
        try:
            found = getattr(found, name)
        except AttributeError:  # a module that nobody has imported yet
            try:
                found = importlib.import_module(f"{found.__name__}.{name}")
            except (AttributeError, ModuleNotFoundError):
                return False
    return True


@pytest.mark.parametrize("name", ["decisions", "decisions-blocks"])
def test_decisions_name_places_in_the_code(name):
    """The second column of the tables of decisions."""
    text = (ROOT / "benchmarks" / f"{name}.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")]
    places = [
        place for row in rows for place in re.findall(r"`([\w.]+)`", row[1]) if row[2:]
    ]
    assert places
    assert not [place for place in places if not exists(place)]


def test_results_are_made_of_the_baseline():
    """benchmarks/results.md is the page of benchmarks/baseline.json; the texts stay
    short."""
    sys.path.insert(0, str(ROOT))
    try:
        from benchmarks import metrics, summary
    finally:
        sys.path.remove(str(ROOT))
    page = (ROOT / "benchmarks" / "results.md").read_text(encoding="utf-8")
    assert page == summary.page(metrics.read_baseline())
    most = {
        "README.md": 150,
        "benchmarks/results.md": 100,
        "benchmarks/decisions.md": 120,
    }
    for name, count in most.items():
        assert len((ROOT / name).read_text(encoding="utf-8").splitlines()) <= count, (
            name
        )
