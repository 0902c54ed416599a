"""Names are text in every language of output: no formula, no markup, one line."""

import csv
import io

import numpy as np
import pytest

from jaxro.exchange.pose_graph import PoseGraph, g2o_text
from jaxro.reports.files import csv_text
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
