"""Names are text in every language of output: no formula, no markup, one line."""

import csv
import io

import numpy as np
import pytest
from command_line import rows, run

from jaxro.exchange.pose_graph import PoseGraph, g2o_text
from jaxro.reports.files import csv_text
from jaxro.reports.terminal import consoles, warn
from jaxro.reports.text import escape, say, table
from jaxro.tables.examples import (
    block as block_example,
    calibration as calibration_example,
    survey as survey_example,
)
from jaxro.tables.fields import tell

NAMES = (
    *(r"$\foo$", "$x$ $y$", r"\$a$", "[bold]x", "[/]", "a\\", "<b>x</b>", "{{x}}", "a,b", '"'),
    *("line\nend", "a\rb", "tab\tb", "\x1b[2Jx", "\u202eabc", "\u2028b", "x" * 3000, "é", "="),
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "told"),
    [("a\nb", r"a\nb"), ("\u202eb", r"\u202eb"), ("é\x1b", r"é\x1b"), ("[b]$", "[b]$")],
)
def test_what_moves_other_letters_is_told_as_an_escape(name, told):
    assert tell(name) == told == tell(told)


def test_csv_gives_every_name_back():
    text = csv_text([["name", "number"], *([name, 1.5] for name in NAMES)])
    again = list(csv.reader(io.StringIO(text, newline="")))
    assert [row[0] for row in again[1:]] == list(NAMES)


def test_g2o_has_one_line_for_each_photo():
    count = len(NAMES)
    nothing = np.zeros(0, int)
    graph = PoseGraph(
        photos=NAMES,
        poses=np.tile(np.eye(3, 4), (count, 1, 1)),
        fixed=np.array([0]),
        left=nothing,
        right=nothing,
        measured=np.tile(np.eye(3, 4), (0, 1, 1)),
        information=np.zeros((0, 6, 6)),
        factor=np.zeros(0),
    )
    lines = g2o_text(graph).splitlines()
    assert len(lines) == 2 * count + 1
    assert lines[:count] == [f"# {k} {tell(name)}" for k, name in enumerate(NAMES)]


def test_pages_show_the_name_alone():
    pytest.importorskip("jinja2", reason="pages are made by jinja2")
    from jaxro.reports.html.page import Page, Prose
    from jaxro.reports.html.render import to_html

    for name in NAMES:
        page = Page(title=f"t{name}t", about="", verdict=Prose(name))
        text = to_html(page)
        assert not set("\x1b\r\u202e\u2028") & set(text)
        assert "<b>x" not in text


def test_pictures_show_the_name_alone():
    pytest.importorskip("matplotlib", reason="pictures are drawn by matplotlib")
    from jaxro import plots
    from jaxro.plots.labels import place_labels, show_name
    from jaxro.plots.style import describe

    figure = plots.new_figure()
    axes = figure.subplots()
    axes.set_xticks(range(len(NAMES)), [show_name(name) for name in NAMES])
    describe(axes, r"pair $\foo$", NAMES[0], NAMES[1])
    places = np.stack([np.arange(len(NAMES)), np.zeros(len(NAMES))], axis=-1)
    place_labels(axes, places, NAMES)
    svg = plots.to_svg(axes)
    assert r">pair $\foo$<" in svg and r'aria-label="pair $\foo$"' in svg
    assert not set("\x1b\r\u202e\u2028") & set(svg)


ODD = (r"$\foo$", "[bold]x[/bold]", "a\nb", "=1+1", "<b>y</b>", ";", '"q"', "\u202eabc")
NAMED = ("point", "image", "left", "right", "square", "traverse", "from", "to")


def rename(text, names):
    """A table with odd names; `names`: the new ones by the old ones."""
    header, *lines = csv.reader(io.StringIO(text))
    for line in lines:
        for k, column in enumerate(header):
            if column in NAMED:
                new = f"{ODD[len(names) % len(ODD)]} {len(names)}"
                line[k] = names.setdefault(line[k], new)
    return csv_text([header, *lines])


def block_case():
    texts = block_example.simulate(models=4, seed=3).tables().values()
    words = "block", 0, "--control", 1, "--focal", 153, "--sigma", 0.005
    return tuple(texts), words, "points.csv"


def heights_case():
    texts = survey_example.READINGS, survey_example.GRID, survey_example.TRAVERSES
    camera = survey_example.CAMERA_HEIGHT, "--base", survey_example.BASE
    words = "heights", 0, "--grid", 1, "--traverses", 2, "--camera-height", *camera
    return texts, words, "heights.csv"


def calibrate_case():
    texts = calibration_example.IMAGE, calibration_example.POINTS
    words = "calibrate", 0, "--object", 1, "--model", "one-f"
    return texts, words, "residuals.csv"


@pytest.mark.parametrize(
    "case",
    [
        heights_case,
        pytest.param(block_case, marks=pytest.mark.slow),
        pytest.param(calibrate_case, marks=pytest.mark.slow),
    ],
)
def test_commands_show_names_alone_and_give_them_back(case, tmp_path):
    """A number in `words` is a table of the texts."""
    texts, words, file = case()
    names: dict[str, str] = {}
    tables = []
    for number, text in enumerate(texts):
        tables.append(tmp_path / f"{number}.csv")
        tables[-1].write_text(rename(text, names), newline="")
    words = [tables[w] if w in range(len(tables)) else w for w in words]
    page = tmp_path / "page.html"
    done = run(*words, "--out", tmp_path / "out", "--report", page)
    assert done.exit_code in (0, 1), done.output
    assert r"a\nb " in done.stdout and not set("\r\u202e") & set(done.stdout)
    shown = {new[0] for new in names.values() if tell(new) in done.stdout}
    assert len(shown) >= len(ODD) / 2 and "[" in shown
    found = {row["point"] for row in rows(tmp_path / "out" / file)}
    assert found <= set(names.values()) and len(found) > len(ODD)
    text = page.read_text()
    assert "<b>y" not in text and r"$\foo$" in text and "\u202e" not in text


def test_a_terminal_shows_the_name_alone(capsys):
    """In one line, as a cell, in a sentence with markup, and without."""
    console, errors = consoles()
    shown = table("name", "number")
    for name in NAMES:
        shown.add_row(escape(name), "1")
        console.print(f"[bold]{escape(name)}[/bold]", soft_wrap=True)
        say(console, f"[{name}]"[:60])
        warn(errors, f"[{name}]"[:60])
    console.print(shown)
    said, warned = capsys.readouterr()
    lines = said.splitlines()
    assert lines[: 2 * len(NAMES)] == [
        line for name in NAMES for line in (tell(name), tell(f"[{name}]"[:60]))
    ]
    cells = [line.split() for line in lines if line.endswith(" 1 ")]
    assert len(cells) == len(NAMES)
    assert warned.splitlines() == [f"Warning: {tell(f'[{n}]'[:60])}" for n in NAMES]
